//! Presence at an external broker, as far as robots report it themselves: by their `status`, which
//! ends with their last will, and by all other messages. Pure; this module neither reads messages
//! nor notifies other modules.

use std::collections::HashMap;

use task_proto::RobotId;
use task_proto::messages::report::Status;

/// Maximum robots known to be online; we receive messages of further robots and can't send them
/// requests.
const MAX_ROBOTS: usize = 100_000;

#[derive(Default)]
pub(super) struct OnlineRobots {
    robots: HashMap<RobotId, Connection>,
    /// The number of the newest connection.
    connections: u64,
}

struct Connection {
    /// Start and connection that the robot named; `None` while unknown.
    position: Option<(u64, u64)>,
    number: u64,
}

/// Changes of the robot's connections that follow from a message, by our numbers.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct PresenceChange {
    /// This connection has ended.
    pub(super) ended: Option<u64>,
    /// This connection has begun, after that.
    pub(super) begun: Option<u64>,
}

impl OnlineRobots {
    /// The robot published its status, or the broker did in its name. A status of an older
    /// connection than the known one is late and ignored.
    pub(super) fn status(&mut self, robot: &RobotId, status: &Status) -> PresenceChange {
        let position = Some((status.start, status.connection));
        let Some(known) = self.robots.get_mut(robot) else {
            return if status.online {
                self.connect(robot, position)
            } else {
                PresenceChange::default()
            };
        };
        if position < known.position {
            return PresenceChange::default();
        }
        let ended = Some(known.number);
        if !status.online {
            self.robots.remove(robot);
            return PresenceChange { ended, begun: None };
        }
        if known.position.is_none() || position == known.position {
            known.position = position;
            return PresenceChange::default();
        }
        PresenceChange { ended, ..self.connect(robot, position) }
    }

    /// The robot published another message: the robot is online, even if its status was lost.
    pub(super) fn message(&mut self, robot: &RobotId) -> PresenceChange {
        if self.robots.contains_key(robot) {
            PresenceChange::default()
        } else {
            self.connect(robot, None)
        }
    }

    /// The server treats the robot as gone. Returns its connection.
    pub(super) fn remove(&mut self, robot: &RobotId) -> Option<u64> {
        self.robots.remove(robot).map(|known| known.number)
    }

    /// Clears all presence. Returns the robots that were online.
    pub(super) fn clear(&mut self) -> Vec<(RobotId, u64)> {
        self.robots.drain().map(|(robot, known)| (robot, known.number)).collect()
    }

    /// The robot's current connection.
    pub(super) fn connection(&self, robot: &RobotId) -> Option<u64> {
        self.robots.get(robot).map(|known| known.number)
    }

    pub(super) fn contains(&self, robot: &RobotId) -> bool {
        self.robots.contains_key(robot)
    }

    pub(super) fn count(&self) -> usize {
        self.robots.len()
    }

    fn connect(&mut self, robot: &RobotId, position: Option<(u64, u64)>) -> PresenceChange {
        if self.robots.len() >= MAX_ROBOTS && !self.robots.contains_key(robot) {
            return PresenceChange::default();
        }
        self.connections += 1;
        let number = self.connections;
        self.robots.insert(robot.clone(), Connection { position, number });
        PresenceChange { ended: None, begun: Some(number) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::InstanceId;

    fn status(online: bool, start: u64, connection: u64) -> Status {
        Status { online, start, instance: InstanceId::random(), connection, place: None }
    }

    fn change(ended: impl Into<Option<u64>>, begun: impl Into<Option<u64>>) -> PresenceChange {
        PresenceChange { ended: ended.into(), begun: begun.into() }
    }

    #[test]
    fn robot_is_online_from_its_status_to_its_will() {
        let (mut online, robot) = (OnlineRobots::default(), RobotId::random());
        assert_eq!(
            online.status(&robot, &status(false, 1, 1)),
            change(None, None),
            "no robot was online"
        );
        assert_eq!(online.status(&robot, &status(true, 1, 1)), change(None, 1));
        assert_eq!(
            online.status(&robot, &status(true, 1, 1)),
            change(None, None),
            "a repeated status"
        );
        assert!(online.contains(&robot));
        assert_eq!(online.status(&robot, &status(false, 1, 1)), change(1, None));
        assert_eq!(online.count(), 0);
    }

    #[test]
    fn will_of_an_older_connection_is_ignored() {
        let (mut online, robot) = (OnlineRobots::default(), RobotId::random());
        online.status(&robot, &status(true, 3, 1));
        assert_eq!(online.status(&robot, &status(true, 3, 2)), change(1, 2));
        for late in [status(false, 3, 1), status(false, 2, 9), status(true, 3, 1)] {
            assert_eq!(online.status(&robot, &late), change(None, None), "{late:?}");
        }
        assert_eq!(online.status(&robot, &status(true, 4, 1)), change(2, 3), "a restarted agent");
    }

    #[test]
    fn any_message_makes_a_robot_online() {
        let (mut online, robot) = (OnlineRobots::default(), RobotId::random());
        assert_eq!(online.message(&robot), change(None, 1));
        assert_eq!(online.message(&robot), change(None, None));
        assert_eq!(
            online.status(&robot, &status(true, 5, 5)),
            change(None, None),
            "the position is known now"
        );
        assert_eq!(online.status(&robot, &status(false, 5, 4)), change(None, None));
        assert_eq!(online.clear(), [(robot.clone(), 1)]);
        assert_eq!(online.message(&robot), change(None, 2));
        assert_eq!(online.remove(&robot), Some(2));
    }
}
