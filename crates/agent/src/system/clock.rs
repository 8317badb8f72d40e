//! The only place that reads the time. Waits and elapsed times use milliseconds since boot, suspend
//! included, because a robot's wall clock may jump. The wall clock only serves to check whether a
//! signed state or a certificate has expired.

use std::io;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use task_proto::time::millis;

/// Milliseconds since the kernel booted; comparable between processes of one boot.
pub fn boot_ms() -> u64 {
    // Without /proc no process could be supervised either, and the agent has reported this at its
    // start.
    uptime().map_or(0, millis)
}

/// The kernel's id of this boot.
pub fn boot_id() -> io::Result<String> {
    Ok(std::fs::read_to_string("/proc/sys/kernel/random/boot_id")?.trim().to_owned())
}

/// Time since the machine booted, suspended time included: the clock of process start times.
pub fn uptime() -> io::Result<Duration> {
    let text = std::fs::read_to_string("/proc/uptime")?;
    let seconds = text.split_ascii_whitespace().next().and_then(|first| first.parse().ok());
    seconds
        .map(Duration::from_secs_f64)
        .ok_or_else(|| io::Error::other("/proc/uptime is not a number of seconds"))
}

/// Milliseconds since the Unix epoch, by the robot's wall clock.
#[expect(clippy::disallowed_methods, reason = "this is the clock")]
pub fn wall_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, millis)
}

/// Milliseconds since the Unix epoch before which this program did not exist: a wall clock that
/// shows less is wrong.
pub const PROGRAM_EXISTS_SINCE_MS: u64 = task_transport::BUILT_MS;

/// The wall clock for checking certificates.
pub fn for_certificates() -> task_transport::Clock {
    task_transport::Clock::new(wall_ms)
}
