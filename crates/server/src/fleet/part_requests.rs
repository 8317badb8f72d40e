//! Missing parts that robots report for packages in fan-out: the newest report of each robot.
//! Reports about other packages are not kept, so the number of entries never exceeds the number of
//! robots with an assignment.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::part::{MAX_MISSING_RANGES, PartRange};
use task_proto::report::Report;
use task_proto::{Digest, RobotId};
use tokio::sync::Notify;

/// Receives reports. Clones feed the same listeners.
#[derive(Debug, Clone, Default)]
pub struct PartRequests(Arc<Mutex<HashMap<Digest, Arc<Desk>>>>);

#[derive(Debug, Default)]
struct Desk {
    requests: Mutex<HashMap<RobotId, Vec<PartRange>>>,
    news: Notify,
}

/// One package's requests; dropping this ends the collection.
#[derive(Debug)]
pub struct Listening {
    digest: Digest,
    desk: Arc<Desk>,
    desks: PartRequests,
}

impl PartRequests {
    /// Collects requests for the content with this digest, for one listener.
    pub fn listen(&self, digest: Digest) -> Listening {
        let desk = Arc::<Desk>::default();
        lock(&self.0).insert(digest, desk.clone());
        Listening { digest, desk, desks: self.clone() }
    }

    /// Reads a report that has been stored.
    pub fn hear(&self, report: &Report) {
        for task in &report.tasks {
            let Some(missing) = &task.missing_parts else { continue };
            let Some(desk) = lock(&self.0).get(&task.package.content.digest).cloned() else {
                continue;
            };
            let missing = missing.iter().take(MAX_MISSING_RANGES).copied().collect();
            lock(&desk.requests).insert(report.robot_id.clone(), missing);
            desk.news.notify_one();
        }
    }
}

impl Listening {
    /// All requests since the last call.
    pub fn take(&self) -> HashMap<RobotId, Vec<PartRange>> {
        std::mem::take(&mut *lock(&self.desk.requests))
    }

    /// Waits until there is a request. Cancel-safe.
    pub async fn news(&self) {
        self.desk.news.notified().await;
    }
}

impl Drop for Listening {
    fn drop(&mut self) {
        let mut desks = lock(&self.desks.0);
        if desks.get(&self.digest).is_some_and(|desk| Arc::ptr_eq(desk, &self.desk)) {
            desks.remove(&self.digest);
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing
    // half-done.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
