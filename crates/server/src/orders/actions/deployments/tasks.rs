//! Orders on tasks that robots have: start, restart, stop, remove.

use std::collections::BTreeSet;

use task_proto::ids::selector::Selector;
use task_proto::{RobotId, TaskName};

use super::{DeploymentActions, DeploymentError};
use crate::domain::person::Person;
use crate::orders::actions::OrderError;
use crate::orders::actions::idempotency::{IdempotencyKey, store_answer, stored_answer};
use crate::orders::actions::selection::require_selected;
use crate::orders::changes::PendingNotifications;
use crate::orders::rollout;
use crate::store::{AuditAction, AuditEvent, SelectedRobot, TaskOrder, Transaction};

impl DeploymentActions {
    /// Orders `task` started, restarted, stopped or removed on the robots that match and have the
    /// task. The same key gives the same answer, and orders nothing twice.
    pub async fn order_task(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        order: TaskOrder,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Vec<SelectedRobot>, DeploymentError> {
        let request = format!("{order:?} {task} {selector}");
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if let Some(answer) = stored_answer(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let robots = robots_with_task(&mut write, by, task, selector, now_ms).await?;
        let ids: Vec<RobotId> = robots.iter().map(|robot| robot.id.clone()).collect();
        let expires_at_ms = now_ms + self.assignment_lifetime_ms;
        let changed = write.assignments().apply(order, task, &ids, expires_at_ms, now_ms).await?;
        let mut touched = BTreeSet::new();
        let mut notifications = PendingNotifications::default();
        for (deployment, robot) in changed {
            touched.insert(deployment);
            notifications.to_notify.insert(robot);
        }
        if matches!(order, TaskOrder::Stop | TaskOrder::Remove) {
            touched.extend(write.assignments().drop_waiting(Some(task), &ids, now_ms).await?);
            touched.extend(write.order_chunks().drop_robots(task, &ids).await?);
        }
        notifications.deployments.extend(touched.iter().cloned());
        rollout::apply(&mut write, &self.planner, touched, now_ms, &mut notifications).await?;
        let event = AuditEvent::by(by, audit_action(order), task)
            .with("robots", selector)
            .with("count", ids.len());
        write.audit().record(&event, now_ms).await?;
        store_answer(&mut write, by, key, &request, &robots, now_ms).await?;
        write.commit().await?;
        self.changes.publish(notifications);
        Ok(robots)
    }

    /// The robots that [`DeploymentActions::order_task`] would affect; an error if there are none.
    pub async fn preview_task_order(
        &self,
        by: &Person,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Vec<SelectedRobot>, DeploymentError> {
        let matching = self.store.robots().matching(selector, &by.scope, Some(task)).await?;
        Ok(require_selected(by, matching, selector)?)
    }
}

fn audit_action(order: TaskOrder) -> AuditAction {
    match order {
        TaskOrder::Start => AuditAction::TaskStart,
        TaskOrder::Restart => AuditAction::TaskRestart,
        TaskOrder::Stop => AuditAction::TaskStop,
        TaskOrder::Remove => AuditAction::TaskRemove,
    }
}

/// The robots that match and have the task, each of which must be in this person's scope; an error
/// if there are none.
pub(super) async fn robots_with_task(
    write: &mut Transaction,
    by: &Person,
    task: &TaskName,
    selector: &Selector,
    now_ms: u64,
) -> Result<Vec<SelectedRobot>, OrderError> {
    if write.robots().are_any_diverged().await? {
        let matching = write.robots().matching(selector, &by.scope, None).await?;
        let own = matching.robots.into_iter().zip(matching.in_scope);
        let own: Vec<RobotId> =
            own.filter_map(|(robot, is_own)| is_own.then_some(robot.id)).collect();
        write.robots().adopt_diverged(&own, now_ms).await?;
    }
    let matching = write.robots().matching(selector, &by.scope, Some(task)).await?;
    require_selected(by, matching, selector)
}
