//! Owns data about a robot's machine and programs: log lines, the ROS graph, vitals; it never
//! takes part in a decision.

pub mod log;
pub mod ros;
pub mod vitals;
