//! Limits log lines about refused connections, because any client can cause them: one line a minute
//! of each kind, with the count of the others. This module writes no line.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Minimum time between two lines.
const INTERVAL: Duration = Duration::from_secs(60);

/// When the last line of one kind was written, and the number of refusals since.
#[derive(Debug, Default)]
pub struct RefusalLog(Mutex<Lines>);

#[derive(Debug, Default)]
struct Lines {
    last: Option<Instant>,
    unreported: u64,
}

impl RefusalLog {
    /// Counts a refusal at `now`. Returns the number of refusals without a line, if a line is due.
    pub fn refused(&self, now: Instant) -> Option<u64> {
        let mut lines = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if lines.last.is_some_and(|last| now.duration_since(last) < INTERVAL) {
            lines.unreported += 1;
            return None;
        }
        lines.last = Some(now);
        Some(std::mem::take(&mut lines.unreported))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refused_clients_get_one_line_a_minute_with_the_count_of_the_others() {
        let (log, begun) = (RefusalLog::default(), Instant::now());
        assert_eq!(log.refused(begun), Some(0));
        assert_eq!(log.refused(begun + INTERVAL / 2), None);
        assert_eq!(log.refused(begun + INTERVAL * 9 / 10), None);
        assert_eq!(log.refused(begun + INTERVAL), Some(2));
        assert_eq!(log.refused(begun + INTERVAL * 3), Some(0));
    }
}
