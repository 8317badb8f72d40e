//! Owns what is known of robots in memory only; it never stores anything and never decides what a
//! robot should run.

pub mod live_nodes;
pub mod part_requests;
pub mod presence;
pub mod requests;
pub mod robot_logs;
pub mod robot_presence;
pub mod robot_vitals;
pub mod sessions_elsewhere;
pub mod shared_presence;
