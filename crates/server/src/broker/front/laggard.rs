//! Detects subscribers that hold up a fan-out for too long, by pure functions of accumulated times.
//! A subscriber is slow only compared with the others: time counts while at least half of them have
//! all parts and wait. If most subscribers are busy, the network is the bottleneck.

use std::time::Duration;

use tokio::time::Instant;

/// How long a subscriber may hold up the others, on balance.
const PATIENCE: Duration = Duration::from_secs(2);
/// When all subscribers, one after another, have held up the rest for this long on balance …
const PATIENCE_WITH_ALL: Duration = Duration::from_secs(10);
/// … each subscriber has only this much patience left.
const LITTLE_PATIENCE: Duration = Duration::from_millis(250);
/// How long a subscriber may stay behind without progress, whether others wait or not.
const LONGEST: Duration = Duration::from_secs(30);

/// Accumulated time for which the other subscribers have waited.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Waiting {
    before: Duration,
    since: Option<Instant>,
}

impl Waiting {
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
pub(super) struct Hold {
    balance: Duration,
    settled_at: Instant,
    settled_total: Duration,
    behind_since: Option<Instant>,
    /// How long the subscriber was behind earlier, without progress since.
    stuck: Duration,
}

impl Hold {
    /// The state of a new subscriber.
    pub(super) fn new(waiting: &Waiting, now: Instant) -> Self {
        let (balance, settled_total) = (Duration::ZERO, waiting.total(now));
        Self { balance, settled_at: now, settled_total, behind_since: None, stuck: Duration::ZERO }
    }

    /// The subscriber is behind from now on, or has made progress.
    pub(super) fn set(&mut self, is_behind: bool, waiting: &Waiting, now: Instant) {
        let (balance, behind_since) = (self.balance(waiting, now), is_behind.then_some(now));
        let stuck = if is_behind { self.stuck } else { Duration::ZERO };
        *self = Self { balance, behind_since, stuck, ..Self::new(waiting, now) };
    }

    /// The subscriber leaves, and may come back: leaving is no progress.
    pub(super) fn leave(&mut self, waiting: &Waiting, now: Instant) {
        let (balance, stuck) = (self.balance(waiting, now), self.stuck(now));
        *self = Self { balance, stuck, ..Self::new(waiting, now) };
    }

    fn stuck(&self, now: Instant) -> Duration {
        self.stuck
            + self.behind_since.map_or(Duration::ZERO, |since| now.saturating_duration_since(since))
    }

    fn balance(&self, waiting: &Waiting, now: Instant) -> Duration {
        let elapsed = now.saturating_duration_since(self.settled_at);
        let charged = match self.behind_since {
            Some(_) => waiting.total(now).saturating_sub(self.settled_total).min(elapsed),
            None => Duration::ZERO,
        };
        (self.balance + charged).saturating_sub(elapsed - charged)
    }

    /// Whether to remove the subscriber; `all` is computed as if one of them had always been
    /// behind.
    pub(super) fn is_too_long(&self, all: &Self, waiting: &Waiting, now: Instant) -> bool {
        if self.behind_since.is_none() {
            return false;
        }
        let is_impatient = all.balance(waiting, now) > PATIENCE_WITH_ALL;
        let patience = if is_impatient { LITTLE_PATIENCE } else { PATIENCE };
        self.balance(waiting, now) >= patience || self.stuck(now) >= LONGEST
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(number: u64) -> Duration {
        Duration::from_millis(number)
    }

    #[test]
    fn who_holds_up_others_for_two_seconds_is_put_out() {
        let start = Instant::now();
        let (mut waiting, quiet) = (Waiting::default(), Waiting::default());
        let (mut hold, all) = (Hold::new(&waiting, start), Hold::new(&waiting, start));
        assert!(!hold.is_too_long(&all, &waiting, start + ms(60_000)));
        hold.set(true, &waiting, start);
        assert!(!hold.is_too_long(&all, &quiet, start + ms(29_999)), "nobody waits");
        assert!(hold.is_too_long(&all, &quiet, start + ms(30_000)));
        waiting.set(true, start);
        assert!(!hold.is_too_long(&all, &waiting, start + ms(1_999)));
        assert!(hold.is_too_long(&all, &waiting, start + ms(2_000)));
        // Recovery counts in its favour: 1,500 less 1,000, and 1,500 more.
        hold.set(false, &waiting, start + ms(1_500));
        hold.set(true, &waiting, start + ms(2_500));
        assert!(!hold.is_too_long(&all, &waiting, start + ms(3_999)));
        assert!(hold.is_too_long(&all, &waiting, start + ms(4_000)));
    }

    #[test]
    fn who_is_half_as_fast_as_the_rest_stays_and_who_is_slower_does_not() {
        let lasts = |busy_ms: u64, waiting_ms: u64| {
            let (mut now, mut waiting) = (Instant::now(), Waiting::default());
            let (mut hold, all) = (Hold::new(&waiting, now), Hold::new(&waiting, now));
            (0..1000).all(|_| {
                hold.set(true, &waiting, now);
                now += ms(busy_ms);
                waiting.set(true, now);
                now += ms(waiting_ms);
                let is_in = !hold.is_too_long(&all, &waiting, now);
                waiting.set(false, now);
                hold.set(false, &waiting, now);
                is_in
            })
        };
        assert!(lasts(100, 100));
        assert!(!lasts(90, 100));
    }

    #[test]
    fn who_leaves_and_comes_back_starts_from_where_it_was() {
        let start = Instant::now();
        let (mut waiting, quiet) = (Waiting::default(), Waiting::default());
        let (mut hold, all) = (Hold::new(&waiting, start), Hold::new(&waiting, start));
        let mut alone = hold;
        // The others do not wait: only the lack of progress counts.
        for round in [0, 10_000, 20_000] {
            alone.set(true, &quiet, start + ms(round));
            assert!(!alone.is_too_long(&all, &quiet, start + ms(round + 9_999)));
            alone.leave(&quiet, start + ms(round + 10_000));
        }
        alone.set(true, &quiet, start + ms(40_000));
        assert!(alone.is_too_long(&all, &quiet, start + ms(40_000)));
        alone.set(false, &quiet, start + ms(40_000));
        alone.set(true, &quiet, start + ms(40_001));
        assert!(!alone.is_too_long(&all, &quiet, start + ms(70_000)), "it has come forward");
        // The others wait: the subscriber cost them 1,500 before it left, and costs them 500 more.
        waiting.set(true, start);
        hold.set(true, &waiting, start);
        hold.leave(&waiting, start + ms(1_500));
        hold.set(true, &waiting, start + ms(1_500));
        assert!(!hold.is_too_long(&all, &waiting, start + ms(1_999)));
        assert!(hold.is_too_long(&all, &waiting, start + ms(2_000)));
    }

    #[test]
    fn many_that_stall_by_turns_find_less_patience() {
        let start = Instant::now();
        let mut waiting = Waiting::default();
        let (mut hold, mut all) = (Hold::new(&waiting, start), Hold::new(&waiting, start));
        all.set(true, &waiting, start);
        waiting.set(true, start);
        hold.set(true, &waiting, start + ms(10_000));
        assert!(!hold.is_too_long(&all, &waiting, start + ms(10_249)));
        assert!(hold.is_too_long(&all, &waiting, start + ms(10_250)));
    }
}
