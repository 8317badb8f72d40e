//! Direct-push: brings packages inside MQTT messages to the robots for which that delivery was
//! chosen. The work is read from the database, so a fan-out that a restart interrupted begins
//! again. A robot that can't keep up is told to pull instead. This module never chooses a robot's
//! initial delivery.

mod package;
mod state;

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
use crate::fleet::presence::Presence;
use crate::orders::actions::DeploymentActions;
use crate::orders::changes::{Change, Changes};
use crate::store::{Store, StoreError};
use crate::system::clock::Clock;

/// Maximum packages in fan-out at the same time; the broker permits no more.
const MAX_AT_ONCE: usize = 4;
/// Interval between polls if nothing has changed.
const POLL_INTERVAL: Duration = Duration::from_secs(5);
/// Minimum interval between polls, whatever changes: changes in between are handled together.
/// Robots that learn of an order request its parts at once, and are refused until a poll has seen
/// the order.
const MIN_POLL_INTERVAL: Duration = Duration::from_millis(25);

/// The dependencies of a fan-out. Clones share them.
#[derive(Clone)]
pub struct FanOutWorker {
    /// The source of pending work.
    pub store: Store,
    /// Tells robots to pull instead.
    pub deployments: DeploymentActions,
    /// The bytes of packages.
    pub blobs: Blobs,
    pub broker: Broker,
    /// Where robots are: those at other servers get their parts there.
    pub presence: Arc<Presence>,
    pub clock: Clock,
    /// Changes of orders, and robots' missing parts.
    pub changes: Changes,
    /// Part size and quality of service.
    pub settings: DeliverySettings,
}

/// Packages in fan-out, and the channels that tell their tasks of changed orders.
#[derive(Default)]
struct ActiveFanOuts {
    tasks: JoinSet<Digest>,
    packages: HashMap<Digest, Arc<Notify>>,
}

/// One content to fan out, and the orders for it.
#[derive(Debug)]
struct PendingContent {
    content: BlobRef,
    deployments: Vec<DeploymentId>,
}

impl FanOutWorker {
    /// Fans out all pending packages, until `stop`.
    pub async fn run(self, stop: CancellationToken) {
        // If this is cut off half-way, robots lack parts and begin anew with the next fan-out.
        tokio::select! {
            () = stop.cancelled() => {}
            () = self.poll() => {}
        }
    }

    async fn poll(self) {
        let mut notices = self.changes.subscribe();
        let mut active = ActiveFanOuts::default();
        loop {
            let polled_at = Instant::now();
            match self.pending_contents().await {
                Ok(pending) => self.begin(pending, &mut active),
                Err(error) => error.log("pending fan-outs could not be read; trying again"),
            }
            loop {
                tokio::select! {
                    () = tokio::time::sleep_until(polled_at + POLL_INTERVAL) => break,
                    Some(ended) = active.tasks.join_next() => {
                        active.ended(ended);
                        break;
                    }
                    notice = notices.recv() => match notice {
                        Ok(Change::Deployment(_)) | Err(RecvError::Lagged(_)) => break,
                        Ok(_) => {}
                        Err(RecvError::Closed) => return,
                    },
                }
            }
            tokio::time::sleep_until(polled_at + MIN_POLL_INTERVAL).await;
            notices = notices.resubscribe();
        }
    }

    /// All contents that robots should receive by fan-out and have not yet received, the most
    /// urgent first.
    async fn pending_contents(&self) -> Result<Vec<PendingContent>, StoreError> {
        let mut pending: Vec<PendingContent> = Vec::new();
        for (deployment, package) in self.store.fan_outs().list().await? {
            if !self.has_robots_of(&package.content.digest).await? {
                continue;
            }
            match pending.iter_mut().find(|other| other.content == package.content) {
                Some(other) => other.deployments.push(deployment),
                None => pending.push(PendingContent {
                    content: package.content,
                    deployments: vec![deployment],
                }),
            }
        }
        Ok(pending)
    }

    /// Whether a robot that waits for the content is not at another server.
    async fn has_robots_of(&self, content: &Digest) -> Result<bool, StoreError> {
        if self.presence.shared().is_none() {
            return Ok(true);
        }
        let waiting = self.store.fan_outs().awaiting_parts(content).await?;
        let now_ms = self.clock.now_ms();
        Ok(waiting.iter().any(|(_, robot)| !self.presence.is_elsewhere(robot, now_ms)))
    }

    fn begin(&self, pending: Vec<PendingContent>, active: &mut ActiveFanOuts) {
        for PendingContent { content, deployments } in pending {
            if let Some(changed) = active.packages.get(&content.digest) {
                changed.notify_one();
            } else if active.packages.len() < MAX_AT_ONCE {
                let changed = Arc::new(Notify::new());
                active.packages.insert(content.digest, changed.clone());
                tracing::info!(digest = %content.digest, deployments = deployments.len(), "a package is fanned out");
                let worker = self.clone();
                active.tasks.spawn(async move {
                    worker.fan_out(content, changed).await;
                    content.digest
                });
            }
        }
    }
}

impl ActiveFanOuts {
    fn ended(&mut self, ended: Result<Digest, tokio::task::JoinError>) {
        match ended {
            Ok(digest) => drop(self.packages.remove(&digest)),
            // One of the tasks that are aborted below.
            Err(error) if error.is_cancelled() => {}
            Err(error) => {
                tracing::error!(%error, "a fan-out task has failed; all fan-outs restart");
                self.tasks.abort_all();
                self.packages.clear();
            }
        }
    }
}
