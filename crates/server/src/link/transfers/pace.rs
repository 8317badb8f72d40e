//! How fast bytes may go: a token bucket that says when the next ones are due. Who asks first goes
//! first, so transfers that take turns get equal shares. It never waits.

use std::time::Duration;

use tokio::time::Instant;

/// What may go at once after a pause.
const BURST: Duration = Duration::from_millis(100);
/// The largest and the smallest piece that is asked for at a time.
const MAX_PIECE_BYTES: u64 = 256 * 1024;
const MIN_PIECE_BYTES: u64 = 1024;
/// How many pieces a second each transfer should get: long pauses would look like a dead
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

    /// How many bytes one of `transfers` should ask for at a time.
    pub(super) fn piece(&self, transfers: u64) -> u64 {
        (self.bytes_per_s / PIECES_PER_S / transfers.max(1)).clamp(MIN_PIECE_BYTES, MAX_PIECE_BYTES)
    }

    /// When the next `bytes` may go; they count as gone.
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
    fn bytes_go_no_faster_than_the_pace_and_pauses_are_not_saved_up() {
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
    fn pieces_are_small_enough_for_all_to_get_some_every_second() {
        let pace = Pace::new(4_000_000, Instant::now());
        assert_eq!(
            (pace.piece(1), pace.piece(10), pace.piece(100_000)),
            (256 * 1024, 100_000, 1024)
        );
    }
}
