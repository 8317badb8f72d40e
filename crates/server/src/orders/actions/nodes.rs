//! Orders about the servers of a cluster. This module records them; the server concerned carries
//! them out.

use task_proto::ids::NodeName;

use super::OrderError;
use crate::domain::person::Person;
use crate::store::{AuditAction, AuditEvent, Store};
use crate::system::clock::Clock;

/// Orders about servers. Clones share their state.
#[derive(Clone)]
pub struct NodeActions {
    pub(super) store: Store,
    pub(super) clock: Clock,
}

impl NodeActions {
    /// Records that a server is to send its robots to the others.
    pub async fn drain(&self, by: &Person, node: &NodeName) -> Result<(), OrderError> {
        let mut write = self.store.begin().await?;
        let event = AuditEvent::by(by, AuditAction::NodeDrain, node);
        write.audit().record(&event, self.clock.now_ms()).await?;
        Ok(write.commit().await?)
    }
}
