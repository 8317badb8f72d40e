//! The message rate of a topic of any type: samples are counted, not read.

use std::collections::VecDeque;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use tokio::sync::watch;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::ros::graph::dds::endpoint::{Counted, Reader};

/// Time span over which samples are counted.
pub const WINDOW: Duration = Duration::from_secs(5);
/// Maximum number of samples that are remembered; for a faster topic the window is shorter.
const MAX_SAMPLES: usize = 4096;

/// Counts the messages of one topic until it is dropped.
pub struct Counter {
    arrivals: Arc<Mutex<Arrivals>>,
    _ends_with_this: DropGuard,
}

/// The last reported message rate of a topic. Counting ends when the meter is dropped.
pub struct RateMeter {
    last: watch::Receiver<(Rate, Instant)>,
    _ends_with_this: DropGuard,
}

/// A topic's rate at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rate {
    /// Messages a second over the last [`WINDOW`], or since the meter was made if that is shorter.
    pub hz: f64,
    /// Time since the last message; `None`: there was none.
    pub since_last: Option<Duration>,
    /// Messages since the meter was made.
    pub samples: u64,
}

impl Rate {
    /// The rate of a topic without data.
    pub(super) const NONE: Self = Self { hz: 0.0, since_last: None, samples: 0 };
}

#[derive(Debug)]
struct Arrivals {
    since: Instant,
    recent: VecDeque<Instant>,
    samples: u64,
}

impl Counter {
    /// Counts the samples of this reader; the returned future does the work.
    pub(super) fn new(
        reader: Reader<Counted>,
        closing: &CancellationToken,
    ) -> (Self, impl Future<Output = ()> + Send + use<>) {
        let arrivals = Arc::new(Mutex::new(Arrivals::since(Instant::now())));
        let ending = closing.child_token();
        let meter =
            Self { arrivals: arrivals.clone(), _ends_with_this: ending.clone().drop_guard() };
        (meter, count(reader, arrivals, ending))
    }

    pub fn rate(&self) -> Rate {
        self.arrivals.lock().unwrap_or_else(PoisonError::into_inner).rate(Instant::now())
    }
}

impl RateMeter {
    /// A meter for the rate in `last`, with the time of its report. `ending` is cancelled when the
    /// meter is dropped.
    pub(super) fn new(last: watch::Receiver<(Rate, Instant)>, ending: CancellationToken) -> Self {
        Self { last, _ends_with_this: ending.drop_guard() }
    }

    pub fn rate(&self) -> Rate {
        let (rate, at) = *self.last.borrow();
        Rate { since_last: rate.since_last.map(|since| since + at.elapsed()), ..rate }
    }
}

async fn count(reader: Reader<Counted>, arrivals: Arc<Mutex<Arrivals>>, ending: CancellationToken) {
    let mut samples = pin!(reader.samples());
    while let Some(Some(_)) = ending.run_until_cancelled(samples.next()).await {
        arrivals.lock().unwrap_or_else(PoisonError::into_inner).arrived(Instant::now());
    }
}

impl Arrivals {
    fn since(since: Instant) -> Self {
        Self { since, recent: VecDeque::new(), samples: 0 }
    }

    fn arrived(&mut self, now: Instant) {
        if self.recent.len() == MAX_SAMPLES {
            self.recent.pop_front();
        }
        self.recent.push_back(now);
        self.samples += 1;
    }

    fn rate(&self, now: Instant) -> Rate {
        let window = WINDOW.min(now.duration_since(self.since));
        // With more samples than are remembered, the window is the time that they span.
        let window = match self.recent.front() {
            Some(first) if self.recent.len() == MAX_SAMPLES => {
                window.min(now.duration_since(*first))
            }
            _ => window,
        };
        let counted = self.recent.iter().filter(|at| now.duration_since(**at) <= window).count();
        #[expect(clippy::cast_precision_loss, reason = "at most 4096")]
        let hz = if window.is_zero() { 0.0 } else { counted as f64 / window.as_secs_f64() };
        Rate {
            hz,
            since_last: self.recent.back().map(|last| now.duration_since(*last)),
            samples: self.samples,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_is_measured_over_the_window() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut arrivals = Arrivals::since(start);
        assert_eq!(arrivals.rate(start), Rate { hz: 0.0, since_last: None, samples: 0 });
        for number in 1..=100 {
            arrivals.arrived(at(number * 100));
        }
        let rate = arrivals.rate(at(10_000));
        assert!((rate.hz - 10.0).abs() < 0.5, "{rate:?}");
        let later = arrivals.rate(at(12_500));
        assert!((later.hz - 5.0).abs() < 0.5, "{later:?}");
        assert_eq!((later.since_last, later.samples), (Some(Duration::from_millis(2500)), 100));
        assert_eq!(arrivals.rate(at(60_000)).hz, 0.0);
    }

    #[test]
    fn samples_of_a_fast_topic_are_bounded() {
        let start = Instant::now();
        let mut arrivals = Arrivals::since(start);
        for number in 1..=20_000_u64 {
            arrivals.arrived(start + Duration::from_micros(number * 200));
        }
        assert_eq!(arrivals.recent.len(), MAX_SAMPLES);
        let rate = arrivals.rate(start + Duration::from_secs(4));
        assert!((rate.hz - 5000.0).abs() < 10.0, "{rate:?}");
    }
}
