//! The live servers of the cluster: those whose heartbeat moves, by this server's own clock. A
//! server alone is its only node. This module never asks the database.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// The longest rest of a heartbeat before its server counts as dead.
const MAX_REST: Duration = Duration::from_secs(10);
/// Longest time between two observations. Time beyond it does not count as rest, because the
/// database was away or this server was stopped.
const MAX_STEP: Duration = Duration::from_secs(4);

/// The live servers. Clones share them.
#[derive(Debug, Clone, Default)]
pub struct LiveNodes {
    known: Arc<Mutex<KnownNodes>>,
}

#[derive(Debug, Default)]
struct KnownNodes {
    own_run: Option<String>,
    bus_problem: Option<String>,
    observed_at: Option<Instant>,
    others: HashMap<String, Pulse>,
}

#[derive(Debug)]
struct Pulse {
    heartbeat: u64,
    /// When the heartbeat last moved; `None`: the server is dead.
    moved_at: Option<Instant>,
}

/// Changes among the other servers.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct NodeChanges {
    /// Runs that live now.
    pub began: Vec<String>,
    /// Runs that are dead now.
    pub ended: Vec<String>,
}

impl LiveNodes {
    /// This server serves as `run` from now on.
    pub fn join(&self, run: &str) {
        self.known().own_run = Some(run.to_owned());
    }

    /// Sets why the other servers' notifications do not arrive.
    pub fn set_bus_problem(&self, problem: Option<String>) {
        self.known().bus_problem = problem;
    }

    /// For people: why the other servers' notifications do not arrive; `None` if no problem is known.
    pub fn bus_problem(&self) -> Option<String> {
        let problem = self.known().bus_problem.clone()?;
        Some(format!("notifications of the other servers do not arrive: {problem}"))
    }

    /// The live runs, this server's among them.
    pub fn runs(&self) -> Vec<String> {
        let known = self.known();
        let others = known.others.iter().filter(|(_, pulse)| pulse.moved_at.is_some());
        known.own_run.iter().chain(others.map(|(run, _)| run)).cloned().collect()
    }

    /// Whether the run lives.
    pub fn is_live(&self, run: &str) -> bool {
        let known = self.known();
        known.own_run.as_deref() == Some(run)
            || known.others.get(run).is_some_and(|pulse| pulse.moved_at.is_some())
    }

    /// The time since the heartbeat of another live run moved.
    pub fn rest(&self, run: &str, now: Instant) -> Option<Duration> {
        let moved_at = self.known().others.get(run)?.moved_at?;
        Some(now.saturating_duration_since(moved_at))
    }

    /// The number of live servers, with this one.
    pub fn count(&self) -> usize {
        self.runs().len().max(1)
    }

    /// Takes the runs and heartbeats of all servers, as stored at `now`. A new server counts as
    /// live, and its earlier run as dead at once.
    pub fn observe<'a>(
        &self,
        heartbeats: impl IntoIterator<Item = (&'a str, u64)>,
        now: Instant,
    ) -> NodeChanges {
        let mut known = self.known();
        let mut changes = NodeChanges::default();
        let before = known.observed_at.replace(now).unwrap_or(now);
        let unseen = now.saturating_duration_since(before).saturating_sub(MAX_STEP);
        let mut others = HashMap::new();
        for (run, heartbeat) in heartbeats {
            if known.own_run.as_deref() == Some(run) {
                continue;
            }
            let before = known.others.remove(run);
            let was_live = before.as_ref().is_some_and(|pulse| pulse.moved_at.is_some());
            let moved_at = match before {
                Some(pulse) if pulse.heartbeat == heartbeat => {
                    let moved_at = pulse.moved_at.map(|at| at + unseen);
                    moved_at.filter(|at| now.saturating_duration_since(*at) < MAX_REST)
                }
                _ => Some(now),
            };
            match (was_live, moved_at.is_some()) {
                (false, true) => changes.began.push(run.to_owned()),
                (true, false) => changes.ended.push(run.to_owned()),
                _ => {}
            }
            others.insert(run.to_owned(), Pulse { heartbeat, moved_at });
        }
        let gone = std::mem::replace(&mut known.others, others);
        changes.ended.extend(
            gone.into_iter().filter(|(_, pulse)| pulse.moved_at.is_some()).map(|(run, _)| run),
        );
        changes.ended.sort_unstable();
        changes
    }

    fn known(&self) -> MutexGuard<'_, KnownNodes> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runs(names: &[&str]) -> Vec<String> {
        names.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn node_whose_heartbeat_rests_too_long_is_dead_until_it_moves_again() {
        let (nodes, start) = (LiveNodes::default(), Instant::now());
        assert_eq!((nodes.count(), nodes.runs()), (1, Vec::new()), "a server alone");
        nodes.join("a-1");
        let at = |seconds| start + Duration::from_secs(seconds);
        let first = nodes.observe([("a-1", 1), ("b-1", 7)], at(0));
        assert_eq!(first, NodeChanges { began: runs(&["b-1"]), ended: Vec::new() });
        assert_eq!((nodes.count(), nodes.is_live("b-1")), (2, true));
        for seconds in [3, 6, 9] {
            assert_eq!(nodes.observe([("b-1", 7)], at(seconds)), NodeChanges::default());
        }
        let silent = nodes.observe([("b-1", 7)], at(10));
        assert_eq!(silent, NodeChanges { began: Vec::new(), ended: runs(&["b-1"]) });
        assert_eq!(nodes.runs(), runs(&["a-1"]));
        assert_eq!(nodes.observe([("b-1", 7)], at(99)), NodeChanges::default());
        assert_eq!(nodes.observe([("b-1", 8)], at(100)).began, runs(&["b-1"]));
    }

    #[test]
    fn time_in_which_nobody_could_look_is_no_rest() {
        let (nodes, start) = (LiveNodes::default(), Instant::now());
        nodes.join("a-1");
        let at = |seconds| start + Duration::from_secs(seconds);
        nodes.observe([("b-1", 7)], at(0));
        assert_eq!(nodes.observe([("b-1", 7)], at(60)), NodeChanges::default());
        assert_eq!(nodes.observe([("b-1", 7)], at(63)), NodeChanges::default());
        assert_eq!(nodes.observe([("b-1", 7)], at(66)).ended, runs(&["b-1"]));
    }

    #[test]
    fn earlier_run_of_a_restarted_node_is_dead_at_once() {
        let (nodes, now) = (LiveNodes::default(), Instant::now());
        nodes.join("a-1");
        nodes.observe([("b-1", 7)], now);
        let restarted = nodes.observe([("b-2", 8)], now);
        assert_eq!(restarted, NodeChanges { began: runs(&["b-2"]), ended: runs(&["b-1"]) });
    }
}
