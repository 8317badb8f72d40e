//! Orders on tasks that robots have: start, restart, stop, remove.

use std::collections::{BTreeSet, HashSet};

use task_proto::api::MatchedRobot;
use task_proto::selector::Selector;
use task_proto::{RobotId, TaskName};

use super::robots::matched;
use super::{ActionError, Actions, IdempotencyKey, TaskOrder, all_known, check_scope, quoted};
use crate::domain::person::Person;
use crate::orders::advance::advance;
use crate::orders::changes::Consequences;
use crate::store::{Act, Deed, KnownRobot, Write};

impl Actions {
    /// Orders `task` started, restarted, stopped or removed on the robots that match and have the
    /// task. The same key gives the same answer, and orders nothing twice. `online` is left false.
    pub async fn order_task(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        order: TaskOrder,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Vec<MatchedRobot>, ActionError> {
        let request = format!("{order:?} {task} {selector}");
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if let Some(answer) = self.answered_before(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let robots = meant(&mut write, by, task, selector, now_ms).await?;
        let ids: Vec<RobotId> = robots.iter().map(|robot| robot.id.clone()).collect();
        let expires_at_ms = now_ms + self.settings.assignment_lifetime_ms;
        let changed = write.order_on_task(order, task, &ids, expires_at_ms, now_ms).await?;
        let mut touched = BTreeSet::new();
        let mut consequences = Consequences::default();
        for (deployment, robot) in changed {
            touched.insert(deployment);
            consequences.rings.insert(robot);
        }
        if matches!(order, TaskOrder::Stop | TaskOrder::Remove) {
            touched.extend(write.drop_waiting(Some(task), &ids, now_ms).await?);
        }
        consequences.deployments.extend(touched.iter().cloned());
        advance(&mut write, &self.chooser, touched, now_ms, &mut consequences).await?;
        let deed = Deed::by(by, act(order), task).with("robots", selector).with("count", ids.len());
        write.audit(&deed, now_ms).await?;
        let answer: Vec<MatchedRobot> = robots.into_iter().map(matched).collect();
        self.remember_answer(&mut write, by, key, &request, &answer, now_ms).await?;
        write.commit().await?;
        self.changes.publish(consequences);
        Ok(answer)
    }

    /// The robots that [`Actions::order_task`] would affect; an error if there are none.
    pub async fn robots_with_task(
        &self,
        by: &Person,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Vec<MatchedRobot>, ActionError> {
        let mut robots = all_known(self.store.matching_robots(selector, &by.scope).await?)?;
        keep_those_with_task(&mut robots, self.store.robots_with_task(task).await?, selector)?;
        check_scope(by, &robots, || quoted(selector))?;
        Ok(robots.into_iter().map(matched).collect())
    }
}

fn act(order: TaskOrder) -> Act {
    match order {
        TaskOrder::Start => Act::TaskStart,
        TaskOrder::Restart => Act::TaskRestart,
        TaskOrder::Stop => Act::TaskStop,
        TaskOrder::Remove => Act::TaskRemove,
    }
}

/// The robots that match and have the task, each of which must be in this person's scope; an error
/// if there are none.
pub(super) async fn meant(
    write: &mut Write,
    by: &Person,
    task: &TaskName,
    selector: &Selector,
    now_ms: u64,
) -> Result<Vec<KnownRobot>, ActionError> {
    let mut robots = all_known(write.matching_robots(selector, &by.scope).await?)?;
    let own = robots.iter().filter(|robot| by.scope.covers(&robot.id, &robot.name, &robot.labels));
    let own: Vec<RobotId> = own.map(|robot| robot.id.clone()).collect();
    write.adopt_diverged(&own, now_ms).await?;
    keep_those_with_task(&mut robots, write.robots_with_task(task).await?, selector)?;
    check_scope(by, &robots, || quoted(selector))?;
    Ok(robots)
}

fn keep_those_with_task(
    robots: &mut Vec<KnownRobot>,
    with_task: Vec<RobotId>,
    selector: &Selector,
) -> Result<(), ActionError> {
    let with_task: HashSet<RobotId> = with_task.into_iter().collect();
    robots.retain(|robot| with_task.contains(&robot.id));
    if robots.is_empty() { Err(ActionError::NoRobotsMatch(quoted(selector))) } else { Ok(()) }
}
