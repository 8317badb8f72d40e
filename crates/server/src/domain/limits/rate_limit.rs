//! Token buckets: a sustained rate and a burst after a rest. They read no clock and never wait:
//! they return the time of the next permitted action.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

/// Burst after a rest, as time at the rate.
pub const BURST: Duration = Duration::from_secs(10);
/// Maximum debt, as time at the rate: a larger debt after a storm would lock its sender out for
/// hours.
const MAX_DEBT: Duration = Duration::from_secs(10);
/// Maximum delay of a request; a request that would wait longer is refused.
pub const MAX_DELAY: Duration = Duration::from_secs(2);
/// Above this number of keys, rested keys are removed.
const SWEEP_ABOVE: usize = 1_024;

/// One limit. `next_at` is the due time of the next action if actions were evenly spaced; after a
/// rest it is in the past.
#[derive(Debug)]
pub struct TokenBucket {
    /// Time for one action at the rate.
    each_ns: f64,
    next_at: Instant,
}

impl TokenBucket {
    pub fn new(per_s: u64, now: Instant) -> Self {
        Self { each_ns: 1e9 / per_s.max(1) as f64, next_at: now.checked_sub(BURST).unwrap_or(now) }
    }

    /// Counts `number` more actions, and returns the time when they are due.
    pub fn take(&mut self, number: u64, now: Instant) -> Instant {
        let at = self.next_at.max(now.checked_sub(BURST).unwrap_or(now));
        self.next_at = (at + self.time_of(number)).min(now + MAX_DEBT);
        self.next_at
    }

    /// Returns actions that were taken last and not used.
    pub fn refund(&mut self, number: u64) {
        self.next_at -= self.time_of(number);
    }

    /// Whether the full burst is available.
    pub fn is_full(&self, now: Instant) -> bool {
        self.next_at + BURST <= now
    }

    fn time_of(&self, number: u64) -> Duration {
        // A value truncated at 2^64 still exceeds any limit.
        Duration::from_nanos((number as f64 * self.each_ns) as u64)
    }
}

/// The decision about a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Admission {
    /// The request may proceed at this time, which may be now.
    At(Instant),
    /// The delay would be too long: the request is refused, and may be retried at this time.
    Refused(Instant),
}

/// A bucket for each key. A rested key is soon removed from memory.
#[derive(Debug)]
pub struct RateLimiter<K> {
    per_s: u64,
    buckets: Mutex<HashMap<K, TokenBucket>>,
}

impl<K: Eq + Hash> RateLimiter<K> {
    /// A limiter with a rate of `per_s` for each key.
    pub fn new(per_s: u64) -> Self {
        Self { per_s, buckets: Mutex::default() }
    }

    /// Counts one more request. Refused requests don't count, so the next permitted time stays
    /// near, however many arrive at once.
    pub fn admit(&self, key: K, now: Instant) -> Admission {
        self.with(key, now, |bucket| match bucket.take(1, now) {
            until if until > now + MAX_DELAY => {
                bucket.refund(1);
                Admission::Refused(until)
            }
            until => Admission::At(until),
        })
    }

    /// Charges a request `number` more than was known on arrival.
    pub fn charge(&self, key: K, number: u64, now: Instant) {
        self.with(key, now, |bucket| bucket.take(number, now));
    }

    fn with<T>(&self, key: K, now: Instant, change: impl FnOnce(&mut TokenBucket) -> T) -> T {
        let mut buckets = self.buckets();
        if buckets.len() >= SWEEP_ABOVE && !buckets.contains_key(&key) {
            buckets.retain(|_, bucket| !bucket.is_full(now));
        }
        change(buckets.entry(key).or_insert_with(|| TokenBucket::new(self.per_s, now)))
    }

    fn buckets(&self) -> MutexGuard<'_, HashMap<K, TokenBucket>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.buckets.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn burst_then_the_rate_is_admitted_for_each_key() {
        let (limiter, start) = (RateLimiter::new(10), Instant::now());
        let served_in_second = |second: u32| {
            let now = start + SECOND * second;
            (0..500).filter(|_| matches!(limiter.admit("one", now), Admission::At(_))).count()
        };
        assert_eq!(served_in_second(0), 120, "ten seconds' worth at once, two more are delayed");
        assert_eq!((1..=10).map(served_in_second).sum::<usize>(), 100);
        assert_eq!(limiter.admit("other", start), Admission::At(start - BURST + SECOND / 10));
    }

    #[test]
    fn later_charge_delays_the_next_request() {
        let (limiter, now) = (RateLimiter::new(10), Instant::now());
        limiter.charge("one", 1_000_000, now);
        assert!(matches!(limiter.admit("one", now), Admission::Refused(_)));
        assert!(
            matches!(limiter.admit("one", now + MAX_DEBT), Admission::At(_)),
            "the debt is bounded"
        );
    }

    #[test]
    fn full_buckets_are_removed() {
        let (limiter, start) = (RateLimiter::new(10), Instant::now());
        for key in 0..SWEEP_ABOVE {
            limiter.admit(key, start);
        }
        limiter.admit(SWEEP_ABOVE, start + BURST + SECOND);
        assert_eq!(limiter.buckets().len(), 1);
    }
}
