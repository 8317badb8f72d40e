//! Advances rollouts: applies the decisions of [`crate::domain::rollout`], inside the order that may
//! have settled an assignment, or in a write of its own after reports and when robots come or go.

use std::collections::BTreeSet;

use task_proto::desired::Delivery;
use task_proto::{DeploymentId, RobotId};

use super::changes::PendingNotifications;
use super::delivery_planner::DeliveryPlanner;
use crate::domain::rollout::{Move, Part, Tally, next_move};
use crate::store::{OpenRobot, OpenRollout, Store, StoreError, Transaction};

/// Does as [`apply`], in a write of its own. Returns the changes, which are committed.
pub async fn advance(
    store: &Store,
    planner: &DeliveryPlanner,
    deployments: BTreeSet<DeploymentId>,
    now_ms: u64,
) -> Result<PendingNotifications, StoreError> {
    let mut notifications = PendingNotifications::default();
    if deployments.is_empty() {
        return Ok(notifications);
    }
    let mut write = store.begin_without_auth_invalidation().await?;
    apply(&mut write, planner, deployments, now_ms, &mut notifications).await?;
    // Without a change there is nothing to commit.
    if !notifications.deployments.is_empty() {
        write.commit().await?;
    }
    Ok(notifications)
}

/// Begins the next batch of each of `touched` that is due, or pauses the rollout. A batch that
/// replaces another deployment on some robot may settle the other deployment's batch, so the other
/// one is checked as well.
pub async fn apply(
    write: &mut Transaction,
    planner: &DeliveryPlanner,
    touched: BTreeSet<DeploymentId>,
    now_ms: u64,
    notifications: &mut PendingNotifications,
) -> Result<(), StoreError> {
    let mut waiting = touched;
    // Terminates, because each turn but the last of a deployment releases an assignment, and
    // released assignments never become unreleased.
    while let Some(deployment) = waiting.pop_first() {
        let Some(open) = write.deployments().rollout(&deployment).await? else { continue };
        let parts = parts(planner, &open, now_ms);
        match next_move(&open.rollout, &Tally::of(open.failed, parts.iter().copied())) {
            Move::Wait => continue,
            Move::AwaitOffline
                if !write.assignments().await_offline(&deployment, now_ms).await? =>
            {
                continue;
            }
            Move::AwaitOffline => {}
            Move::Pause => write.deployments().pause(&deployment).await?,
            Move::Release(count) => {
                if open.rollout.batch.is_some() {
                    write
                        .assignments()
                        .postpone(&deployment, &passed_over(&open, &parts, count))
                        .await?;
                }
                let released = write.assignments().release(&deployment, count, now_ms).await?;
                notifications.deployments.extend(released.superseded.iter().cloned());
                for (robot, mechanism) in
                    planner.decide(write, &deployment, &released.robots, now_ms).await?
                {
                    // Robots that poll are not notified.
                    match mechanism {
                        Delivery::Poll => notifications.robots.insert(robot),
                        Delivery::PushPull | Delivery::DirectPush | Delivery::Inline => {
                            notifications.to_notify.insert(robot)
                        }
                    };
                }
                waiting.extend(released.superseded);
                // The batch may consist only of robots that the rollout does not wait for.
                waiting.insert(deployment.clone());
            }
        }
        notifications.deployments.insert(deployment);
    }
    Ok(())
}

/// The current part in the rollout of each robot on which the deployment has not settled.
pub fn parts(planner: &DeliveryPlanner, open: &OpenRollout, now_ms: u64) -> Vec<Part> {
    let offline_ms = planner.offline_ms(open.robots.iter().map(|one| &one.robot), now_ms);
    let part =
        |(one, offline_ms): (&OpenRobot, Option<u64>)| match Part::of(one.progress, offline_ms) {
            // A revoked robot takes its turn without a result.
            Part::Offline if one.is_revoked => Part::Ready,
            Part::Busy | Part::Lost if one.is_revoked || one.has_run => Part::Ignored,
            part => part,
        };
    open.robots.iter().zip(offline_ms).map(part).collect()
}

/// The offline robots whose turn would come before that of the next `count` ready robots.
fn passed_over<'a>(open: &'a OpenRollout, parts: &[Part], count: u64) -> Vec<&'a RobotId> {
    let ready =
        parts.iter().enumerate().filter(|(_, part)| **part == Part::Ready).map(|(index, _)| index);
    let last = usize::try_from(count.saturating_sub(1))
        .ok()
        .and_then(|skipped| ready.clone().nth(skipped));
    let before = last.unwrap_or(parts.len());
    let offline =
        open.robots.iter().zip(parts).take(before).filter(|(_, part)| **part == Part::Offline);
    offline.map(|(one, _)| &one.robot).collect()
}
