//! Direct-push: brings packages inside MQTT messages to the robots for which that was decided. What
//! is to be done is read from the database, so a fan-out that a restart interrupted begins again; a
//! robot that can't be kept up to date is told to pull instead. It decides for no robot how its
//! bytes travel at first.

mod course;
mod package;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use task_proto::desired::BlobRef;
use task_proto::{DeploymentId, Digest};
use tokio::sync::Notify;
use tokio::sync::broadcast::error::RecvError;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::blobs::Blobs;
use crate::broker::Broker;
use crate::config::DeliverySettings;
use crate::orders::actions::Actions;
use crate::orders::changes::{Change, Changes};
use crate::store::{Store, StoreError};

/// Packages on their way at the same time; the broker takes no more.
const MAX_AT_ONCE: usize = 4;
/// How often it is looked for something to do, if nothing has changed.
const LOOK_INTERVAL: Duration = Duration::from_secs(5);
/// How long after one look comes the next, whatever changes: what changes meanwhile is looked at
/// together. Robots that hear of an order ask for its parts at once, and are refused until it is
/// seen here.
const LOOK_PAUSE: Duration = Duration::from_millis(25);

/// What fanning out needs. Clones share it.
#[derive(Clone)]
pub struct FanOutWorker {
    /// What is to be done.
    pub store: Store,
    /// Tells robots to pull instead.
    pub actions: Actions,
    /// The bytes.
    pub blobs: Blobs,
    /// Who delivers them.
    pub broker: Broker,
    /// What has changed, and what robots lack.
    pub changes: Changes,
    /// Part size and quality of service.
    pub settings: DeliverySettings,
}

/// Packages on their way, and how to tell their tasks that orders have changed.
#[derive(Default)]
struct UnderWay {
    tasks: JoinSet<Digest>,
    packages: HashMap<Digest, Arc<Notify>>,
}

/// One content to be fanned out, and the orders for it.
#[derive(Debug)]
struct Wanted {
    content: BlobRef,
    deployments: Vec<DeploymentId>,
}

impl FanOutWorker {
    /// Fans out what there is, until `stop`.
    pub async fn run(self, stop: CancellationToken) {
        // Cut off half-way, robots lack parts and begin anew with the next fan-out.
        tokio::select! {
            () = stop.cancelled() => {}
            () = self.work() => {}
        }
    }

    async fn work(self) {
        let mut notices = self.changes.subscribe();
        let mut under_way = UnderWay::default();
        loop {
            let looked_at = Instant::now();
            match self.wanted().await {
                Ok(wanted) => self.begin(wanted, &mut under_way),
                Err(error) => {
                    error.log("what is to be fanned out could not be read; it is tried again")
                }
            }
            loop {
                tokio::select! {
                    () = tokio::time::sleep_until(looked_at + LOOK_INTERVAL) => break,
                    Some(ended) = under_way.tasks.join_next() => {
                        under_way.ended(ended);
                        break;
                    }
                    notice = notices.recv() => match notice {
                        Ok(Change::Deployment(_)) | Err(RecvError::Lagged(_)) => break,
                        Ok(_) => {}
                        Err(RecvError::Closed) => return,
                    },
                }
            }
            tokio::time::sleep_until(looked_at + LOOK_PAUSE).await;
            notices = notices.resubscribe();
        }
    }

    /// All contents that some robot is to hear and has not, the most urgent first.
    async fn wanted(&self) -> Result<Vec<Wanted>, StoreError> {
        let mut wanted: Vec<Wanted> = Vec::new();
        for (deployment, package) in self.store.direct_pushes().await? {
            match wanted.iter_mut().find(|other| other.content == package.content) {
                Some(other) => other.deployments.push(deployment),
                None => {
                    wanted.push(Wanted { content: package.content, deployments: vec![deployment] })
                }
            }
        }
        Ok(wanted)
    }

    fn begin(&self, wanted: Vec<Wanted>, under_way: &mut UnderWay) {
        for Wanted { content, deployments } in wanted {
            if let Some(changed) = under_way.packages.get(&content.digest) {
                changed.notify_one();
            } else if under_way.packages.len() < MAX_AT_ONCE {
                let changed = Arc::new(Notify::new());
                under_way.packages.insert(content.digest, changed.clone());
                tracing::info!(digest = %content.digest, deployments = deployments.len(), "a package is fanned out");
                let worker = self.clone();
                under_way.tasks.spawn(async move {
                    worker.fan_out(content, changed).await;
                    content.digest
                });
            }
        }
    }
}

impl UnderWay {
    fn ended(&mut self, ended: Result<Digest, tokio::task::JoinError>) {
        match ended {
            Ok(digest) => drop(self.packages.remove(&digest)),
            // Of those that were told to end below.
            Err(error) if error.is_cancelled() => {}
            Err(error) => {
                tracing::error!(%error, "a fan-out has failed; all begin anew");
                self.tasks.abort_all();
                self.packages.clear();
            }
        }
    }
}
