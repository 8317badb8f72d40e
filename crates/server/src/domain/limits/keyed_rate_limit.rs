//! Rate limits for many keys: a steady rate with a burst. This module only counts; the caller
//! refuses.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Maximum keys with a count of their own. Beyond the limit, the key closest to its rest is
/// forgotten.
const MAX_KEYS: usize = 10_000;

/// A rate that applies to each key.
#[derive(Debug)]
pub struct KeyedRateLimit {
    interval: Duration,
    burst: u32,
    /// The due time of a key's next action if actions were evenly spaced.
    due: Mutex<HashMap<String, Instant>>,
}

impl KeyedRateLimit {
    /// One action in each `interval`; after a rest a burst of `burst`.
    pub fn new(interval: Duration, burst: u32) -> Self {
        Self { interval, burst: burst.max(1), due: Mutex::default() }
    }

    /// This many actions per minute; after a rest a burst of ten seconds' worth.
    pub fn per_minute(count: u64) -> Self {
        let count = u32::try_from(count.max(1)).unwrap_or(u32::MAX);
        Self::new(Duration::from_secs(60) / count, count / 6)
    }

    /// Counts one action of `key`. If the action has to wait, nothing is counted and the error is
    /// the wait.
    pub fn take(&self, key: &str, now: Instant) -> Result<(), Duration> {
        let mut due = self.due.lock().unwrap_or_else(PoisonError::into_inner);
        let at = due.get(key).map_or(now, |at| (*at).max(now));
        let wait = (at - now).saturating_sub(self.interval * (self.burst - 1));
        if !wait.is_zero() {
            return Err(wait);
        }
        if due.len() >= MAX_KEYS && !due.contains_key(key) {
            due.retain(|_, at| *at > now);
            let earliest = due.iter().min_by_key(|(_, at)| **at).map(|(key, _)| key.clone());
            if let Some(earliest) = earliest.filter(|_| due.len() >= MAX_KEYS) {
                due.remove(&earliest);
            }
        }
        due.insert(key.to_owned(), at + self.interval);
        Ok(())
    }
}

/// A wait in whole seconds, at least one.
pub fn seconds(wait: Duration) -> u64 {
    wait.as_secs().max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn burst_is_admitted_then_one_action_per_interval() {
        let (limit, now) = (KeyedRateLimit::new(Duration::from_secs(10), 3), Instant::now());
        assert_eq!([(); 4].map(|()| limit.take("a", now).is_ok()), [true, true, true, false]);
        assert_eq!(limit.take("a", now), Err(Duration::from_secs(10)));
        assert_eq!(limit.take("b", now), Ok(()), "another key has its own");
        let later = now + Duration::from_secs(10);
        assert_eq!((limit.take("a", later), limit.take("a", later).is_ok()), (Ok(()), false));
        let rested = later + Duration::from_secs(3600);
        assert_eq!([(); 4].map(|()| limit.take("a", rested).is_ok()), [true, true, true, false]);
    }

    #[test]
    fn keys_are_bounded_and_the_busiest_stay() {
        let (limit, now) = (KeyedRateLimit::new(Duration::from_secs(60), 2), Instant::now());
        assert_eq!([(); 3].map(|()| limit.take("busy", now).is_ok()), [true, true, false]);
        for number in 0..2 * MAX_KEYS {
            assert_eq!(limit.take(&number.to_string(), now), Ok(()));
        }
        assert_eq!(limit.due.lock().expect("not poisoned").len(), MAX_KEYS);
        assert!(limit.take("busy", now).is_err());
    }
}
