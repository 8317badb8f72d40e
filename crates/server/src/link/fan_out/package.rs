//! One package's fan-out from its first subscriber to its last: reads slices of the blob, publishes
//! them as parts, and keeps the broker's grant equal to the database's state.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use task_proto::desired::BlobRef;
use task_proto::messages::part::{MAX_PARTS, PartLayout};
use task_proto::time::millis;
use task_proto::{DeploymentId, RobotId};
use tokio::sync::Notify;
use tokio::time::{Instant, timeout};

use super::FanOutWorker;
use super::state::{FanOutState, GiveUpReason, Step};
use crate::blobs::Blob;
use crate::broker::{FanOut, FanOutError, FanOutSettings, Part, PartQos};
use crate::fleet::part_requests::PartSubscription;
use crate::store::StoreError;

/// Interval of checks for subscribers and for the next step.
const CHECK_INTERVAL: Duration = Duration::from_millis(250);
/// How long to wait for further subscribers after the first: they tend to come together.
const JOIN_PAUSE: Duration = Duration::from_millis(20);
/// Minimum interval between database queries for robots that still need the package,
const SYNC_PAUSE: Duration = Duration::from_millis(200);
/// and the interval if no change is known.
const SYNC_INTERVAL: Duration = Duration::from_secs(2);
/// Time limit for the acknowledgement of the last parts; afterwards we wait for the robots'
/// reports.
const SETTLE_TIMEOUT: Duration = Duration::from_secs(10);

/// Pause before an interrupted fan-out is retried.
const RETRY_PAUSE: Duration = Duration::from_secs(2);

struct Package<'a> {
    worker: &'a FanOutWorker,
    content: BlobRef,
    cut: PartLayout,
    blob: Blob,
    fan_out: FanOut,
    requests: PartSubscription,
    state: FanOutState,
    started: Instant,
    /// The deployments of each robot that include the package.
    owners: BTreeMap<RobotId, Vec<DeploymentId>>,
    changed: Arc<Notify>,
    synced_at: Option<Instant>,
    /// Whether orders may have changed since then.
    is_stale: bool,
}

/// The reason why a fan-out ends early. It is retried from the start.
#[derive(Debug, thiserror::Error)]
enum Interrupted {
    #[error("the database failed")]
    Store(#[from] StoreError),
    #[error("the orders could not be changed")]
    Deployment(#[from] crate::orders::actions::DeploymentError),
    #[error("the blob can't be read")]
    Blob(#[from] crate::blobs::BlobError),
    #[error("the broker refused")]
    Broker(#[from] FanOutError),
}

impl FanOutWorker {
    /// Fans out `content` until no robot needs it in this way.
    pub(super) async fn fan_out(&self, content: BlobRef, changed: Arc<Notify>) {
        let done = match self.prepare(content, changed).await {
            Ok(Some(package)) => package.run().await,
            Ok(None) => self.give_up_on_all(content).await,
            Err(error) => Err(error),
        };
        match done {
            Ok(()) => tracing::info!(digest = %content.digest, "a fan-out has ended"),
            Err(error) => {
                tracing::warn!(
                    digest = %content.digest,
                    error = &error as &dyn std::error::Error,
                    "a fan-out was interrupted; trying again"
                );
                tokio::time::sleep(RETRY_PAUSE).await;
            }
        }
    }

    /// `None`: there is nothing to send.
    async fn prepare(
        &self,
        content: BlobRef,
        changed: Arc<Notify>,
    ) -> Result<Option<Package<'_>>, Interrupted> {
        let Some(blob) =
            self.blobs.get(content.digest).await?.filter(|blob| blob.size() == content.size)
        else {
            return Ok(None);
        };
        // A robot can track only a limited number of parts, so parts grow with the package.
        let least = u32::try_from(content.size.div_ceil(u64::from(MAX_PARTS))).unwrap_or(u32::MAX);
        let Ok(cut) = PartLayout::new(content.size, self.settings.part_bytes.max(least)) else {
            return Ok(None);
        };
        let qos = match self.settings.qos {
            0 => PartQos::AtMostOnce,
            1 => PartQos::AtLeastOnce,
            _ => PartQos::ExactlyOnce,
        };
        let largest = u64::from(cut.part_bytes()).min(content.size);
        let settings =
            FanOutSettings { part_bytes: usize::try_from(largest).unwrap_or(usize::MAX), qos };
        let fan_out = self.broker.fan_out(content.digest, settings, Vec::new())?;
        Ok(Some(Package {
            worker: self,
            content,
            cut,
            blob,
            fan_out,
            requests: self.changes.part_requests().subscribe(content.digest),
            state: FanOutState::begin(cut.count(), 0),
            started: Instant::now(),
            owners: BTreeMap::new(),
            changed,
            synced_at: None,
            is_stale: true,
        }))
    }

    async fn give_up_on_all(&self, content: BlobRef) -> Result<(), Interrupted> {
        let open = self.store.fan_outs().awaiting_parts(&content.digest).await?;
        Ok(self.deployments.switch_to_pull(&open, "the server has no such content").await?)
    }
}

impl Package<'_> {
    async fn run(mut self) -> Result<(), Interrupted> {
        loop {
            self.sync().await?;
            match self.state.next(self.now_ms()) {
                Step::Publish(parts) => self.publish(parts).await?,
                Step::Wait => self.wait().await,
                Step::Over => {
                    self.switch_given_up_to_pull().await?;
                    // Robots that were released meanwhile are found by the next check.
                    return Ok(());
                }
            }
        }
    }

    /// Waits for an event, or for the next check.
    async fn wait(&self) {
        tokio::select! {
            () = self.changed.notified() => {}
            () = self.requests.added() => {}
            () = self.fan_out.joined() => tokio::time::sleep(JOIN_PAUSE).await,
            () = tokio::time::sleep(CHECK_INTERVAL) => {}
        }
    }

    /// Publishes `parts` in order. Meanwhile orders may change, and robots come and go.
    async fn publish(&mut self, parts: Vec<RangeInclusive<u32>>) -> Result<(), Interrupted> {
        for index in parts.into_iter().flatten() {
            let range = self.cut.range(index);
            let bytes = self.blob.slice(range).await?;
            let part = Part { header: Bytes::copy_from_slice(&self.cut.header(index)), bytes };
            // A cancelled call has sent nothing.
            loop {
                match timeout(CHECK_INTERVAL, self.fan_out.publish(part.clone())).await {
                    Ok(sent) => break sent?,
                    Err(_) => self.sync().await?,
                }
            }
            if self.synced_at.is_none_or(|at| at.elapsed() >= SYNC_INTERVAL) {
                self.sync().await?;
            }
            if self.state.is_over() {
                break;
            }
        }
        self.fan_out.settle(SETTLE_TIMEOUT).await;
        self.state.sent(self.now_ms());
        Ok(())
    }

    /// Processes all pending changes, and tells robots that were given up on to pull.
    async fn sync(&mut self) -> Result<(), Interrupted> {
        let now_ms = self.now_ms();
        self.is_stale |= tokio::select! {
            biased;
            () = self.changed.notified() => true,
            () = std::future::ready(()) => false,
        };
        let pause = if self.is_stale { SYNC_PAUSE } else { SYNC_INTERVAL };
        let is_due = self.synced_at.is_none_or(|at| at.elapsed() >= pause);
        if is_due {
            self.read_orders(now_ms).await?;
        }
        for robot in self.fan_out.take_evicted() {
            self.state.evicted(robot);
        }
        let reports = self.requests.take();
        reports.keys().for_each(|robot| self.fan_out.note_subscription(robot, true));
        let fan_out = &self.fan_out;
        self.state.set_subscribed(|robot| fan_out.is_subscribed(robot), now_ms);
        for (robot, missing) in reports {
            self.state.report_missing(&robot, missing, now_ms);
        }
        self.switch_given_up_to_pull().await
    }

    async fn read_orders(&mut self, now_ms: u64) -> Result<(), Interrupted> {
        (self.synced_at, self.is_stale) = (Some(Instant::now()), false);
        self.owners.clear();
        for (deployment, robot) in
            self.worker.store.fan_outs().awaiting_parts(&self.content.digest).await?
        {
            if !self.worker.presence.is_elsewhere(&robot, self.worker.clock.now_ms()) {
                self.owners.entry(robot).or_default().push(deployment);
            }
        }
        let robots: BTreeSet<RobotId> = self.owners.keys().cloned().collect();
        let (new, gone) = self.state.set_robots(&robots, now_ms);
        self.fan_out.admit(new);
        for robot in gone {
            self.fan_out.withdraw(&robot);
        }
        Ok(())
    }

    async fn switch_given_up_to_pull(&mut self) -> Result<(), Interrupted> {
        let mut by_reason: BTreeMap<GiveUpReason, Vec<(DeploymentId, RobotId)>> = BTreeMap::new();
        for (robot, why) in self.state.take_given_up() {
            self.fan_out.withdraw(&robot);
            let deployments = self.owners.remove(&robot).unwrap_or_default();
            let parts = deployments.into_iter().map(|deployment| (deployment, robot.clone()));
            by_reason.entry(why).or_default().extend(parts);
        }
        for (why, parts) in by_reason {
            tracing::info!(digest = %self.content.digest, robots = parts.len(), why = why.as_str(), "robots are switched to pull");
            self.worker.deployments.switch_to_pull(&parts, why.as_str()).await?;
        }
        Ok(())
    }

    fn now_ms(&self) -> u64 {
        millis(self.started.elapsed())
    }
}
