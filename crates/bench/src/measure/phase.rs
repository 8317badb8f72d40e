//! Runs many robots' steps at once, and records latencies and failures of one phase. A failure is
//! never dropped.

use std::collections::BTreeMap;
use std::time::Duration;

use futures_util::StreamExt as _;

/// Time limit of a phase. A step that is unfinished by then has failed.
pub const PHASE_LIMIT: Duration = Duration::from_secs(300);

/// Duration of one robot's step, or why the step failed.
pub type Sample = anyhow::Result<Duration>;

/// Runs `steps`, at most `at_once` at a time, until all are done or `limit` is over.
pub async fn run_all<T>(
    at_once: usize,
    limit: Duration,
    steps: impl IntoIterator<Item = impl Future<Output = anyhow::Result<T>>>,
) -> Vec<anyhow::Result<T>> {
    let deadline = tokio::time::Instant::now() + limit;
    let steps = steps.into_iter().map(|step| async move {
        let in_time = tokio::time::timeout_at(deadline, step).await;
        in_time.unwrap_or_else(|_| {
            Err(anyhow::anyhow!("not done after the {limit:?} that the phase may take"))
        })
    });
    futures_util::stream::iter(steps).buffer_unordered(at_once).collect().await
}

/// Measurements of a phase.
pub struct Phase {
    pub name: &'static str,
    /// From its start to the end of its last step.
    pub wall: Duration,
    /// Number of failures by message.
    pub failures: BTreeMap<String, usize>,
    /// Durations of the successful steps, the shortest first.
    latencies: Vec<Duration>,
}

impl Phase {
    /// A phase that took `wall`.
    pub fn new(
        name: &'static str,
        wall: Duration,
        samples: impl IntoIterator<Item = Sample>,
    ) -> Self {
        let mut phase = Self { name, wall, failures: BTreeMap::new(), latencies: Vec::new() };
        for sample in samples {
            match sample {
                Ok(latency) => phase.latencies.push(latency),
                Err(error) => *phase.failures.entry(format!("{error:#}")).or_default() += 1,
            }
        }
        phase.latencies.sort_unstable();
        phase
    }

    /// All steps, failed ones included.
    pub fn count(&self) -> usize {
        self.latencies.len() + self.failed()
    }

    /// The steps that failed.
    pub fn failed(&self) -> usize {
        self.failures.values().sum()
    }

    /// The latency in milliseconds that `percent` of the successful steps did not exceed; `None` if
    /// none succeeded.
    pub fn percentile_ms(&self, percent: usize) -> Option<f64> {
        percentile(&self.latencies, percent).map(|latency| latency.as_micros() as f64 / 1000.0)
    }
}

/// The value that `percent` of the sorted values did not exceed; `None` if there are no values.
pub fn percentile<T: Copy>(sorted: &[T], percent: usize) -> Option<T> {
    sorted.get((sorted.len() * percent).div_ceil(100).max(1) - 1).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_latencies_that_occurred() {
        let phase = |n: u64| {
            Phase::new("x", Duration::ZERO, (1..=n).rev().map(|ms| Ok(Duration::from_millis(ms))))
        };
        assert_eq!(
            [50, 99, 100].map(|p| phase(200).percentile_ms(p)),
            [Some(100.0), Some(198.0), Some(200.0)]
        );
        assert_eq!([50, 99, 100].map(|p| phase(1).percentile_ms(p)), [Some(1.0); 3]);
        assert_eq!(phase(0).percentile_ms(50), None);
    }

    #[tokio::test]
    async fn failures_and_timeouts_are_counted() {
        let steps = (0..4).map(|n| async move {
            match n {
                0 => std::future::pending().await,
                1 => Ok(Duration::from_secs(1)),
                _ => anyhow::bail!("refused"),
            }
        });
        let phase =
            Phase::new("x", Duration::ZERO, run_all(4, Duration::from_millis(50), steps).await);
        assert_eq!((phase.count(), phase.failed(), phase.failures["refused"]), (4, 3, 2));
        assert!(
            phase.failures.keys().any(|text| text.contains("not done after the 50ms")),
            "{:?}",
            phase.failures
        );
    }
}
