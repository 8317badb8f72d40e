//! The current time, in milliseconds since the Unix epoch. No other module reads the system's
//! clock; code that needs the time gets a `Clock` or a number. This module never waits: waiting is
//! tokio's.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use task_proto::time::millis;

/// A source of the time. Clones of a fixed clock move together.
#[derive(Debug, Clone)]
pub struct Clock(Source);

#[derive(Debug, Clone)]
enum Source {
    System,
    Fixed(Arc<AtomicU64>),
}

impl Clock {
    pub fn system() -> Self {
        Self(Source::System)
    }

    /// The machine's clock in the form that certificate checks use.
    pub fn for_certificates() -> task_transport::Clock {
        task_transport::Clock::new(|| Self::system().now_ms())
    }

    /// A clock that stands at `now_ms` until [`Clock::advance_ms`] moves it.
    pub fn fixed(now_ms: u64) -> Self {
        Self(Source::Fixed(Arc::new(AtomicU64::new(now_ms))))
    }

    /// Milliseconds since the Unix epoch; zero on a machine whose clock is earlier than that.
    #[expect(clippy::disallowed_methods, reason = "this is the one module that reads the time")]
    pub fn now_ms(&self) -> u64 {
        match &self.0 {
            Source::System => SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, millis),
            Source::Fixed(now_ms) => now_ms.load(Ordering::SeqCst),
        }
    }

    /// Moves a fixed clock forward; no effect on the machine's clock.
    pub fn advance_ms(&self, by_ms: u64) {
        if let Source::Fixed(now_ms) = &self.0 {
            now_ms.fetch_add(by_ms, Ordering::SeqCst);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clones_of_a_fixed_clock_move_together() {
        let clock = Clock::fixed(1_000);
        let other = clock.clone();
        clock.advance_ms(500);
        assert_eq!(other.now_ms(), 1_500);
    }

    #[test]
    fn system_clock_is_past_2020() {
        assert!(Clock::system().now_ms() > 1_577_836_800_000);
    }
}
