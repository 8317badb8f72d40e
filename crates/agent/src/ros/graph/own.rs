//! The agent's own node, as other participants see it: it announces its readers and writers, and
//! withdraws those that are gone.

use std::collections::BTreeSet;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::endpoint::{Cdr, Writer};
use super::entities::{GidForm, NodeEntities, ParticipantEntities};
use super::{EndpointId, ParticipantId};

/// Announces the agent's node on the graph.
pub struct OwnNode {
    name: task_proto::ros::GraphName,
    participant: ParticipantId,
    form: GidForm,
    announcer: Writer,
    endpoints: Mutex<Held>,
}

#[derive(Default)]
struct Held {
    readers: BTreeSet<EndpointId>,
    writers: BTreeSet<EndpointId>,
}

impl OwnNode {
    /// A node without endpoints, not announced yet.
    pub fn new(name: task_proto::ros::GraphName, form: GidForm, announcer: Writer) -> Self {
        let participant = announcer.id().participant();
        Self { name, participant, form, announcer, endpoints: Mutex::default() }
    }

    /// Adds these endpoints to the node and announces the change.
    pub fn add(&self, readers: &[EndpointId], writers: &[EndpointId]) {
        let mut held = self.held();
        held.readers.extend(readers);
        held.writers.extend(writers);
        self.announce(&held);
    }

    /// Removes these endpoints from the node and announces the change.
    pub fn remove(&self, readers: &[EndpointId], writers: &[EndpointId]) {
        let mut held = self.held();
        held.readers.retain(|id| !readers.contains(id));
        held.writers.retain(|id| !writers.contains(id));
        self.announce(&held);
    }

    fn held(&self) -> MutexGuard<'_, Held> {
        // Two sets of ids stay valid after a panic.
        self.endpoints.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn announce(&self, held: &Held) {
        let node = NodeEntities {
            name: self.name.clone(),
            readers: held.readers.iter().copied().collect(),
            writers: held.writers.iter().copied().collect(),
        };
        let entities =
            ParticipantEntities { participant: self.participant, nodes: vec![node], misnamed: 0 };
        self.announcer.put(Cdr::little_endian(entities.encode(self.form)));
    }
}
