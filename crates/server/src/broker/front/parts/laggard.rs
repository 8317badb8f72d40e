//! Detects subscribers that hold up a fan-out for too long, by pure functions of accumulated times.
//! A subscriber is slow only compared with the others: time counts while at least half of them have
//! all parts and wait. If most subscribers are busy, the network is the bottleneck.

use std::time::Duration;

use tokio::time::Instant;

/// How long a subscriber may hold up the others, on balance.
const PATIENCE: Duration = Duration::from_secs(2);
/// When all subscribers, one after another, have held up the rest for this long on balance …
const PATIENCE_IN_TOTAL: Duration = Duration::from_secs(10);
/// … each subscriber has only this much patience left.
const REDUCED_PATIENCE: Duration = Duration::from_millis(250);
/// How long a subscriber may stay behind without progress, whether others wait or not.
const MAX_STUCK: Duration = Duration::from_secs(30);

/// Accumulated time for which the other subscribers have waited.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct WaitTime {
    before: Duration,
    since: Option<Instant>,
}

impl WaitTime {
    /// Sets whether the others wait from now on.
    pub(super) fn set(&mut self, is_waiting: bool, now: Instant) {
        self.before = self.total(now);
        self.since = is_waiting.then_some(now);
    }

    fn total(&self, now: Instant) -> Duration {
        self.before
            + self.since.map_or(Duration::ZERO, |since| now.saturating_duration_since(since))
    }
}

/// How long the others have waited for one subscriber, on balance: the value grows while they wait,
/// and shrinks as fast otherwise.
#[derive(Debug, Clone, Copy)]
pub(super) struct LagTimer {
    balance: Duration,
    settled_at: Instant,
    settled_total: Duration,
    behind_since: Option<Instant>,
    /// How long the subscriber was behind earlier, without progress since.
    stuck: Duration,
}

impl LagTimer {
    /// The state of a new subscriber.
    pub(super) fn new(wait_time: &WaitTime, now: Instant) -> Self {
        let (balance, settled_total) = (Duration::ZERO, wait_time.total(now));
        Self { balance, settled_at: now, settled_total, behind_since: None, stuck: Duration::ZERO }
    }

    /// The subscriber is behind from now on, or has made progress.
    pub(super) fn set(&mut self, is_behind: bool, wait_time: &WaitTime, now: Instant) {
        let (balance, behind_since) = (self.balance(wait_time, now), is_behind.then_some(now));
        let stuck = if is_behind { self.stuck } else { Duration::ZERO };
        *self = Self { balance, behind_since, stuck, ..Self::new(wait_time, now) };
    }

    /// The subscriber leaves, and may come back: leaving is no progress.
    pub(super) fn leave(&mut self, wait_time: &WaitTime, now: Instant) {
        let (balance, stuck) = (self.balance(wait_time, now), self.stuck(now));
        *self = Self { balance, stuck, ..Self::new(wait_time, now) };
    }

    fn stuck(&self, now: Instant) -> Duration {
        self.stuck
            + self.behind_since.map_or(Duration::ZERO, |since| now.saturating_duration_since(since))
    }

    fn balance(&self, wait_time: &WaitTime, now: Instant) -> Duration {
        let elapsed = now.saturating_duration_since(self.settled_at);
        let charged = match self.behind_since {
            Some(_) => wait_time.total(now).saturating_sub(self.settled_total).min(elapsed),
            None => Duration::ZERO,
        };
        (self.balance + charged).saturating_sub(elapsed - charged)
    }

    /// Whether to remove the subscriber; `all` is computed as if one of them had always been
    /// behind.
    pub(super) fn is_exceeded(&self, all: &Self, wait_time: &WaitTime, now: Instant) -> bool {
        if self.behind_since.is_none() {
            return false;
        }
        let is_impatient = all.balance(wait_time, now) > PATIENCE_IN_TOTAL;
        let patience = if is_impatient { REDUCED_PATIENCE } else { PATIENCE };
        self.balance(wait_time, now) >= patience || self.stuck(now) >= MAX_STUCK
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(number: u64) -> Duration {
        Duration::from_millis(number)
    }

    #[test]
    fn subscriber_that_delays_others_for_two_seconds_is_evicted() {
        let start = Instant::now();
        let (mut wait_time, quiet) = (WaitTime::default(), WaitTime::default());
        let (mut timer, all) = (LagTimer::new(&wait_time, start), LagTimer::new(&wait_time, start));
        assert!(!timer.is_exceeded(&all, &wait_time, start + ms(60_000)));
        timer.set(true, &wait_time, start);
        assert!(!timer.is_exceeded(&all, &quiet, start + ms(29_999)), "no subscriber waits");
        assert!(timer.is_exceeded(&all, &quiet, start + ms(30_000)));
        wait_time.set(true, start);
        assert!(!timer.is_exceeded(&all, &wait_time, start + ms(1_999)));
        assert!(timer.is_exceeded(&all, &wait_time, start + ms(2_000)));
        // Recovery counts in its favour: 1,500 less 1,000, and 1,500 more.
        timer.set(false, &wait_time, start + ms(1_500));
        timer.set(true, &wait_time, start + ms(2_500));
        assert!(!timer.is_exceeded(&all, &wait_time, start + ms(3_999)));
        assert!(timer.is_exceeded(&all, &wait_time, start + ms(4_000)));
    }

    #[test]
    fn subscriber_half_as_fast_as_the_rest_stays_and_a_slower_one_does_not() {
        let lasts = |busy_ms: u64, waiting_ms: u64| {
            let (mut now, mut wait_time) = (Instant::now(), WaitTime::default());
            let (mut timer, all) = (LagTimer::new(&wait_time, now), LagTimer::new(&wait_time, now));
            (0..1000).all(|_| {
                timer.set(true, &wait_time, now);
                now += ms(busy_ms);
                wait_time.set(true, now);
                now += ms(waiting_ms);
                let is_in = !timer.is_exceeded(&all, &wait_time, now);
                wait_time.set(false, now);
                timer.set(false, &wait_time, now);
                is_in
            })
        };
        assert!(lasts(100, 100));
        assert!(!lasts(90, 100));
    }

    #[test]
    fn resubscribe_keeps_the_accumulated_delay() {
        let start = Instant::now();
        let (mut wait_time, quiet) = (WaitTime::default(), WaitTime::default());
        let (mut timer, all) = (LagTimer::new(&wait_time, start), LagTimer::new(&wait_time, start));
        let mut alone = timer;
        // The others do not wait: only the lack of progress counts.
        for round in [0, 10_000, 20_000] {
            alone.set(true, &quiet, start + ms(round));
            assert!(!alone.is_exceeded(&all, &quiet, start + ms(round + 9_999)));
            alone.leave(&quiet, start + ms(round + 10_000));
        }
        alone.set(true, &quiet, start + ms(40_000));
        assert!(alone.is_exceeded(&all, &quiet, start + ms(40_000)));
        alone.set(false, &quiet, start + ms(40_000));
        alone.set(true, &quiet, start + ms(40_001));
        assert!(!alone.is_exceeded(&all, &quiet, start + ms(70_000)), "it has made progress");
        // The others wait: the subscriber cost them 1,500 before it left, and costs them 500 more.
        wait_time.set(true, start);
        timer.set(true, &wait_time, start);
        timer.leave(&wait_time, start + ms(1_500));
        timer.set(true, &wait_time, start + ms(1_500));
        assert!(!timer.is_exceeded(&all, &wait_time, start + ms(1_999)));
        assert!(timer.is_exceeded(&all, &wait_time, start + ms(2_000)));
    }

    #[test]
    fn patience_shrinks_when_many_stall_in_turn() {
        let start = Instant::now();
        let mut wait_time = WaitTime::default();
        let (mut timer, mut all) =
            (LagTimer::new(&wait_time, start), LagTimer::new(&wait_time, start));
        all.set(true, &wait_time, start);
        wait_time.set(true, start);
        timer.set(true, &wait_time, start + ms(10_000));
        assert!(!timer.is_exceeded(&all, &wait_time, start + ms(10_249)));
        assert!(timer.is_exceeded(&all, &wait_time, start + ms(10_250)));
    }
}
