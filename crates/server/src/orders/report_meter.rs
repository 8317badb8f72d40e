//! Number and duration of the reports stored in the last minute: counted in bins that grow by a
//! fifth, so that counting one is an addition. The meter only counts.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use task_proto::api::ReportStatus;
use tokio::time::Instant;

/// The window of the figures, in slots of which the oldest is dropped.
const SLOTS: usize = 12;
const SLOT: Duration = Duration::from_secs(5);
/// Histogram bins by duration, the first up to [`FIRST_MS`], each further one longer by [`GROWTH`];
/// the last bin holds all longer durations.
const BINS: usize = 64;
const FIRST_MS: f64 = 0.1;
const GROWTH: f64 = 1.2;

/// Counts stored reports. Clones count together.
#[derive(Debug, Clone)]
pub struct ReportMeter {
    began: Instant,
    slots: Arc<Mutex<[Slot; SLOTS]>>,
}

#[derive(Debug, Clone, Copy)]
struct Slot {
    /// The slot's number since the start.
    number: u64,
    bins: [u32; BINS],
}

impl ReportMeter {
    pub fn new(now: Instant) -> Self {
        let slots = std::array::from_fn(|_| Slot { number: 0, bins: [0; BINS] });
        Self { began: now, slots: Arc::new(Mutex::new(slots)) }
    }

    /// Counts a report that was stored `took` after its arrival.
    pub fn stored(&self, now: Instant, took: Duration) {
        let number = self.slot(now);
        let mut slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        let slot = &mut slots[number as usize % SLOTS];
        if slot.number != number {
            *slot = Slot { number, bins: [0; BINS] };
        }
        let bin = (took.as_secs_f64() * 1000.0 / FIRST_MS).max(1.0).log(GROWTH).ceil() as usize;
        slot.bins[bin.min(BINS - 1)] += 1;
    }

    /// Figures of the last minute.
    pub fn read(&self, now: Instant) -> ReportStatus {
        let number = self.slot(now);
        let mut bins = [0u64; BINS];
        for slot in self.slots.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            if slot.number + SLOTS as u64 > number {
                bins.iter_mut().zip(slot.bins).for_each(|(sum, count)| *sum += u64::from(count));
            }
        }
        let all: u64 = bins.iter().sum();
        let (window, lasted) =
            (SLOT.as_secs_f64() * SLOTS as f64, now.duration_since(self.began).as_secs_f64());
        let of = |share: f64| {
            let wanted = (all as f64 * share).ceil() as u64;
            let mut seen = 0;
            let bin = bins.iter().position(|count| {
                seen += count;
                seen >= wanted
            })?;
            let exponent = i32::try_from(bin).unwrap_or(i32::MAX);
            (all > 0).then(|| (FIRST_MS * GROWTH.powi(exponent) * 10.0).round() / 10.0)
        };
        let per_s = (all as f64 / window.min(lasted.max(1.0)) * 10.0).round() / 10.0;
        ReportStatus { per_s, latency_ms_p50: of(0.5), latency_ms_p99: of(0.99) }
    }

    fn slot(&self, now: Instant) -> u64 {
        now.duration_since(self.began).as_secs() / SLOT.as_secs()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn meter_counts_only_the_last_minute() {
        let began = Instant::now();
        let meter = ReportMeter::new(began);
        assert_eq!(meter.read(began), ReportStatus::default());
        let at = |seconds: u64| began + Duration::from_secs(seconds);
        for second in 0..60 {
            for _ in 0..99 {
                meter.stored(at(second), Duration::from_millis(2));
            }
            meter.stored(at(second), Duration::from_millis(40));
        }
        let seen = meter.read(at(59));
        assert!((95.0..=105.0).contains(&seen.per_s), "{seen:?}");
        assert!(seen.latency_ms_p50.is_some_and(|ms| (2.0..2.5).contains(&ms)), "{seen:?}");
        meter.stored(at(59), Duration::from_secs(3600));
        assert!(
            meter.read(at(59)).latency_ms_p99.is_some_and(|ms| ms < 50.0),
            "one of six thousand"
        );
        assert_eq!(meter.read(at(200)).latency_ms_p50, None);
    }
}
