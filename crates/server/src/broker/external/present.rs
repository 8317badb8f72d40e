//! Who is at an external broker, as far as robots say so themselves: by their `status`, which ends
//! with their last will, and by everything else they publish. Pure; it neither reads messages nor
//! tells anyone.

use std::collections::HashMap;

use task_proto::RobotId;
use task_proto::report::Status;

/// Robots known to be there at most; further ones are heard and can't be asked anything.
const MAX_ROBOTS: usize = 100_000;

/// The robots that are there.
#[derive(Default)]
pub(super) struct Present {
    robots: HashMap<RobotId, Seat>,
    /// The number of the newest connection.
    connections: u64,
}

struct Seat {
    /// Start and connection that the robot named; `None` while it has not.
    position: Option<(u64, u64)>,
    number: u64,
}

/// What a message says about the robot's connections, by our numbers.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Turn {
    /// This one has ended.
    pub(super) ended: Option<u64>,
    /// This one has begun, after that.
    pub(super) begun: Option<u64>,
}

impl Present {
    /// The robot published its status, or the broker did in its name. One that names an older
    /// connection than is known comes too late.
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

    /// The robot published something else: it is there, even if its status was lost.
    pub(super) fn heard(&mut self, robot: &RobotId) -> Turn {
        if self.robots.contains_key(robot) { Turn::default() } else { self.enter(robot, None) }
    }

    /// The robot may no longer be there as far as we are concerned. Gives its connection.
    pub(super) fn forget(&mut self, robot: &RobotId) -> Option<u64> {
        self.robots.remove(robot).map(|seat| seat.number)
    }

    /// Nothing is known any more. Gives who was there.
    pub(super) fn clear(&mut self) -> Vec<(RobotId, u64)> {
        self.robots.drain().map(|(robot, seat)| (robot, seat.number)).collect()
    }

    /// The connection by which the robot is there.
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
