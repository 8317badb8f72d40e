//! Orders on tasks that robots have: start, restart, stop, remove.

use std::collections::{BTreeSet, HashSet};

use task_proto::ids::selector::Selector;
use task_proto::{RobotId, TaskName};

use super::{DeploymentActions, DeploymentError};
use crate::domain::person::Person;
use crate::orders::actions::OrderError;
use crate::orders::actions::idempotency::{IdempotencyKey, store_answer, stored_answer};
use crate::orders::actions::selection::{
    SelectedRobot, check_scope, matched, quoted, require_known,
};
use crate::orders::changes::PendingNotifications;
use crate::orders::rollout;
use crate::store::{AuditAction, AuditEvent, KnownRobot, TaskOrder, Transaction};

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
        }
        notifications.deployments.extend(touched.iter().cloned());
        rollout::apply(&mut write, &self.planner, touched, now_ms, &mut notifications).await?;
        let event = AuditEvent::by(by, audit_action(order), task)
            .with("robots", selector)
            .with("count", ids.len());
        write.audit().record(&event, now_ms).await?;
        let answer: Vec<SelectedRobot> = robots.into_iter().map(matched).collect();
        store_answer(&mut write, by, key, &request, &answer, now_ms).await?;
        write.commit().await?;
        self.changes.publish(notifications);
        Ok(answer)
    }

    /// The robots that [`DeploymentActions::order_task`] would affect; an error if there are none.
    pub async fn preview_task_order(
        &self,
        by: &Person,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Vec<SelectedRobot>, DeploymentError> {
        let mut robots = require_known(self.store.robots().matching(selector, &by.scope).await?)?;
        retain_with_task(&mut robots, self.store.robots().with_task(task).await?, selector)?;
        check_scope(by, &robots, || quoted(selector))?;
        Ok(robots.into_iter().map(matched).collect())
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
) -> Result<Vec<KnownRobot>, OrderError> {
    let mut robots = require_known(write.robots().matching(selector, &by.scope).await?)?;
    let own = robots.iter().filter(|robot| by.scope.covers(&robot.id, &robot.name, &robot.labels));
    let own: Vec<RobotId> = own.map(|robot| robot.id.clone()).collect();
    write.robots().adopt_diverged(&own, now_ms).await?;
    retain_with_task(&mut robots, write.robots().with_task(task).await?, selector)?;
    check_scope(by, &robots, || quoted(selector))?;
    Ok(robots)
}

fn retain_with_task(
    robots: &mut Vec<KnownRobot>,
    with_task: Vec<RobotId>,
    selector: &Selector,
) -> Result<(), OrderError> {
    let with_task: HashSet<RobotId> = with_task.into_iter().collect();
    robots.retain(|robot| with_task.contains(&robot.id));
    if robots.is_empty() { Err(OrderError::NoRobotsMatch(quoted(selector))) } else { Ok(()) }
}
