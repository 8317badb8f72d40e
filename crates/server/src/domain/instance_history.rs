//! The instances of one robot: which displaced which, and whether two keep displacing each other.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};
use task_proto::InstanceId;

/// Two returns of a displaced instance within this time mean a duplicate. After the same time
/// without a change the duplicate is over.
pub const DUPLICATE_WINDOW_MS: u64 = 10 * 60 * 1000;
/// Maximum remembered changes for each robot.
const MAX_CHANGES: usize = 8;

/// The instances of one robot, by the time at which each displaced another.
///
/// A restarted agent is a new instance, and an old instance never comes back, except in a late
/// message. So two *returns* within [`DUPLICATE_WINDOW_MS`] (A, B, A again, B again) mean that two
/// machines share the identity.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InstanceHistory {
    #[serde(default)]
    changes: VecDeque<Change>,
    /// The last return that made the robot a duplicate, or kept the robot one.
    #[serde(default)]
    duplicate_at_ms: Option<u64>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Change {
    instance: InstanceId,
    at_ms: u64,
    is_return: bool,
}

impl InstanceHistory {
    /// Records a message or request of `instance`. Returns whether it is another than the last.
    pub fn observe(&mut self, instance: &InstanceId, now_ms: u64) -> bool {
        if self.changes.back().is_some_and(|last| last.instance == *instance) {
            return false;
        }
        let is_return = self.changes.iter().any(|change| change.instance == *instance);
        self.changes.push_back(Change { instance: instance.clone(), at_ms: now_ms, is_return });
        if self.changes.len() > MAX_CHANGES {
            self.changes.pop_front();
        }
        let recent = |change: &&Change| now_ms.saturating_sub(change.at_ms) < DUPLICATE_WINDOW_MS;
        let returns = self.changes.iter().filter(recent).filter(|change| change.is_return).count();
        if is_return && (returns >= 2 || self.is_duplicate(now_ms)) {
            self.duplicate_at_ms = Some(now_ms);
        }
        true
    }

    /// Whether instances displaced each other and have not been quiet since.
    pub fn is_duplicate(&self, now_ms: u64) -> bool {
        self.duplicate_at_ms.is_some_and(|at_ms| now_ms.saturating_sub(at_ms) < DUPLICATE_WINDOW_MS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTE_MS: u64 = 60_000;

    fn history(observed: &[(&InstanceId, u64)]) -> InstanceHistory {
        let mut history = InstanceHistory::default();
        for (instance, at_ms) in observed {
            history.observe(instance, *at_ms);
        }
        history
    }

    #[test]
    fn two_returns_within_the_window_are_a_duplicate() {
        let (a, b) = (InstanceId::random(), InstanceId::random());
        let three = history(&[(&a, 0), (&b, 1), (&b, 2), (&a, 3)]);
        assert!(!three.is_duplicate(3), "one return may be a late message");
        let mut four = three;
        four.observe(&b, 4);
        assert!(four.is_duplicate(4));
        assert!(four.is_duplicate(4 + DUPLICATE_WINDOW_MS - 1));
        assert!(!four.is_duplicate(4 + DUPLICATE_WINDOW_MS), "ten quiet minutes clear it");
    }

    #[test]
    fn returns_keep_a_duplicate_alive_and_repeats_do_not() {
        let (a, b) = (InstanceId::random(), InstanceId::random());
        let mut both = history(&[(&a, 0), (&b, 1), (&a, 2), (&b, 3)]);
        both.observe(&a, 9 * MINUTE_MS);
        both.observe(&a, 18 * MINUTE_MS);
        assert!(both.is_duplicate(18 * MINUTE_MS));
        assert!(!both.is_duplicate(19 * MINUTE_MS));
    }

    #[test]
    fn restarts_and_slow_alternation_are_no_duplicate() {
        let fresh: Vec<InstanceId> = (0..40).map(|_| InstanceId::random()).collect();
        let mut restarts = InstanceHistory::default();
        for (second, instance) in (0..).zip(&fresh) {
            restarts.observe(instance, second * 1000);
            assert!(!restarts.is_duplicate(second * 1000));
        }
        let (a, b) = (&fresh[0], &fresh[1]);
        let slow = history(&[(a, 0), (b, 8 * MINUTE_MS), (a, 16 * MINUTE_MS), (b, 27 * MINUTE_MS)]);
        assert!(!slow.is_duplicate(27 * MINUTE_MS));
    }

    #[test]
    fn three_clones_are_a_duplicate_too() {
        let (a, b, c) = (InstanceId::random(), InstanceId::random(), InstanceId::random());
        assert!(history(&[(&a, 0), (&b, 1), (&c, 2), (&a, 3), (&b, 4)]).is_duplicate(4));
    }

    #[test]
    fn history_survives_its_stored_form() {
        let (a, b) = (InstanceId::random(), InstanceId::random());
        let known = history(&[(&a, 0), (&b, 1), (&a, 2), (&b, 3)]);
        let stored = serde_json::to_string(&known).expect("json");
        assert_eq!(serde_json::from_str::<InstanceHistory>(&stored).expect("the same"), known);
    }
}
