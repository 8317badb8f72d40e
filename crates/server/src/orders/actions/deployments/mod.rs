//! Orders about deployments and tasks. This file creates, cancels and resumes deployments; placing,
//! retries, rollbacks, tasks and the fallback to pull have files of their own.

mod placement;
mod pull_fallback;
mod retry_rollback;
mod tasks;

use std::collections::BTreeSet;
use std::sync::Arc;

use task_proto::api::{CreateDeployment, DeliveryChoice, MAX_PRIORITY, MIN_PRIORITY, PackageView};
use task_proto::ids::selector::Selector;
use task_proto::messages::report::Phase;
use task_proto::size::format_bytes;
use task_proto::{DeploymentId, RobotId, TaskName, Version};
use tokio::sync::Notify;

use super::idempotency::{IdempotencyKey, store_answer, stored_answer};
use super::selection::{check_scope, preview, select};
use super::{OrderError, lifetime_ms};
use crate::domain::person::Person;
use crate::domain::rollout::Tally;
use crate::orders::changes::{Changes, PendingNotifications};
use crate::orders::delivery_planner::{DeliveryPlanner, transfer_bytes};
use crate::orders::rollout;
use crate::store::{
    AuditAction, AuditEvent, Revocable, SelectedRobot, Store, StoreError, Transaction,
};
use crate::system::clock::Clock;

pub use placement::CHUNK_ROBOTS;
use placement::{Placement, WriteBudget};
pub use retry_rollback::Rollback;

/// Orders about deployments, and about tasks that robots have. Clones share their state.
#[derive(Clone)]
pub struct DeploymentActions {
    pub(super) store: Store,
    pub(super) clock: Clock,
    pub(super) changes: Changes,
    pub(super) planner: DeliveryPlanner,
    /// Default time limit of an assignment.
    pub(super) assignment_lifetime_ms: u64,
    /// The most robots that one write places an order for.
    pub(super) chunk_robots: usize,
    /// Notified of orders that were too large for one write.
    pub(super) to_continue: Arc<Notify>,
}

/// Why an order about a deployment or a task was refused.
#[derive(Debug, thiserror::Error)]
pub enum DeploymentError {
    /// The deployment does not exist.
    #[error("there is no deployment {0}")]
    NotFound(DeploymentId),
    /// The package was deleted.
    #[error("{0} {1} is no longer on the server; push it again")]
    PackageNotFound(TaskName, Version),
    /// The inline package exceeds the size limit of an announcement.
    #[error("delivery: {package} has {size}, inline carries at most {most}")]
    TooLargeForInline {
        package: String,
        size: String,
        /// The largest size possible.
        most: String,
    },
    /// The deployment was cancelled before.
    #[error("deployment {0} was cancelled")]
    Cancelled(DeploymentId),
    /// The deployment is over, and no part of it can be reverted.
    #[error(
        "deployment {0} is over and can't be cancelled; stop, remove or roll back the task instead"
    )]
    NothingToCancel(DeploymentId),
    /// The deployment does not wait for the operator.
    #[error("deployment {id} is not paused: {why}")]
    NotPaused {
        id: DeploymentId,
        /// The condition the deployment waits for.
        why: String,
    },
    /// The deployment ended well everywhere, or a later order replaced it.
    #[error("deployment {0} has no selected robot that failed and has received no newer order")]
    NothingToRetry(DeploymentId),
    /// No robot ran another package of the task before.
    #[error(
        "none of these robots has an earlier package of {0} that ran there and is still on the server"
    )]
    NothingToRollBack(TaskName),
    #[error(transparent)]
    Order(#[from] OrderError),
}

impl From<StoreError> for DeploymentError {
    fn from(error: StoreError) -> Self {
        Self::Order(error.into())
    }
}

impl DeploymentActions {
    /// Orders `package`, which the caller has looked up for `order`, on the robots that match now.
    /// The same key with the same order gives the same deployment.
    pub async fn create(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        order: &CreateDeployment,
        package: &PackageView,
    ) -> Result<DeploymentId, DeploymentError> {
        let request = request_text(order);
        let now_ms = self.clock.now_ms();
        let lifetime_ms = match order.expires_in_s {
            Some(seconds) => lifetime_ms("expires_in_s", seconds)?,
            None => self.assignment_lifetime_ms,
        };
        if order.batch == Some(0) {
            return Err(OrderError::invalid("batch", "expected at least 1 robot").into());
        }
        if !(MIN_PRIORITY..=MAX_PRIORITY).contains(&order.priority) {
            let reason =
                format!("expected {MIN_PRIORITY} to {MAX_PRIORITY}, not {}", order.priority);
            return Err(OrderError::invalid("priority", reason).into());
        }
        let mut write = self.store.begin().await?;
        if let Some(answer) = stored_answer(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        self.check_inline_size(order, package)?;
        let robots = select(&mut write, by, &order.selector).await?;
        let robots: Vec<RobotId> = robots.into_iter().map(|robot| robot.id).collect();
        let (kind, expires_at_ms) = (package.manifest.run.kind, now_ms + lifetime_ms);
        let placement =
            Placement { package: &package.package, kind, order, robots: &robots, expires_at_ms };
        let mut notifications = PendingNotifications::default();
        let mut budget = WriteBudget::of(self.chunk_robots);
        let id = placement
            .place(&mut write, &self.planner, &mut budget, now_ms, &mut notifications)
            .await?;
        let task = &package.package.name;
        let event = AuditEvent::by(by, AuditAction::DeploymentCreate, &id)
            .with("package", format!("{task} {}", package.package.version))
            .with("manifest", package.package.manifest.digest)
            .with("robots", &order.selector)
            .with("count", robots.len());
        write.audit().record(&event, now_ms).await?;
        store_answer(&mut write, by, key, &request, &id, now_ms).await?;
        write.commit().await?;
        self.changes.publish(notifications);
        self.to_continue.notify_one();
        Ok(id)
    }

    /// The robots that [`DeploymentActions::create`] would select now, sorted by name; an error if
    /// there are none.
    pub async fn preview(
        &self,
        by: &Person,
        selector: &Selector,
    ) -> Result<Vec<SelectedRobot>, DeploymentError> {
        Ok(preview(&self.store, by, selector).await?)
    }

    /// Inline packages must fit into one announcement.
    fn check_inline_size(
        &self,
        order: &CreateDeployment,
        package: &PackageView,
    ) -> Result<(), DeploymentError> {
        let (size, most) = (transfer_bytes(&package.package), self.planner.inline_bytes());
        if order.delivery != DeliveryChoice::Inline || size <= most {
            return Ok(());
        }
        let exact = |bytes: u64| {
            if format_bytes(size) == format_bytes(most) {
                format!("{bytes} B")
            } else {
                format_bytes(bytes)
            }
        };
        let package = format!("{} {}", package.package.name, package.package.version);
        Err(DeploymentError::TooLargeForInline { package, size: exact(size), most: exact(most) })
    }

    /// The deployment that an earlier order with this `key` and `order` created. A repeated order
    /// is answered even if its package was deleted.
    pub async fn repeated(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        order: &CreateDeployment,
    ) -> Result<Option<DeploymentId>, DeploymentError> {
        let mut write = self.store.begin().await?;
        Ok(stored_answer(&mut write, by, key, &request_text(order)).await?)
    }

    /// Cancels a deployment: where the deployment has not settled, the package it replaced is
    /// desired again; a running service goes on; robots that it was not placed for are left alone.
    /// If it has many robots, further writes follow for the others. The call is idempotent; a
    /// deployment that is over everywhere is left unchanged.
    pub async fn cancel(&self, by: &Person, id: &DeploymentId) -> Result<(), DeploymentError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let is_cancelled = is_cancelled(&mut write, id).await?;
        check_deployment(&mut write, by, id).await?;
        if is_cancelled {
            return Ok(());
        }
        let is_placing = write.order_chunks().remove_all(id).await?;
        let is_over = write.assignments().revocable(id, 0..=u64::MAX, 1).await?.is_empty();
        if is_over && !is_placing && !write.assignments().may_be_restored(id).await? {
            return Err(DeploymentError::NothingToCancel(id.clone()));
        }
        write.deployments().mark_cancelled(id, now_ms).await?;
        let notifications = self.cancel_from(&mut write, id, 0, now_ms).await?;
        write
            .audit()
            .record(&AuditEvent::by(by, AuditAction::DeploymentCancel, id), now_ms)
            .await?;
        write.commit().await?;
        self.changes.publish(notifications);
        self.to_continue.notify_one();
        Ok(())
    }

    /// Takes a cancelled deployment away from as many robots as fit into one write, from a place in
    /// the deployment on.
    async fn cancel_from(
        &self,
        write: &mut Transaction,
        id: &DeploymentId,
        place: u64,
        now_ms: u64,
    ) -> Result<PendingNotifications, StoreError> {
        let most = self.chunk_robots;
        let found = write.assignments().revocable(id, place..=u64::MAX, most).await?;
        let last = found.last().filter(|_| found.len() == most).map(|row| row.place);
        let robots: Vec<RobotId> = found.into_iter().map(|row| row.robot).collect();
        write.robots().adopt_diverged(&robots, now_ms).await?;
        // Assignments that were adopted from robots share one place.
        let places = place..=last.unwrap_or(u64::MAX);
        let taken = write.assignments().revocable(id, places, usize::MAX).await?;
        let mut notifications =
            revert(write, &self.planner, &taken, Phase::Cancelled, now_ms).await?;
        write.assignments().skip_in_rollback_chain(id).await?;
        write.deployments().set_cancel_from(id, last.map(|last| last + 1)).await?;
        notifications.deployments.insert(id.clone());
        Ok(notifications)
    }

    /// Resumes a paused deployment; the failures so far no longer count. If the deployment is not
    /// paused, the error says why no further batch begins.
    pub async fn resume(&self, by: &Person, id: &DeploymentId) -> Result<(), DeploymentError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let is_cancelled = is_cancelled(&mut write, id).await?;
        check_deployment(&mut write, by, id).await?;
        if is_cancelled {
            return Err(DeploymentError::Cancelled(id.clone()));
        }
        let Some(open) = write.deployments().rollout(id).await?.filter(|open| open.rollout.paused)
        else {
            drop(write);
            return Err(self.not_paused(id).await?);
        };
        let tally = Tally::of(open.failed, rollout::parts(&self.planner, &open, now_ms));
        write.deployments().resume(id, open.rollout.forgiven.max(tally.failures())).await?;
        write
            .audit()
            .record(&AuditEvent::by(by, AuditAction::DeploymentResume, id), now_ms)
            .await?;
        let touched = BTreeSet::from([id.clone()]);
        let mut notifications = PendingNotifications {
            deployments: touched.clone(),
            ..PendingNotifications::default()
        };
        rollout::apply(&mut write, &self.planner, touched, now_ms, &mut notifications).await?;
        write.commit().await?;
        self.changes.publish(notifications);
        Ok(())
    }

    /// The error for resuming a deployment that is not paused, with the reason.
    async fn not_paused(&self, id: &DeploymentId) -> Result<DeploymentError, DeploymentError> {
        let found = self.store.deployments().get(id, false).await?;
        let (deployment, assignments) =
            found.ok_or_else(|| DeploymentError::NotFound(id.clone()))?;
        let offline =
            self.planner.offline_ms(assignments.iter().map(|one| &one.robot), self.clock.now_ms());
        let assignments = assignments
            .into_iter()
            .zip(offline)
            .map(|(one, offline)| one.into_view(offline.is_none()));
        let view = deployment.into_view(Some(assignments.collect()));
        Ok(DeploymentError::NotPaused { id: id.clone(), why: view.unsettled_robots().to_string() })
    }

    /// Begins batches that are due because robots have reconnected or stay offline, or that a
    /// server did not begin which ended after it had stored a report. To be called when a robot has
    /// connected, and every few seconds.
    pub async fn advance_rollouts(&self) -> Result<(), DeploymentError> {
        let open = self.store.deployments().open_rollouts().await?;
        let notifications =
            rollout::advance(&self.store, &self.planner, open, self.clock.now_ms()).await?;
        self.changes.publish(notifications);
        Ok(())
    }
}

/// An order to create a deployment, in the form stored with its idempotency key.
fn request_text(order: &CreateDeployment) -> String {
    format!("Create {}", serde_json::to_string(order).expect("an order always has a JSON form"))
}

async fn is_cancelled(write: &mut Transaction, id: &DeploymentId) -> Result<bool, DeploymentError> {
    write.deployments().is_cancelled(id).await?.ok_or_else(|| DeploymentError::NotFound(id.clone()))
}

/// Whether all robots of a deployment are the person's.
async fn check_deployment(
    write: &mut Transaction,
    by: &Person,
    id: &DeploymentId,
) -> Result<(), OrderError> {
    if by.scope.is_everything() {
        return Ok(());
    }
    let robots = write.robots().of_deployment(id).await?;
    check_scope(by, &robots, || format!("deployment {id}"))
}

/// Ends `taken` in `phase`, restores the assignments that they replaced, and advances the rollouts
/// this touches.
pub(super) async fn revert(
    write: &mut Transaction,
    planner: &DeliveryPlanner,
    taken: &[Revocable],
    phase: Phase,
    now_ms: u64,
) -> Result<PendingNotifications, StoreError> {
    let taken_back = write.assignments().revert(taken, phase, now_ms).await?;
    let touched: BTreeSet<DeploymentId> = taken
        .iter()
        .flat_map(|row| row.previous.iter().chain([&row.deployment]))
        .cloned()
        .collect();
    let mut notifications = PendingNotifications {
        robots: taken.iter().map(|row| row.robot.clone()).collect(),
        to_notify: taken_back.into_iter().collect(),
        deployments: touched.clone(),
        ..PendingNotifications::default()
    };
    rollout::apply(write, planner, touched, now_ms, &mut notifications).await?;
    Ok(notifications)
}
