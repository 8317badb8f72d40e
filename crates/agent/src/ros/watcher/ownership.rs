//! Determines the owners of a graph's participants, as seen from one run: the run itself, another
//! owner, or no living process.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::ros::graph::{Graph, Owners, Participant, ParticipantId, Snapshot};
use crate::ros::readiness::Promise;

/// Maximum delay between a process's start and the record of that start: a participant may have
/// been seen in between.
const START_SLACK: Duration = Duration::from_secs(1);

#[derive(Debug, Clone, Default)]
pub(super) struct Ownership {
    /// Participants of the run's processes.
    pub(super) ours: BTreeSet<ParticipantId>,
    /// Living participants of other owners, each with a description.
    pub(super) others: BTreeMap<ParticipantId, String>,
    /// Participants of processes that are gone: discovery knows of them until their lease ends.
    pub(super) gone: BTreeSet<ParticipantId>,
    /// All participants that once belonged to the run and are still known.
    pub(super) ever_ours: BTreeSet<ParticipantId>,
}

impl Ownership {
    /// Determines the owners of the participants in `snapshot`, for a run with the processes `pids`
    /// that was started at `started`. `ever_ours` are the participants that were found to belong to
    /// the run before.
    pub(super) async fn determine(
        snapshot: Arc<Snapshot>,
        pids: Vec<u32>,
        ever_ours: &BTreeSet<ParticipantId>,
        started: Option<Instant>,
    ) -> Self {
        let owners = Graph::owners(snapshot.clone(), pids).await;
        Self::of(&snapshot.participants, &owners, ever_ours, started)
    }

    fn of(
        participants: &BTreeMap<ParticipantId, Participant>,
        owners: &Owners,
        ever_ours: &BTreeSet<ParticipantId>,
        started: Option<Instant>,
    ) -> Self {
        let replaced = replaced(participants);
        let mut ownership = Self::default();
        for (id, participant) in participants {
            let was_ours = ever_ours.contains(id);
            // Where the kernel can't tell, participants that came after the start count as the
            // run's.
            let later =
                started.is_some_and(|started| participant.first_seen + START_SLACK >= started);
            let ours = owners.theirs.contains(id) || (owners.unknown.contains(id) && later);
            if owners.gone.contains(id) || replaced.contains(id) || (was_ours && !ours) {
                ownership.gone.insert(*id);
            } else if ours {
                ownership.ours.insert(*id);
            } else {
                ownership.others.insert(*id, describe(participant));
            }
            if ours || was_ours {
                ownership.ever_ours.insert(*id);
            }
        }
        ownership
    }

    /// The same, but other participants with promised names are described as processes of this
    /// robot, where that can be determined. This takes a moment for each of them.
    pub(super) async fn with_process_names(
        mut self,
        promise: &Promise,
        snapshot: &Snapshot,
    ) -> Self {
        for id in promise.conflicting_participants(snapshot, &self.others) {
            let (Some(words), Some(participant)) =
                (self.others.get_mut(&id), snapshot.participants.get(&id))
            else {
                continue;
            };
            if let Some(pid) = Graph::process_of(participant.clone()).await {
                *words = format!("process {pid} on this robot");
            }
        }
        self
    }

    /// Whether the last look included this participant.
    pub(super) fn knows(&self, id: &ParticipantId) -> bool {
        self.ours.contains(id) || self.others.contains_key(id) || self.gone.contains(id)
    }
}

/// Participants whose address belongs to another participant that was seen later: two processes
/// can't have one port, so the first is gone.
fn replaced(participants: &BTreeMap<ParticipantId, Participant>) -> BTreeSet<ParticipantId> {
    let mut newest: BTreeMap<SocketAddr, (Instant, ParticipantId)> = BTreeMap::new();
    for (id, participant) in participants {
        for locator in &participant.locators {
            let seen = newest.entry(*locator).or_insert((participant.first_seen, *id));
            *seen = (*seen).max((participant.first_seen, *id));
        }
    }
    let is_replaced = |id: &ParticipantId, participant: &Participant| {
        let mut locators = participant.locators.iter().peekable();
        locators.peek().is_some()
            && locators.all(|locator| newest.get(locator).is_some_and(|(_, by)| by != id))
    };
    participants
        .iter()
        .filter(|(id, participant)| is_replaced(id, participant))
        .map(|(id, _)| *id)
        .collect()
}

fn describe(participant: &Participant) -> String {
    let hosts: BTreeSet<_> =
        participant.locators.iter().map(|locator| locator.ip().to_string()).collect();
    match hosts.first() {
        Some(host) => format!("another process (at {host})"),
        None => "another process".to_owned(),
    }
}
