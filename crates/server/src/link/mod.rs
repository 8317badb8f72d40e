//! Owns the traffic with robots, from their credentials to the packages they receive; it never
//! decides what a robot should run.

pub mod downlink;
pub mod fan_out;
pub mod gatekeeper;
pub mod mqtt_access;
pub mod transfers;
pub mod uplink;
