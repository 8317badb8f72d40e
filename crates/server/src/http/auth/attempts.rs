//! Failed authentications, counted per address in windows of a minute. A valid token is always
//! accepted; only the answers to wrong tokens change. Memory is bounded: beyond the most addresses,
//! all others share one count.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};

const WINDOW_MS: u64 = 60_000;
/// Failures per address and window that are answered in the ordinary way. The number is high
/// because a NAT may hide a fleet.
const MAX_FAILURES: u32 = 1_000;
const MAX_ADDRESSES: usize = 4_096;
/// The shared count of addresses beyond the limit.
const OTHER_ADDRESSES: IpAddr = IpAddr::V4(std::net::Ipv4Addr::UNSPECIFIED);

/// The counts of the current window.
#[derive(Debug, Default)]
pub struct FailedAttempts(Mutex<Window>);

#[derive(Debug, Default)]
struct Window {
    began_ms: u64,
    failures: HashMap<IpAddr, u32>,
}

impl FailedAttempts {
    /// Counts a failure from `address`. Returns true if the address has too many.
    pub fn record(&self, address: IpAddr, now_ms: u64) -> bool {
        let mut window = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if now_ms.saturating_sub(window.began_ms) >= WINDOW_MS {
            *window = Window { began_ms: now_ms, failures: HashMap::new() };
        }
        let is_full =
            window.failures.len() >= MAX_ADDRESSES && !window.failures.contains_key(&address);
        let count =
            window.failures.entry(if is_full { OTHER_ADDRESSES } else { address }).or_default();
        *count = count.saturating_add(1);
        *count > MAX_FAILURES
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failure_limit_is_per_address_and_ends_after_a_minute() {
        let attempts = FailedAttempts::default();
        let (one, other) = (IpAddr::from([10, 0, 0, 1]), IpAddr::from([10, 0, 0, 2]));
        for _ in 0..MAX_FAILURES {
            assert!(!attempts.record(one, 1_000_000));
        }
        assert!(attempts.record(one, 1_000_001));
        assert!(!attempts.record(other, 1_000_001));
        assert!(!attempts.record(one, 1_000_000 + WINDOW_MS));
    }

    #[test]
    fn many_addresses_take_no_more_memory() {
        let attempts = FailedAttempts::default();
        for n in 0..2 * MAX_ADDRESSES as u32 {
            attempts.record(IpAddr::from(n.to_be_bytes()), 1_000_000);
        }
        assert!(attempts.0.lock().expect("whole").failures.len() <= MAX_ADDRESSES + 1);
    }
}
