//! Owns the counters that bound callers and log lines; it never touches a socket and never reads a
//! clock.

pub mod conduct;
pub mod log_limits;
pub mod pace;
pub mod rate_limit;
