//! Notifies the inbox of robots' sessions.

use std::net::SocketAddr;

use task_proto::RobotId;

use super::Context;
use super::access::Visitor;
use crate::broker::Inbox;

/// Notifies the inbox of a robot's session, and of its end even if the session's task panics.
pub(super) struct Attendance<'a> {
    inbox: &'a dyn Inbox,
    robot: RobotId,
    connection: u64,
}

impl<'a> Attendance<'a> {
    /// The session is live; `None` if the client is not a robot.
    pub(super) fn begin(
        context: &'a Context,
        visitor: &Visitor,
        peer: SocketAddr,
        connection: u64,
    ) -> Option<Self> {
        let Visitor::Robot { robot, .. } = visitor else { return None };
        context.inbox.connected(robot, Some(peer), connection);
        Some(Self { inbox: &*context.inbox, robot: robot.clone(), connection })
    }
}

impl Drop for Attendance<'_> {
    fn drop(&mut self) {
        self.inbox.disconnected(&self.robot, self.connection);
    }
}
