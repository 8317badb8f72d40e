//! Updates for the other servers of the cluster, gathered as sets, so that a burst of changes is
//! sent once. A server alone has no outbox. This module sends nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use task_proto::{RobotId, UserName};
use tokio::sync::Notify;

use super::change::{Change, RobotsToNotify};

/// Maximum changed objects that are named. Beyond it, the others learn that they missed some.
const MAX_CHANGES: usize = 2_000;

/// Updates that have not been sent. Clones share one outbox.
#[derive(Debug, Clone, Default)]
pub struct Outbox(Arc<Inner>);

#[derive(Debug, Default)]
struct Inner {
    updates: Mutex<Updates>,
    added: Notify,
    /// Whether a server has listeners to changed objects.
    has_listeners: AtomicBool,
}

/// Updates for the other servers.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Updates {
    pub to_notify: RobotsToNotify,
    /// Robots whose connections have to end, all but those by the given token.
    pub robots_to_end: BTreeMap<RobotId, Option<u64>>,
    /// People whose MQTT sessions have to end.
    pub people_to_end: BTreeSet<UserName>,
    /// Whether tokens or their rights have changed.
    pub auth: bool,
    /// Whether people or their tokens have changed, which long-lived connections depend on.
    pub rights: bool,
    /// Whether rows of robots' sessions have changed.
    pub sessions: bool,
    pub changes: BTreeSet<Change>,
    /// Whether there were more changes.
    pub missed: bool,
}

impl Outbox {
    pub fn add(&self, change: impl FnOnce(&mut Updates)) {
        change(&mut self.0.updates.lock().unwrap_or_else(PoisonError::into_inner));
        self.0.added.notify_one();
    }

    /// Adds a changed object, if a server has listeners.
    pub fn add_change(&self, changed: &Change) {
        if !self.0.has_listeners.load(Ordering::Relaxed) {
            return;
        }
        self.add(|updates| match updates.changes.len() < MAX_CHANGES {
            true => {
                updates.changes.insert(changed.clone());
            }
            false => updates.missed = true,
        });
    }

    /// Sets whether a server has listeners to changed objects.
    pub fn set_listeners(&self, has_listeners: bool) {
        self.0.has_listeners.store(has_listeners, Ordering::Relaxed);
    }

    /// Waits until there is an update. Dropping the future loses none.
    pub async fn filled(&self) {
        while *self.0.updates.lock().unwrap_or_else(PoisonError::into_inner) == Updates::default() {
            self.0.added.notified().await;
        }
    }

    pub fn take(&self) -> Updates {
        std::mem::take(&mut *self.0.updates.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn changed_objects_are_gathered_for_listeners_up_to_a_limit() {
        let outbox = Outbox::default();
        let change = |n: usize| Change::Package(format!("task{n}").parse().expect("a name"));
        outbox.add_change(&change(0));
        assert_eq!(outbox.take(), Updates::default(), "nobody listens");
        outbox.set_listeners(true);
        (0..MAX_CHANGES).for_each(|n| outbox.add_change(&change(n)));
        outbox.filled().await;
        let updates = outbox.take();
        assert_eq!((updates.changes.len(), updates.missed), (MAX_CHANGES, false));
        (0..=MAX_CHANGES).for_each(|n| outbox.add_change(&change(n)));
        assert!(outbox.take().missed);
    }
}
