//! The driver brings the robot to its desired state through the real effects, and answers the server's requests. Decisions are `task`'s.

pub mod admission;
pub mod answers;
pub mod driver;
pub mod gate;
pub mod graph_answers;
pub mod orders;
pub mod robot;
