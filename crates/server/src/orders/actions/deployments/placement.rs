//! Placing orders: every selected robot gets its assignment. An order for few robots is placed in
//! the write that makes it, a large one in chunks, so that no write keeps reports waiting for long.
//! The rest of a large order is in the database. Any server places the next chunk, which it reads
//! within the same write. The cancel of a large deployment goes on in the same way.

use task_proto::api::CreateDeployment;
use task_proto::desired::PackageRef;
use task_proto::packages::manifest::TaskKind;
use task_proto::{DeploymentId, RobotId, TaskName};

use super::{DeploymentActions, DeploymentError};
use crate::orders::changes::PendingNotifications;
use crate::orders::delivery_planner::DeliveryPlanner;
use crate::orders::rollout;
use crate::store::{NewDeployment, OrderChunk, StillRunning, StoreError, Transaction};

/// The most robots that one write places an order for.
pub const CHUNK_ROBOTS: usize = 500;

/// A package that is ordered on robots.
pub(super) struct Placement<'a> {
    pub(super) package: &'a PackageRef,
    pub(super) kind: TaskKind,
    /// The order to place.
    pub(super) order: &'a CreateDeployment,
    pub(super) robots: &'a [RobotId],
    pub(super) expires_at_ms: u64,
}

/// How many robots a write may still place orders for.
pub(super) struct WriteBudget {
    /// The most robots of one write.
    chunk: usize,
    left: usize,
}

/// Robots that got their assignments of a deployment in this write.
struct PlacedRobots<'a> {
    deployment: &'a DeploymentId,
    task: &'a TaskName,
    restart: bool,
    first_place: u64,
    robots: &'a [RobotId],
}

impl WriteBudget {
    pub(super) fn of(chunk: usize) -> Self {
        Self { chunk, left: chunk }
    }
}

impl Placement<'_> {
    /// Stores the deployment, places it for as many robots as the budget allows, and stores the
    /// rest of the robots for later writes.
    pub(super) async fn place(
        &self,
        write: &mut Transaction,
        planner: &DeliveryPlanner,
        budget: &mut WriteBudget,
        now_ms: u64,
        notifications: &mut PendingNotifications,
    ) -> Result<DeploymentId, StoreError> {
        let &Self { package, kind, order, robots, expires_at_ms } = self;
        let id = DeploymentId::random();
        let (first, rest) = robots.split_at(robots.len().min(budget.left));
        budget.left -= first.len();
        let (selected, placed) = (robots.len() as u64, first.len() as u64);
        let new = NewDeployment { id: &id, package, kind, order, selected, placed, expires_at_ms };
        write.deployments().insert(&new, now_ms).await?;
        write.order_chunks().insert(&id, first.len(), rest, budget.chunk).await?;
        let (task, restart) = (&package.name, order.restart);
        let placed = PlacedRobots { deployment: &id, task, restart, first_place: 0, robots: first };
        write.assignments().insert(&id, task, first, 0, now_ms).await?;
        placed.begin(write, planner, now_ms, notifications).await?;
        Ok(id)
    }
}

impl PlacedRobots<'_> {
    /// Advances all deployments that may go on now that these robots have an assignment, including
    /// this one. Where the package runs already, nothing begins unless `restart` is set.
    async fn begin(
        &self,
        write: &mut Transaction,
        planner: &DeliveryPlanner,
        now_ms: u64,
        notifications: &mut PendingNotifications,
    ) -> Result<(), StoreError> {
        let &Self { deployment, task, restart, first_place, robots } = self;
        let mut assignments = write.assignments();
        let mut touched =
            assignments.supersede_waiting(deployment, task, first_place, now_ms).await?;
        if !restart {
            assignments.settle_running(deployment, first_place, now_ms).await?;
            let still_running =
                assignments.settle_still_running(deployment, task, first_place, now_ms).await?;
            for StillRunning { robot, failed, earlier } in still_running {
                notifications.to_notify.insert(robot);
                notifications.deployments.extend([failed, earlier]);
            }
        }
        tracing::debug!(%deployment, robots = robots.len(), first_place, "an order was placed");
        touched.insert(deployment.clone());
        notifications.deployments.extend(touched.iter().cloned());
        rollout::apply(write, planner, touched, now_ms, notifications).await
    }
}

impl DeploymentActions {
    /// Carries out the next part of an order that was too large for one write: takes a cancelled
    /// deployment away from more robots, or places the oldest order for more robots. False if there
    /// is none. To be called until it returns false, after an order and every few seconds.
    pub async fn continue_order(&self) -> Result<bool, DeploymentError> {
        if !self.store.order_chunks().are_any().await? {
            return Ok(false);
        }
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let to_cancel = write.deployments().next_to_cancel().await?;
        let to_place = write.order_chunks().next().await?;
        let notifications = match (to_cancel, to_place) {
            (Some((id, place)), _) => self.cancel_from(&mut write, &id, place, now_ms).await?,
            (None, Some(chunk)) => self.place_chunk(&mut write, &chunk, now_ms).await?,
            (None, None) => return Ok(false),
        };
        write.commit().await?;
        self.changes.publish(notifications);
        Ok(true)
    }

    /// Places a chunk of an order. Robots that were removed since the order are skipped.
    async fn place_chunk(
        &self,
        write: &mut Transaction,
        chunk: &OrderChunk,
        now_ms: u64,
    ) -> Result<PendingNotifications, StoreError> {
        let OrderChunk { deployment, task, restart, first_place, robots, dropped, .. } = chunk;
        let (restart, first_place) = (*restart, *first_place);
        write.order_chunks().remove(chunk).await?;
        write.assignments().insert(deployment, task, robots, first_place, now_ms).await?;
        write.assignments().drop_from(deployment, first_place, dropped, now_ms).await?;
        write.assignments().yield_to_newer(chunk, now_ms).await?;
        let mut notifications = PendingNotifications::default();
        let placed = PlacedRobots { deployment, task, restart, first_place, robots };
        placed.begin(write, &self.planner, now_ms, &mut notifications).await?;
        Ok(notifications)
    }

    /// Waits until an order was made that was too large for one write.
    pub async fn order_to_continue(&self) {
        self.to_continue.notified().await;
    }
}
