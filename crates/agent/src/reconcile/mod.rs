//! The driver that brings the robot to its desired state, the real effects, and the answers to
//! requests. It leaves each decision to `task`.

pub mod admission;
pub mod driver;
pub mod gate;
pub mod graph_requests;
pub mod request_verifier;
pub mod requests;
pub mod robot;
