//! Sessions of robots at the other servers of the cluster, as their rows said last. They count
//! while their server lives. This module never asks the database.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use task_proto::RobotId;

use super::live_nodes::LiveNodes;
use super::robot_presence::{AgentIdentity, RobotPresence};

/// A robot that comes back within this time, at any server, was not away.
pub(super) const MOVE_TIME: Duration = Duration::from_secs(10);
/// Maximum sessions in memory; those beyond the limit are not shown as online.
const MAX_SESSIONS: usize = 2_000_000;

/// The sessions at all other servers.
#[derive(Debug)]
pub struct SessionsElsewhere {
    nodes: LiveNodes,
    sessions: Mutex<HashMap<RobotId, SessionElsewhere>>,
}

/// One robot's session at another server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SessionElsewhere {
    /// The start of the server.
    pub run: Arc<str>,
    /// Start of the MQTT connection; `None`: the robot polls.
    pub since_ms: Option<u64>,
    pub seen_ms: u64,
    pub left_ms: Option<u64>,
    pub address: Option<SocketAddr>,
    /// The agent that serves the robot's work.
    pub agent: Option<AgentIdentity>,
    /// When the end of the session became known; `None`: before this server looked.
    pub left_at: Option<Instant>,
}

impl SessionsElsewhere {
    pub(super) fn new(nodes: LiveNodes) -> Self {
        Self { nodes, sessions: Mutex::default() }
    }

    /// Takes a session. Returns whether the robot is online there now and was not before, or the
    /// other way round.
    pub fn put(&self, robot: &RobotId, session: SessionElsewhere) -> bool {
        let mut sessions = self.sessions();
        let is_online = self.counts(&session);
        let was_online = sessions.get(robot).is_some_and(|known| self.counts(known));
        if sessions.len() < MAX_SESSIONS || sessions.contains_key(robot) {
            sessions.insert(robot.clone(), session);
        }
        is_online != was_online
    }

    /// Forgets a robot whose last session is at this server.
    pub fn remove(&self, robot: &RobotId) {
        self.sessions().remove(robot);
    }

    /// Ends all sessions of a run. Returns their robots.
    pub fn end_run(&self, run: &str, left_ms: u64) -> Vec<RobotId> {
        let mut ended = Vec::new();
        for (robot, session) in self.sessions().iter_mut() {
            if *session.run == *run && session.left_ms.is_none() {
                session.left_ms = Some(left_ms);
                ended.push(robot.clone());
            }
        }
        ended
    }

    /// The robots with a session of this run.
    pub fn of_run(&self, run: &str) -> Vec<RobotId> {
        let sessions = self.sessions();
        let here = sessions.iter().filter(|(_, session)| *session.run == *run);
        here.filter(|(_, session)| session.left_ms.is_none())
            .map(|(robot, _)| robot.clone())
            .collect()
    }

    /// Whether the robot is online at another server.
    pub fn is_online(&self, robot: &RobotId) -> bool {
        self.sessions().get(robot).is_some_and(|session| self.counts(session))
    }

    /// The agent that serves the robot's work at another server, and when it was last there.
    pub(super) fn agent(&self, robot: &RobotId, now_ms: u64) -> Option<(AgentIdentity, u64)> {
        let sessions = self.sessions();
        let session = sessions.get(robot)?;
        Some((session.agent.clone()?, session.left_ms.unwrap_or(now_ms)))
    }

    /// Whether the robot has an MQTT connection to another server.
    pub(super) fn is_connected(&self, robot: &RobotId) -> bool {
        let is_connected =
            |session: &SessionElsewhere| session.since_ms.is_some() && self.counts(session);
        self.sessions().get(robot).is_some_and(is_connected)
    }

    /// Whether the robot was at another server a moment ago. A server that has died may have had
    /// the robot until now.
    pub(super) fn was_present(&self, robot: &RobotId, now: Instant) -> bool {
        let is_recent = |at: Instant| now.saturating_duration_since(at) < MOVE_TIME;
        self.sessions().get(robot).is_some_and(|session| match session.left_ms {
            None => true,
            Some(_) => session.left_at.is_some_and(is_recent),
        })
    }

    /// The presence of a robot that is known `here`, or at another server.
    pub(super) fn overlay(
        &self,
        robot: &RobotId,
        here: Option<RobotPresence>,
    ) -> Option<RobotPresence> {
        if here.as_ref().is_some_and(|here| here.connection.is_some()) {
            return here;
        }
        let sessions = self.sessions();
        let Some(session) = sessions.get(robot) else { return here };
        let online = self.counts(session);
        // Of two servers to which the robot sends requests, this one knows more.
        if here.as_ref().is_some_and(|here| here.online) && !(online && session.since_ms.is_some())
        {
            return here;
        }
        let seen_ms = session.left_ms.unwrap_or(session.seen_ms).max(session.seen_ms);
        let duplicate = here.as_ref().is_some_and(|here| here.duplicate);
        let has_waiting_instance = here.as_ref().is_some_and(|here| here.has_waiting_instance);
        let is_newer = here.as_ref().is_none_or(|here| here.last_seen_ms < seen_ms);
        let address = match online || is_newer {
            true => session.address,
            false => here.as_ref().and_then(|here| here.address),
        };
        Some(RobotPresence {
            online,
            address,
            connected_since_ms: session.since_ms.filter(|_| online),
            connection: None,
            last_seen_ms: here.map_or(seen_ms, |here| here.last_seen_ms.max(seen_ms)),
            duplicate,
            has_waiting_instance,
        })
    }

    fn counts(&self, session: &SessionElsewhere) -> bool {
        session.left_ms.is_none() && self.nodes.is_live(&session.run)
    }

    fn sessions(&self) -> MutexGuard<'_, HashMap<RobotId, SessionElsewhere>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.sessions.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn session_counts_while_its_server_lives_and_it_has_not_ended() {
        let (nodes, start) = (LiveNodes::default(), Instant::now());
        let sessions = SessionsElsewhere::new(nodes.clone());
        let robot = RobotId::random();
        let session = SessionElsewhere {
            run: "b-1".into(),
            since_ms: Some(5),
            seen_ms: 5,
            left_ms: None,
            address: "10.0.0.7:4000".parse().ok(),
            agent: None,
            left_at: None,
        };
        assert!(!sessions.put(&robot, session.clone()), "its server does not live");
        nodes.join("a-1");
        nodes.observe([("b-1", 1)], start);
        let shown = sessions.overlay(&robot, None).expect("known");
        assert_eq!((shown.online, shown.connected_since_ms), (true, Some(5)));
        let left = SessionElsewhere { left_ms: Some(9), left_at: Some(start), ..session.clone() };
        assert!(sessions.put(&robot, left));
        assert!(!sessions.is_online(&robot) && sessions.was_present(&robot, start));
        assert!(!sessions.was_present(&robot, start + MOVE_TIME));
        sessions.put(&robot, session);
        for seconds in [4, 8, 12] {
            nodes.observe([("b-1", 1)], start + Duration::from_secs(seconds));
        }
        let shown = sessions.overlay(&robot, None).expect("known");
        assert_eq!((shown.online, shown.last_seen_ms), (false, 5));
        assert!(sessions.was_present(&robot, start + MOVE_TIME), "until its server is given up");
        assert_eq!(sessions.end_run("b-1", 20), std::slice::from_ref(&robot));
        assert!(!sessions.was_present(&robot, start));
    }
}
