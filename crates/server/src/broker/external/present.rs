//! Presence at an external broker, as far as robots report it themselves: by their `status`, which
//! ends with their last will, and by all other messages. Pure; this module neither reads messages
//! nor notifies other modules.

use std::collections::HashMap;

use task_proto::RobotId;
use task_proto::report::Status;

/// Maximum robots known to be present; we receive messages of further robots and can't send them
/// questions.
const MAX_ROBOTS: usize = 100_000;

#[derive(Default)]
pub(super) struct Present {
    robots: HashMap<RobotId, Seat>,
    /// The number of the newest connection.
    connections: u64,
}

struct Seat {
    /// Start and connection that the robot named; `None` while unknown.
    position: Option<(u64, u64)>,
    number: u64,
}

/// Changes of the robot's connections that follow from a message, by our numbers.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Turn {
    /// This connection has ended.
    pub(super) ended: Option<u64>,
    /// This connection has begun, after that.
    pub(super) begun: Option<u64>,
}

impl Present {
    /// The robot published its status, or the broker did in its name. A status of an older
    /// connection than the known one is late and ignored.
    pub(super) fn status(&mut self, robot: &RobotId, status: &Status) -> Turn {
        let position = Some((status.start, status.connection));
        let Some(seat) = self.robots.get_mut(robot) else {
            return if status.online { self.enter(robot, position) } else { Turn::default() };
        };
        if position < seat.position {
            return Turn::default();
        }
        let ended = Some(seat.number);
        if !status.online {
            self.robots.remove(robot);
            return Turn { ended, begun: None };
        }
        if seat.position.is_none() || position == seat.position {
            seat.position = position;
            return Turn::default();
        }
        Turn { ended, ..self.enter(robot, position) }
    }

    /// The robot published another message: the robot is present, even if its status was lost.
    pub(super) fn heard(&mut self, robot: &RobotId) -> Turn {
        if self.robots.contains_key(robot) { Turn::default() } else { self.enter(robot, None) }
    }

    /// The server treats the robot as gone. Returns its connection.
    pub(super) fn forget(&mut self, robot: &RobotId) -> Option<u64> {
        self.robots.remove(robot).map(|seat| seat.number)
    }

    /// Clears all presence. Returns the robots that were present.
    pub(super) fn clear(&mut self) -> Vec<(RobotId, u64)> {
        self.robots.drain().map(|(robot, seat)| (robot, seat.number)).collect()
    }

    /// The robot's current connection.
    pub(super) fn connection(&self, robot: &RobotId) -> Option<u64> {
        self.robots.get(robot).map(|seat| seat.number)
    }

    pub(super) fn contains(&self, robot: &RobotId) -> bool {
        self.robots.contains_key(robot)
    }

    pub(super) fn count(&self) -> usize {
        self.robots.len()
    }

    fn enter(&mut self, robot: &RobotId, position: Option<(u64, u64)>) -> Turn {
        if self.robots.len() >= MAX_ROBOTS && !self.robots.contains_key(robot) {
            return Turn::default();
        }
        self.connections += 1;
        let number = self.connections;
        self.robots.insert(robot.clone(), Seat { position, number });
        Turn { ended: None, begun: Some(number) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::InstanceId;

    fn status(online: bool, start: u64, connection: u64) -> Status {
        Status { online, start, instance: InstanceId::random(), connection, place: None }
    }

    fn turn(ended: impl Into<Option<u64>>, begun: impl Into<Option<u64>>) -> Turn {
        Turn { ended: ended.into(), begun: begun.into() }
    }

    #[test]
    fn a_robot_is_there_from_its_status_to_its_will() {
        let (mut present, robot) = (Present::default(), RobotId::random());
        assert_eq!(
            present.status(&robot, &status(false, 1, 1)),
            turn(None, None),
            "nobody was there"
        );
        assert_eq!(present.status(&robot, &status(true, 1, 1)), turn(None, 1));
        assert_eq!(
            present.status(&robot, &status(true, 1, 1)),
            turn(None, None),
            "it repeats itself"
        );
        assert!(present.contains(&robot));
        assert_eq!(present.status(&robot, &status(false, 1, 1)), turn(1, None));
        assert_eq!(present.count(), 0);
    }

    #[test]
    fn the_will_of_an_older_connection_comes_too_late() {
        let (mut present, robot) = (Present::default(), RobotId::random());
        present.status(&robot, &status(true, 3, 1));
        assert_eq!(present.status(&robot, &status(true, 3, 2)), turn(1, 2));
        for late in [status(false, 3, 1), status(false, 2, 9), status(true, 3, 1)] {
            assert_eq!(present.status(&robot, &late), turn(None, None), "{late:?}");
        }
        assert_eq!(present.status(&robot, &status(true, 4, 1)), turn(2, 3), "a restarted agent");
    }

    #[test]
    fn whoever_speaks_is_there() {
        let (mut present, robot) = (Present::default(), RobotId::random());
        assert_eq!(present.heard(&robot), turn(None, 1));
        assert_eq!(present.heard(&robot), turn(None, None));
        assert_eq!(
            present.status(&robot, &status(true, 5, 5)),
            turn(None, None),
            "now it has a name"
        );
        assert_eq!(present.status(&robot, &status(false, 5, 4)), turn(None, None));
        assert_eq!(present.clear(), [(robot.clone(), 1)]);
        assert_eq!(present.heard(&robot), turn(None, 2));
        assert_eq!(present.forget(&robot), Some(2));
    }
}
