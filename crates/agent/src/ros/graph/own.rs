//! The agent's own node, as others see it: it says which readers and writers it has, and takes back
//! what is gone.

use std::collections::BTreeSet;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::endpoint::{Cdr, Writer};
use super::entities::{GidForm, NodeEntities, ParticipantEntities};
use super::{EndpointId, ParticipantId};

/// Tells the graph about the agent's node.
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
    /// A node without endpoints, which nobody has been told of.
    pub fn new(name: task_proto::ros::GraphName, form: GidForm, announcer: Writer) -> Self {
        let participant = announcer.id().participant();
        Self { name, participant, form, announcer, endpoints: Mutex::default() }
    }

    /// Takes these among the node's endpoints and says so.
    pub fn add(&self, readers: &[EndpointId], writers: &[EndpointId]) {
        let mut held = self.held();
        held.readers.extend(readers);
        held.writers.extend(writers);
        self.announce(&held);
    }

    /// Takes these from the node's endpoints and says so.
    pub fn remove(&self, readers: &[EndpointId], writers: &[EndpointId]) {
        let mut held = self.held();
        held.readers.retain(|id| !readers.contains(id));
        held.writers.retain(|id| !writers.contains(id));
        self.announce(&held);
    }

    fn held(&self) -> MutexGuard<'_, Held> {
        // Two sets of ids are sound whatever a panic left.
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
