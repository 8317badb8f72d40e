//! Ends a person's MQTT sessions, here and at the other servers of the cluster.

use task_proto::UserName;

use crate::broker::Broker;
use crate::orders::changes::Changes;

/// People's MQTT sessions at all servers.
#[derive(Clone)]
pub struct PersonSessions {
    pub(in crate::http) broker: Broker,
    pub(in crate::http) changes: Changes,
}

impl PersonSessions {
    /// Ends the person's sessions: the person's rights have changed, or one of their tokens has
    /// ended.
    pub fn end(&self, user: &UserName) {
        self.broker.disconnect_person(user);
        self.changes.end_person_elsewhere(user);
    }
}
