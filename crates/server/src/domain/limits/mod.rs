//! Counters that bound callers. They never touch a socket and never read a clock.

pub mod keyed_rate_limit;
pub mod rate_limit;
pub mod robot_limiter;
