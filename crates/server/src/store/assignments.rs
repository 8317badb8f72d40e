//! Assignments: each deployment's part for each robot, and which of them is desired.

/// What may be ordered about a task that a robot has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskOrder {
    /// Run it (again).
    Start,
    /// Stop it, keep it installed.
    Stop,
    /// Take it off the robot.
    Remove,
}
