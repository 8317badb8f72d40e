//! The agent's own node, as other participants see it: it announces its readers and writers, and
//! withdraws those that are gone.

use std::collections::BTreeSet;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::endpoint::{Cdr, Writer};
use super::entities::{GidForm, NodeEntities, ParticipantEntities};
use crate::ros::graph::{EndpointId, ParticipantId};

/// Announces the agent's node on the graph.
pub struct OwnNode {
    name: task_proto::telemetry::ros::GraphName,
    participant: ParticipantId,
    form: GidForm,
    announcer: Writer,
    endpoints: Mutex<Announced>,
}

#[derive(Default)]
struct Announced {
    readers: BTreeSet<EndpointId>,
    writers: BTreeSet<EndpointId>,
}

impl OwnNode {
    /// A node without endpoints, not announced yet.
    pub fn new(
        name: task_proto::telemetry::ros::GraphName,
        form: GidForm,
        announcer: Writer,
    ) -> Self {
        let participant = announcer.id().participant();
        Self { name, participant, form, announcer, endpoints: Mutex::default() }
    }

    /// Adds these endpoints to the node and announces the change.
    pub fn add(&self, readers: &[EndpointId], writers: &[EndpointId]) {
        let mut announced = self.endpoints();
        announced.readers.extend(readers);
        announced.writers.extend(writers);
        self.announce(&announced);
    }

    /// Removes these endpoints from the node and announces the change.
    pub fn remove(&self, readers: &[EndpointId], writers: &[EndpointId]) {
        let mut announced = self.endpoints();
        announced.readers.retain(|id| !readers.contains(id));
        announced.writers.retain(|id| !writers.contains(id));
        self.announce(&announced);
    }

    fn endpoints(&self) -> MutexGuard<'_, Announced> {
        // Two sets of ids stay valid after a panic.
        self.endpoints.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn announce(&self, announced: &Announced) {
        let node = NodeEntities {
            name: self.name.clone(),
            readers: announced.readers.iter().copied().collect(),
            writers: announced.writers.iter().copied().collect(),
        };
        let entities =
            ParticipantEntities { participant: self.participant, nodes: vec![node], misnamed: 0 };
        self.announcer.put(Cdr::little_endian(entities.encode(self.form)));
    }
}
