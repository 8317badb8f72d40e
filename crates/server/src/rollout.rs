//! When a deployment's next batch begins, and when it pauses. Functions of values; [`crate::advance`] carries it out.

/// What the order said about its pace, and what has been decided since.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rollout {
    /// Robots at a time; `None`: all at once.
    pub batch: Option<u64>,
    /// Failures it bears; `None`: any number.
    pub max_failures: Option<u64>,
    /// Failures that the operator has forgiven by resuming it.
    pub forgiven: u64,
    /// Whether it waits for the operator.
    pub paused: bool,
}

/// How many of its assignments stand where.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Their batch has not begun.
    pub waiting: u64,
    /// Released, not settled, and waited for.
    pub busy: u64,
    /// Settled by failing.
    pub failed: u64,
}

/// What to do next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Move {
    /// Nothing, until something settles or the operator resumes it.
    Wait,
    /// Begin a batch of so many robots.
    Release(u64),
    /// Too many have failed: begin no more.
    Pause,
}

/// The next move of a rollout.
pub fn next_move(rollout: &Rollout, tally: &Tally) -> Move {
    if rollout.paused || tally.waiting == 0 {
        return Move::Wait;
    }
    let failures = tally.failed.saturating_sub(rollout.forgiven);
    if rollout.max_failures.is_some_and(|most| failures > most) {
        return Move::Pause;
    }
    match rollout.batch {
        None => Move::Release(tally.waiting),
        Some(_) if tally.busy > 0 => Move::Wait,
        Some(batch) => Move::Release(batch.clamp(1, tally.waiting)),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// A whole rollout, robot by robot: `outcomes` says which of them fail.
        #[test]
        fn batches_never_overlap_and_failures_stop_it(
            outcomes in proptest::collection::vec(any::<bool>(), 1..60),
            batch in proptest::option::of(1u64..9),
            max_failures in proptest::option::of(0u64..6),
        ) {
            let mut rollout = Rollout { batch, max_failures, forgiven: 0, paused: false };
            let mut tally = Tally { waiting: outcomes.len() as u64, ..Tally::default() };
            let mut outcomes = outcomes.into_iter();
            loop {
                match next_move(&rollout, &tally) {
                    Move::Release(count) => {
                        prop_assert!(count >= 1 && count <= tally.waiting);
                        prop_assert!(batch.is_none_or(|batch| tally.busy == 0 && count <= batch));
                        prop_assert!(max_failures.is_none_or(|most| tally.failed <= most));
                        tally.waiting -= count;
                        tally.busy += count;
                    }
                    Move::Pause => {
                        prop_assert!(max_failures.is_some_and(|most| tally.failed > most));
                        rollout.paused = true;
                    }
                    Move::Wait if tally.busy > 0 => {
                        tally.busy -= 1;
                        tally.failed += u64::from(!outcomes.next().expect("one outcome each"));
                    }
                    Move::Wait => break,
                }
            }
            // It ends only when all have had their turn, or it was paused.
            prop_assert!(tally.waiting == 0 || rollout.paused);
        }
    }

    #[test]
    fn a_resumed_rollout_bears_as_many_failures_again() {
        let rollout = Rollout { batch: Some(2), max_failures: Some(1), forgiven: 2, paused: false };
        let tally = Tally { waiting: 5, busy: 0, failed: 3 };
        assert_eq!(next_move(&rollout, &tally), Move::Release(2));
        assert_eq!(next_move(&rollout, &Tally { failed: 4, ..tally }), Move::Pause);
    }
}
