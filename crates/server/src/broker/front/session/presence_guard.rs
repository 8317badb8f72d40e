//! Notifies the inbox of robots' sessions.

use std::net::SocketAddr;

use task_proto::RobotId;

use crate::broker::Inbox;
use crate::broker::front::Context;
use crate::broker::front::access::Client;

/// Notifies the inbox of a robot's session, and of its end even if the session's task panics.
pub(super) struct PresenceGuard<'a> {
    inbox: &'a dyn Inbox,
    robot: RobotId,
    connection: u64,
}

impl<'a> PresenceGuard<'a> {
    /// The session is live; `None` if the client is not a robot.
    pub(super) fn begin(
        context: &'a Context,
        client: &Client,
        peer: SocketAddr,
        connection: u64,
    ) -> Option<Self> {
        let Client::Robot { robot, token_number } = client else { return None };
        context.inbox.connected(robot, Some(peer), connection, Some(*token_number));
        Some(Self { inbox: &*context.inbox, robot: robot.clone(), connection })
    }
}

impl Drop for PresenceGuard<'_> {
    fn drop(&mut self) {
        self.inbox.disconnected(&self.robot, self.connection);
    }
}
