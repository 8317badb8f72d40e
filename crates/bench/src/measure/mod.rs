//! Owns the clients and phases that are timed; it never draws a result and never drops a failure.

pub(crate) mod downloads;
pub(crate) mod mqtt;
pub mod phase;
