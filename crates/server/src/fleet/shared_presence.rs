//! The exchange of presence with the other servers of the cluster: sessions here that they have
//! not been told of, and those that they have. This module never asks the database.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::SocketAddr;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use task_proto::{InstanceId, RobotId};
use tokio::sync::Notify;

use super::live_nodes::LiveNodes;
use super::robot_presence::AgentIdentity;
use super::sessions_elsewhere::{MOVE_TIME, SessionsElsewhere};

/// Additional time before a robot counts as away, in which its session at another server becomes
/// known here.
const NEWS_TIME: Duration = Duration::from_secs(3);
/// Maximum robots whose instances wait to be compared; more are compared when they connect again.
const MAX_OBSERVED: usize = 16 * 1024;

/// The exchange with the other servers.
#[derive(Debug)]
pub struct SharedPresence {
    pub elsewhere: SessionsElsewhere,
    pub unwritten: UnwrittenSessions,
    pub instances: ObservedInstances,
    departed: Mutex<HashMap<RobotId, Instant>>,
}

/// A robot's session at this server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SessionHere {
    pub token_number: u64,
    /// The number of the MQTT connection, if there is one.
    pub connection: Option<u64>,
    /// Start of the MQTT connection; `None`: the robot polls.
    pub since_ms: Option<u64>,
    pub seen_ms: u64,
    pub address: Option<SocketAddr>,
    /// The agent that serves the robot's work.
    pub agent: Option<AgentIdentity>,
}

impl SharedPresence {
    /// Begins without any session.
    pub fn new(nodes: LiveNodes) -> Self {
        Self {
            elsewhere: SessionsElsewhere::new(nodes),
            unwritten: UnwrittenSessions::default(),
            instances: ObservedInstances::default(),
            departed: Mutex::default(),
        }
    }

    /// The robot has left this server, and may come back or go to another.
    pub fn departed(&self, robot: &RobotId, now: Instant) {
        lock(&self.departed).insert(robot.clone(), now);
    }

    /// The robot has come to this server. Returns whether it was with one a moment ago.
    pub fn returned(&self, robot: &RobotId, now: Instant) -> bool {
        let has_left_here = lock(&self.departed).remove(robot).is_some();
        has_left_here || self.elsewhere.was_present(robot, now)
    }

    /// Robots that have left this server and were given time to come back.
    pub fn missing(&self, now: Instant) -> Vec<RobotId> {
        let mut departed = lock(&self.departed);
        let is_due = |at: &Instant| now.saturating_duration_since(*at) >= MOVE_TIME + NEWS_TIME;
        let missing: Vec<RobotId> =
            departed.iter().filter(|(_, at)| is_due(at)).map(|(robot, _)| robot.clone()).collect();
        departed.retain(|_, at| !is_due(at));
        missing
    }
}

/// Robots whose session here has changed since its row was written: a set, so a robot waits here
/// once however often it changes.
#[derive(Debug, Default)]
pub struct UnwrittenSessions {
    robots: Mutex<BTreeSet<RobotId>>,
    added: Notify,
}

impl UnwrittenSessions {
    pub fn add(&self, robot: &RobotId) {
        if lock(&self.robots).insert(robot.clone()) {
            self.added.notify_one();
        }
    }

    /// Waits until there is a robot, and takes at most `most`, in the order of their ids. Dropping
    /// the future loses none.
    pub async fn take(&self, most: usize) -> Vec<RobotId> {
        loop {
            {
                let mut robots = lock(&self.robots);
                let taken: Vec<RobotId> =
                    std::iter::from_fn(|| robots.pop_first()).take(most).collect();
                if !taken.is_empty() {
                    return taken;
                }
            }
            self.added.notified().await;
        }
    }
}

/// A change for the stored instances of a robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Observed {
    /// This instance was seen at this time.
    Instance(InstanceId, u64),
    /// All other instances have ended.
    Reset,
}

/// Instances of robots that were seen here and not yet compared with those seen elsewhere.
#[derive(Debug, Default)]
pub struct ObservedInstances {
    robots: Mutex<BTreeMap<RobotId, Observed>>,
    added: Notify,
}

impl ObservedInstances {
    /// Adds an instance that was seen.
    pub fn add(&self, robot: &RobotId, instance: &InstanceId, now_ms: u64) {
        self.put(robot, Observed::Instance(instance.clone(), now_ms));
    }

    /// Adds that all instances have ended.
    pub fn reset(&self, robot: &RobotId) {
        self.put(robot, Observed::Reset);
    }

    fn put(&self, robot: &RobotId, observed: Observed) {
        let mut robots = lock(&self.robots);
        if robots.len() < MAX_OBSERVED || robots.contains_key(robot) {
            robots.insert(robot.clone(), observed);
            self.added.notify_one();
        }
    }

    /// Waits until there is a robot, and takes it. Dropping the future loses none.
    pub async fn take(&self) -> (RobotId, Observed) {
        loop {
            let taken = lock(&self.robots).pop_first();
            if let Some(taken) = taken {
                return taken;
            }
            self.added.notified().await;
        }
    }
}

fn lock<T>(value: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing
    // half-done.
    value.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn robot_that_comes_back_in_time_is_not_missing() {
        let (shared, start) = (SharedPresence::new(LiveNodes::default()), Instant::now());
        let [back, gone] = [RobotId::random(), RobotId::random()];
        shared.departed(&back, start);
        shared.departed(&gone, start);
        assert!(shared.returned(&back, start + MOVE_TIME));
        assert!(shared.missing(start + MOVE_TIME).is_empty());
        assert_eq!(shared.missing(start + MOVE_TIME + NEWS_TIME), std::slice::from_ref(&gone));
        assert!(!shared.returned(&gone, start + MOVE_TIME + NEWS_TIME));
    }

    #[tokio::test]
    async fn changed_sessions_are_taken_once_in_order() {
        let unwritten = UnwrittenSessions::default();
        let mut robots: Vec<RobotId> = (0..5).map(|_| RobotId::random()).collect();
        robots.iter().chain(&robots).for_each(|robot| unwritten.add(robot));
        robots.sort();
        assert_eq!(unwritten.take(3).await, robots[..3]);
        assert_eq!(unwritten.take(3).await, robots[3..]);
    }
}
