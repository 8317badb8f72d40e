//! Missing parts that robots report for packages in fan-out: the newest report of each robot.
//! Reports about other packages are not kept, so the number of entries never exceeds the number of
//! robots with an assignment.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::messages::part::{MAX_MISSING_RANGES, PartRange};
use task_proto::messages::report::Report;
use task_proto::{Digest, RobotId};
use tokio::sync::Notify;

/// Receives reports. Clones feed the same subscribers.
#[derive(Debug, Clone, Default)]
pub struct PartRequests(Arc<Mutex<HashMap<Digest, Arc<Subscriber>>>>);

#[derive(Debug, Default)]
struct Subscriber {
    requests: Mutex<HashMap<RobotId, Vec<PartRange>>>,
    added: Notify,
}

/// One package's requests; dropping this ends the collection.
#[derive(Debug)]
pub struct PartSubscription {
    digest: Digest,
    subscriber: Arc<Subscriber>,
    subscribers: PartRequests,
}

impl PartRequests {
    /// Collects requests for the content with this digest, for one subscriber.
    pub fn subscribe(&self, digest: Digest) -> PartSubscription {
        let subscriber = Arc::<Subscriber>::default();
        lock(&self.0).insert(digest, subscriber.clone());
        PartSubscription { digest, subscriber, subscribers: self.clone() }
    }

    /// Reads a report that has been stored.
    pub fn record(&self, report: &Report) {
        for task in &report.tasks {
            let Some(missing) = &task.missing_parts else { continue };
            let Some(subscriber) = lock(&self.0).get(&task.package.content.digest).cloned() else {
                continue;
            };
            let missing = missing.iter().take(MAX_MISSING_RANGES).copied().collect();
            lock(&subscriber.requests).insert(report.robot_id.clone(), missing);
            subscriber.added.notify_one();
        }
    }
}

impl PartSubscription {
    /// All requests since the last call.
    pub fn take(&self) -> HashMap<RobotId, Vec<PartRange>> {
        std::mem::take(&mut *lock(&self.subscriber.requests))
    }

    /// Waits until there is a request. Cancel-safe.
    pub async fn added(&self) {
        self.subscriber.added.notified().await;
    }
}

impl Drop for PartSubscription {
    fn drop(&mut self) {
        let mut subscribers = lock(&self.subscribers.0);
        if subscribers
            .get(&self.digest)
            .is_some_and(|subscriber| Arc::ptr_eq(subscriber, &self.subscriber))
        {
            subscribers.remove(&self.digest);
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing
    // half-done.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
