//! Owns the time of the operator's machine, and is the only module that reads it; it never waits.

use std::time::{SystemTime, UNIX_EPOCH};

/// Milliseconds since the Unix epoch; zero on a machine whose clock is earlier than that.
#[expect(clippy::disallowed_methods, reason = "this is the one module that reads the time")]
pub(crate) fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// The time in the form that certificate checks use.
pub(crate) fn for_certificates() -> task_transport::Clock {
    task_transport::Clock::new(now_ms)
}
