//! Direct-push: brings packages inside MQTT messages to the robots for which that delivery was
//! chosen. The work is read from the database, so a fan-out that a restart interrupted begins
//! again. A robot that can't keep up is told to pull instead. This module never chooses a robot's
//! initial delivery.

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

/// Maximum packages in fan-out at the same time; the broker permits no more.
const MAX_AT_ONCE: usize = 4;
/// Interval between polls if nothing has changed.
const LOOK_INTERVAL: Duration = Duration::from_secs(5);
/// Minimum interval between polls, whatever changes: changes in between are handled together.
/// Robots that learn of an order request its parts at once, and are refused until a poll has seen
/// the order.
const LOOK_PAUSE: Duration = Duration::from_millis(25);

/// The dependencies of a fan-out. Clones share them.
#[derive(Clone)]
pub struct FanOutWorker {
    /// The source of pending work.
    pub store: Store,
    /// Tells robots to pull instead.
    pub actions: Actions,
    /// The bytes of packages.
    pub blobs: Blobs,
    pub broker: Broker,
    /// Changes of orders, and robots' missing parts.
    pub changes: Changes,
    /// Part size and quality of service.
    pub settings: DeliverySettings,
}

/// Packages in fan-out, and the channels that tell their tasks of changed orders.
#[derive(Default)]
struct UnderWay {
    tasks: JoinSet<Digest>,
    packages: HashMap<Digest, Arc<Notify>>,
}

/// One content to fan out, and the orders for it.
#[derive(Debug)]
struct Wanted {
    content: BlobRef,
    deployments: Vec<DeploymentId>,
}

impl FanOutWorker {
    /// Fans out all pending packages, until `stop`.
    pub async fn run(self, stop: CancellationToken) {
        // If this is cut off half-way, robots lack parts and begin anew with the next fan-out.
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

    /// All contents that some robot should receive by fan-out and has not, the most urgent first.
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
            // One of the tasks that are aborted below.
            Err(error) if error.is_cancelled() => {}
            Err(error) => {
                tracing::error!(%error, "a fan-out has failed; all begin anew");
                self.tasks.abort_all();
                self.packages.clear();
            }
        }
    }
}
