//! Owns the pure rules and values of the fleet; it never does I/O, never waits and never reads a
//! clock.

pub mod broker_url;
pub mod delivery;
pub mod deployment;
pub mod happening;
pub mod person;
pub mod rollout;
