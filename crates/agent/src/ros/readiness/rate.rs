//! The message rate of a topic, computed from a count that only grows. Pure.

use std::collections::VecDeque;

/// Shortest window over which messages are counted.
const MIN_WINDOW_MS: u64 = 2000;
/// Longest window, for topics with rare messages.
const MAX_WINDOW_MS: u64 = 120_000;
/// Desired number of messages in a window.
const MESSAGES: f64 = 4.0;
/// Maximum number of counts that are kept.
const MAX_COUNTS: usize = 256;

/// The counts of one topic over a window of time.
#[derive(Debug, Clone)]
pub(super) struct Rate {
    min_hz: f64,
    window_ms: u64,
    counts: VecDeque<(u64, u64)>,
}

impl Rate {
    /// The rate of a topic that must carry `min_hz` messages a second.
    pub(super) fn of(min_hz: f64) -> Self {
        // A rate is above zero, and the clamp limits values out of range.
        let window_ms = (MESSAGES / min_hz * 1000.0) as u64;
        Self {
            min_hz,
            window_ms: window_ms.clamp(MIN_WINDOW_MS, MAX_WINDOW_MS),
            counts: VecDeque::new(),
        }
    }

    pub(super) fn min_hz(&self) -> f64 {
        self.min_hz
    }

    /// Records that `count` messages have come until now.
    pub(super) fn record(&mut self, count: u64, now_ms: u64) {
        if self.counts.back().is_some_and(|(_, last)| *last > count) {
            self.counts.clear();
        }
        let apart_ms = self.window_ms / (MAX_COUNTS as u64 / 2);
        let last_ms = self.counts.back().map(|(at, _)| *at);
        if last_ms.is_none_or(|last_ms| now_ms >= last_ms + apart_ms) {
            self.counts.push_back((now_ms, count));
        }
        while self.counts.get(1).is_some_and(|(at, _)| now_ms.saturating_sub(*at) >= self.window_ms)
            || self.counts.len() > MAX_COUNTS
        {
            self.counts.pop_front();
        }
    }

    /// Messages a second over the last window; `None`: the topic has not been watched for that
    /// long.
    pub(super) fn hz(&self) -> Option<f64> {
        let ((first_ms, first), (last_ms, last)) = (self.counts.front()?, self.counts.back()?);
        let elapsed_ms = last_ms - first_ms;
        (elapsed_ms >= self.window_ms).then(|| (last - first) as f64 * 1000.0 / elapsed_ms as f64)
    }

    /// Whether the topic has its minimum rate; `None`: not known yet. One message is tolerated,
    /// because where the window begins and ends between two messages, one may fall outside.
    pub(super) fn suffices(&self) -> Option<bool> {
        let ((first_ms, first), (last_ms, last)) = (self.counts.front()?, self.counts.back()?);
        let wanted = self.min_hz * (last_ms - first_ms) as f64 / 1000.0;
        self.hz().map(|_| (last - first + 1) as f64 >= wanted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts every 100 ms while messages come every `every_ms`.
    fn watched(rate: &mut Rate, from_ms: u64, until_ms: u64, every_ms: u64) {
        for now_ms in (from_ms..=until_ms).step_by(100) {
            rate.record(now_ms / every_ms, now_ms);
        }
    }

    #[test]
    fn rate_is_known_after_one_window_and_ignores_older_messages() {
        let mut rate = Rate::of(5.0);
        watched(&mut rate, 0, 1900, 200);
        assert_eq!((rate.hz(), rate.suffices()), (None, None));
        watched(&mut rate, 2000, 4000, 200);
        assert_eq!((rate.hz(), rate.suffices()), (Some(5.0), Some(true)));
        for now_ms in (4100..=6100).step_by(100) {
            rate.record(20, now_ms);
        }
        assert_eq!((rate.hz(), rate.suffices()), (Some(0.0), Some(false)));
    }

    #[test]
    fn slow_topic_has_a_long_window_and_half_the_rate_is_too_low() {
        let mut rate = Rate::of(0.1);
        watched(&mut rate, 0, 39_000, 10_000);
        assert_eq!(rate.suffices(), None);
        watched(&mut rate, 39_100, 45_000, 10_000);
        assert_eq!(rate.suffices(), Some(true));
        let mut rate = Rate::of(10.0);
        watched(&mut rate, 0, 5000, 200);
        assert_eq!(rate.suffices(), Some(false));
    }

    #[test]
    fn restarted_count_does_not_raise_the_rate() {
        let mut rate = Rate::of(5.0);
        watched(&mut rate, 0, 3000, 10);
        rate.record(0, 3100);
        assert_eq!(rate.hz(), None);
    }
}
