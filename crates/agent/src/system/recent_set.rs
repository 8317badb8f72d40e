//! A set of recently seen values: it has a maximum size and forgets the oldest. It decides nothing.

use std::collections::{HashSet, VecDeque};
use std::hash::Hash;

/// The last `MAX` different values that were seen.
#[derive(Debug)]
pub struct RecentSet<T, const MAX: usize> {
    known: HashSet<T>,
    /// The values, the oldest first.
    order: VecDeque<T>,
}

impl<T, const MAX: usize> Default for RecentSet<T, MAX> {
    fn default() -> Self {
        Self { known: HashSet::new(), order: VecDeque::new() }
    }
}

impl<T: Clone + Eq + Hash, const MAX: usize> RecentSet<T, MAX> {
    /// Whether the value was seen recently.
    pub fn contains(&self, one: &T) -> bool {
        self.known.contains(one)
    }

    /// Records a value; returns whether it is new.
    pub fn insert(&mut self, one: T) -> bool {
        let is_new = self.known.insert(one.clone());
        if is_new {
            self.order.push_back(one);
        }
        if self.order.len() > MAX
            && let Some(oldest) = self.order.pop_front()
        {
            self.known.remove(&oldest);
        }
        is_new
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oldest_value_is_forgotten_and_a_repeated_one_is_not_new() {
        let mut recent = RecentSet::<u32, 3>::default();
        for number in 0..9 {
            assert!(recent.insert(number) && !recent.insert(number) && recent.contains(&number));
        }
        assert!(!recent.contains(&5) && recent.contains(&6) && recent.contains(&8));
        assert_eq!((recent.known.len(), recent.order.len()), (3, 3));
    }
}
