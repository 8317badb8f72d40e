//! Rate limits for many keys: a steady rate with a burst. This module only counts; the caller
//! refuses.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Maximum keys with a count of their own. Beyond the limit, the key closest to its rest is
/// forgotten.
const MOST_KEYS: usize = 10_000;

/// A rate that applies to each key.
#[derive(Debug)]
pub struct Pace {
    every: Duration,
    at_once: u32,
    /// The due time of a key's next action if actions were evenly spaced.
    due: Mutex<HashMap<String, Instant>>,
}

impl Pace {
    /// One action in each `every`; after a rest a burst of `at_once`.
    pub fn new(every: Duration, at_once: u32) -> Self {
        Self { every, at_once: at_once.max(1), due: Mutex::default() }
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
        let wait = (at - now).saturating_sub(self.every * (self.at_once - 1));
        if !wait.is_zero() {
            return Err(wait);
        }
        if due.len() >= MOST_KEYS && !due.contains_key(key) {
            due.retain(|_, at| *at > now);
            let least = due.iter().min_by_key(|(_, at)| **at).map(|(key, _)| key.clone());
            if let Some(least) = least.filter(|_| due.len() >= MOST_KEYS) {
                due.remove(&least);
            }
        }
        due.insert(key.to_owned(), at + self.every);
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
    fn some_may_come_at_once_and_then_one_at_a_time() {
        let (pace, now) = (Pace::new(Duration::from_secs(10), 3), Instant::now());
        assert_eq!([(); 4].map(|()| pace.take("a", now).is_ok()), [true, true, true, false]);
        assert_eq!(pace.take("a", now), Err(Duration::from_secs(10)));
        assert_eq!(pace.take("b", now), Ok(()), "another key has its own");
        let later = now + Duration::from_secs(10);
        assert_eq!((pace.take("a", later), pace.take("a", later).is_ok()), (Ok(()), false));
        let rested = later + Duration::from_secs(3600);
        assert_eq!([(); 4].map(|()| pace.take("a", rested).is_ok()), [true, true, true, false]);
    }

    #[test]
    fn keys_are_bounded_and_the_busiest_stay() {
        let (pace, now) = (Pace::new(Duration::from_secs(60), 2), Instant::now());
        assert_eq!([(); 3].map(|()| pace.take("busy", now).is_ok()), [true, true, false]);
        for number in 0..2 * MOST_KEYS {
            assert_eq!(pace.take(&number.to_string(), now), Ok(()));
        }
        assert_eq!(pace.due.lock().expect("not poisoned").len(), MOST_KEYS);
        assert!(pace.take("busy", now).is_err());
    }
}
