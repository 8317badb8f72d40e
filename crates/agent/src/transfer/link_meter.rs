//! Measurements of the route to the server, taken from transfers: throughput, round-trip time, and
//! interruptions. Server and agent use them to choose how a package travels. This module measures
//! nothing itself and never reads the clock.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::messages::report::LinkFacts;
use tokio::time::Instant;

/// Shorter transfers are ignored: they measure the start of the connection more than its speed.
const MEASURED_BYTES: u64 = 64 * 1024;
/// Weight of the newest measurement against all earlier ones.
const NEWEST_SHARE: f64 = 0.3;
/// How long an interruption is remembered.
const MEMORY: Duration = Duration::from_secs(3600);
/// Most interruptions of each kind that are remembered.
const MAX_REMEMBERED: usize = 1000;

/// The measurements of one link. Clones share them.
#[derive(Debug, Clone, Default)]
pub struct LinkMeter(Arc<Mutex<Measured>>);

#[derive(Debug, Default)]
struct Measured {
    bytes_per_s: Option<f64>,
    round_trip_ms: Option<f64>,
    reconnects: VecDeque<Instant>,
    losses: VecDeque<Instant>,
}

impl LinkMeter {
    /// Records a transfer of `bytes` that took this long.
    pub fn transferred(&self, bytes: u64, took: Duration) {
        if bytes >= MEASURED_BYTES {
            let bytes_per_s = bytes as f64 / took.as_secs_f64().max(1e-6);
            let mut measured = self.measured();
            measured.bytes_per_s = Some(averaged(measured.bytes_per_s, bytes_per_s));
        }
    }

    /// Records the time from a short request to its answer.
    pub fn round_trip(&self, took: Duration) {
        let mut measured = self.measured();
        measured.round_trip_ms =
            Some(averaged(measured.round_trip_ms, took.as_secs_f64() * 1000.0));
    }

    /// Records that a session had to reconnect.
    pub fn reconnected(&self, now: Instant) {
        remember(&mut self.measured().reconnects, now);
    }

    /// Records an interrupted transfer.
    pub fn lost_transfer(&self, now: Instant) {
        remember(&mut self.measured().losses, now);
    }

    /// The known facts about the link; `None` before the first measurement.
    pub fn facts(&self, now: Instant) -> Option<LinkFacts> {
        let measured = self.measured();
        let recent = |events: &VecDeque<Instant>| {
            let count =
                events.iter().filter(|at| now.saturating_duration_since(**at) < MEMORY).count();
            u32::try_from(count).unwrap_or(u32::MAX)
        };
        let facts = LinkFacts {
            // A conversion from floating point saturates at the type's range.
            throughput_bytes_per_s: measured.bytes_per_s.map(|rate| rate.round() as u64),
            rtt_ms: measured.round_trip_ms.map(|ms| ms.round() as u32),
            reconnects: recent(&measured.reconnects),
            losses: recent(&measured.losses),
        };
        (facts != LinkFacts::default()).then_some(facts)
    }

    fn measured(&self) -> MutexGuard<'_, Measured> {
        // Every change under the lock is complete in itself.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whether `now` differs from `before` enough to report. Small differences do not count.
pub fn is_news(before: Option<&LinkFacts>, now: Option<&LinkFacts>) -> bool {
    let (Some(before), Some(now)) = (before, now) else { return before.is_some() != now.is_some() };
    let differs = |before: Option<u64>, now: Option<u64>, least: u64| match (before, now) {
        (Some(before), Some(now)) => {
            before.abs_diff(now) > least && before.max(now) > 2 * before.min(now)
        }
        (before, now) => before != now,
    };
    differs(before.throughput_bytes_per_s, now.throughput_bytes_per_s, 0)
        || differs(before.rtt_ms.map(u64::from), now.rtt_ms.map(u64::from), 20)
        || (before.reconnects, before.losses) != (now.reconnects, now.losses)
}

fn averaged(before: Option<f64>, newest: f64) -> f64 {
    before.map_or(newest, |before| before + NEWEST_SHARE * (newest - before))
}

fn remember(events: &mut VecDeque<Instant>, now: Instant) {
    while events.front().is_some_and(|at| now.saturating_duration_since(*at) >= MEMORY)
        || events.len() >= MAX_REMEMBERED
    {
        events.pop_front();
    }
    events.push_back(now);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn throughput_ignores_short_transfers_and_is_averaged() {
        let meter = LinkMeter::default();
        let now = Instant::now();
        meter.transferred(MEASURED_BYTES - 1, Duration::from_secs(100));
        assert_eq!(meter.facts(now), None);
        for (seconds, expected) in [(1, 1_000_000), (10, 730_000), (1, 811_000)] {
            meter.transferred(1_000_000, Duration::from_secs(seconds));
            assert_eq!(meter.facts(now).expect("measured").throughput_bytes_per_s, Some(expected));
        }
        meter.round_trip(Duration::from_millis(10));
        meter.round_trip(Duration::from_millis(20));
        assert_eq!(meter.facts(now).expect("measured").rtt_ms, Some(13));
        // Faster than the clock can measure.
        meter.transferred(u64::MAX, Duration::ZERO);
        assert!(meter.facts(now).expect("measured").throughput_bytes_per_s > Some(811_000));
    }

    #[test]
    fn interruptions_expire_after_an_hour_and_are_bounded() {
        let meter = LinkMeter::default();
        let start = Instant::now();
        for second in 0..4000 {
            meter.lost_transfer(start + Duration::from_secs(second));
        }
        meter.reconnected(start);
        let at = |seconds| meter.facts(start + Duration::from_secs(seconds));
        assert_eq!(at(3599).map(|facts| facts.reconnects), Some(1));
        let facts = at(4000).expect("losses");
        assert_eq!((facts.reconnects, facts.losses), (0, MAX_REMEMBERED as u32));
        assert_eq!(at(10_000), None);
    }

    #[test]
    fn small_link_changes_are_not_reported() {
        let facts = |rate, rtt, losses| LinkFacts {
            throughput_bytes_per_s: rate,
            rtt_ms: rtt,
            reconnects: 0,
            losses,
        };
        let before = facts(Some(1_000_000), Some(10), 0);
        for (now, news) in [
            (facts(Some(1_900_000), Some(29), 0), false),
            (facts(Some(2_100_000), Some(10), 0), true),
            (facts(Some(400_000), Some(10), 0), true),
            (facts(Some(1_000_000), Some(31), 0), true),
            (facts(Some(1_000_000), Some(10), 1), true),
            (facts(None, Some(10), 0), true),
        ] {
            assert_eq!(is_news(Some(&before), Some(&now)), news, "{now:?}");
        }
        assert!(is_news(None, Some(&before)) && !is_news(None, None));
    }
}
