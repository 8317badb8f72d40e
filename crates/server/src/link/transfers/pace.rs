//! Bandwidth pacing: a token bucket that returns the due time of the next bytes. Requests are
//! served in order, so transfers that take turns get equal shares. This module never waits.

use std::time::Duration;

use tokio::time::Instant;

/// Burst after a pause.
const BURST: Duration = Duration::from_millis(100);
/// The largest and the smallest piece of a request.
const MAX_PIECE_BYTES: u64 = 256 * 1024;
const MIN_PIECE_BYTES: u64 = 1024;
/// Target number of pieces per second for each transfer: long pauses would look like a dead
/// connection.
const PIECES_PER_S: u64 = 4;

/// One limit on bytes per second.
#[derive(Debug)]
pub(super) struct Pace {
    bytes_per_s: u64,
    next_at: Instant,
}

impl Pace {
    pub(super) fn new(bytes_per_s: u64, now: Instant) -> Self {
        Self { bytes_per_s: bytes_per_s.max(1), next_at: now }
    }

    /// The number of bytes that one of `transfers` should request at a time.
    pub(super) fn piece(&self, transfers: u64) -> u64 {
        (self.bytes_per_s / PIECES_PER_S / transfers.max(1)).clamp(MIN_PIECE_BYTES, MAX_PIECE_BYTES)
    }

    /// The due time of the next `bytes`; they count as sent.
    pub(super) fn reserve(&mut self, bytes: u64, now: Instant) -> Instant {
        let at = self.next_at.max(now.checked_sub(BURST).unwrap_or(now));
        self.next_at = at + Duration::from_secs_f64(bytes as f64 / self.bytes_per_s as f64);
        at.max(now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pace_limits_bytes_and_idle_time_is_not_saved() {
        let now = Instant::now();
        let mut pace = Pace::new(1_000_000, now);
        assert_eq!(
            pace.reserve(500_000, now + Duration::from_secs(60)),
            now + Duration::from_secs(60)
        );
        let later = now + Duration::from_secs(60);
        assert_eq!(pace.reserve(500_000, later), later + Duration::from_millis(400));
        assert_eq!(pace.reserve(1, later), later + Duration::from_millis(900));
    }

    #[test]
    fn pieces_shrink_with_the_number_of_transfers() {
        let pace = Pace::new(4_000_000, Instant::now());
        assert_eq!(
            (pace.piece(1), pace.piece(10), pace.piece(100_000)),
            (256 * 1024, 100_000, 1024)
        );
    }
}
