//! The time of a decision and the waits between attempts. Pure: time and randomness are values.

/// The first wait of a backoff.
pub const BACKOFF_BASE_MS: u64 = 1000;

/// The time at which something is decided, and the chance in the decision.
#[derive(Debug, Clone, Copy)]
pub struct Moment<'a> {
    /// The kernel's boot id.
    pub boot_id: &'a str,
    /// Milliseconds since the boot that `boot_id` names.
    pub now_ms: u64,
    /// Uniform from 0 to 1; spreads the retries.
    pub jitter: f64,
}

impl Moment<'_> {
    /// The time of the next attempt after the `attempt`th failure, at least [`BACKOFF_BASE_MS`] from
    /// now.
    pub fn retry_at(&self, attempt: u32, max_ms: u64) -> u64 {
        self.now_ms + backoff_ms(attempt, max_ms, self.jitter).max(BACKOFF_BASE_MS)
    }
}

/// Exponential backoff with full jitter: the wait after the `attempt`th failure. `jitter` is
/// uniform from 0 to 1.
pub fn backoff_ms(attempt: u32, max_ms: u64, jitter: f64) -> u64 {
    let ceiling = BACKOFF_BASE_MS.saturating_mul(1 << attempt.clamp(1, 20)).min(max_ms);
    // Rounding a positive number below 2^32 loses nothing that matters.
    (ceiling as f64 * jitter.clamp(0.0, 1.0)) as u64
}
