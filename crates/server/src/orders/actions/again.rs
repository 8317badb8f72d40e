//! Orders that follow from earlier ones: retries of failed deployments, and rollbacks to the
//! previous package.

use std::collections::{BTreeMap, HashMap, HashSet};

use task_proto::api::{CreateDeployment, DeploymentView, MatchedRobot, RetryDeployment};
use task_proto::desired::PackageRef;
use task_proto::manifest::TaskKind;
use task_proto::selector::Selector;
use task_proto::{DeploymentId, Digest, RobotId, TaskName};

use super::deployments::Placed;
use super::robots::matched;
use super::tasks::meant;
use super::{ActionError, Actions, IdempotencyKey, Remembered, all_known, check_scope};
use crate::domain::person::Person;
use crate::orders::changes::Consequences;
use crate::store::{Act, Deed, KnownRobot, Write};

/// The result of a rollback, or its preview.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Rollback {
    /// The deployments of the rollback, one for each package.
    pub deployments: Vec<DeploymentId>,
    /// Robots that are rolled back, sorted by name. `online` is left false.
    pub robots: Vec<MatchedRobot>,
    /// Robots without an earlier package, sorted by name. `online` is left false.
    pub without: Vec<MatchedRobot>,
}

impl Remembered for Rollback {
    fn keep_robots(&mut self, own: &HashSet<RobotId>) {
        self.robots.keep_robots(own);
        self.without.keep_robots(own);
    }
}

/// Robots that go back to one package.
type Goal = (PackageRef, TaskKind, Vec<RobotId>);

impl Actions {
    /// Orders the package of deployment `id` once more, in the same way, on the robots where the
    /// deployment ended badly. The same key with the same order gives the same deployment.
    pub async fn retry_deployment(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        id: &DeploymentId,
        retry: &RetryDeployment,
    ) -> Result<DeploymentId, ActionError> {
        let said = serde_json::to_string(retry).expect("an order always has a JSON form");
        let request = format!("Retry {id} {said}");
        let now_ms = self.clock.now_ms();
        let past = self.past_deployment(id).await?;
        let package = self.store.package(&past.package.name, &past.package.manifest.digest).await?;
        let mut write = self.store.begin().await?;
        if let Some(answer) = self.answered_before(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let PackageRef { name, version, .. } = &past.package;
        let package =
            package.ok_or_else(|| ActionError::PackageNotFound(name.clone(), version.clone()))?;
        let selector = match &retry.selector {
            Some(selector) => Some(selector.clone()),
            None => self.store.deployment_selector(id).await?,
        };
        let selector = selector.ok_or_else(|| ActionError::DeploymentNotFound(id.clone()))?;
        let robots: Vec<RobotId> = to_retry(&mut write, by, &past, retry)
            .await?
            .into_iter()
            .map(|robot| robot.id)
            .collect();
        let order = CreateDeployment {
            delivery: past.delivery,
            priority: past.priority,
            batch: past.batch,
            max_failures: past.max_failures,
            ..CreateDeployment::new(
                package.package.name.clone(),
                package.package.manifest.digest,
                selector,
            )
        };
        self.check_fits(&order, &package)?;
        // Deployments taken over from robots after the database was restored have no lifetime of
        // their own.
        let lifetime_ms = match past.expires_at_ms.saturating_sub(past.created_at_ms) {
            0 => self.settings.assignment_lifetime_ms,
            lifetime_ms => lifetime_ms,
        };
        let expires_at_ms = now_ms + lifetime_ms;
        let kind = package.manifest.run.kind;
        let placed = Placed {
            package: &package.package,
            kind,
            order: &order,
            robots: &robots,
            expires_at_ms,
        };
        let mut consequences = Consequences::default();
        let new = placed.place(&mut write, &self.chooser, now_ms, &mut consequences).await?;
        let deed = Deed::by(by, Act::DeploymentRetry, &new)
            .with("of", id)
            .with("package", format!("{} {}", package.package.name, package.package.version))
            .with_some("robots", retry.selector.as_ref())
            .with_some("code", retry.code.as_ref().map(|code| code.as_str()))
            .with("count", robots.len());
        write.audit(&deed, now_ms).await?;
        self.remember_answer(&mut write, by, key, &request, &new, now_ms).await?;
        write.commit().await?;
        self.changes.publish(consequences);
        Ok(new)
    }

    /// The robots that [`Actions::retry_deployment`] would retry; an error if there are none.
    pub async fn robots_to_retry(
        &self,
        by: &Person,
        id: &DeploymentId,
        retry: &RetryDeployment,
    ) -> Result<Vec<MatchedRobot>, ActionError> {
        let past = self.past_deployment(id).await?;
        // This transaction is never committed.
        let mut write = self.store.begin_keeping_rights().await?;
        Ok(to_retry(&mut write, by, &past, retry).await?.into_iter().map(matched).collect())
    }

    /// Rolls the matching robots back to the package of `task` that ran there before the one they
    /// should have now; one deployment for each package. The same key gives the same answer.
    pub async fn roll_back(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Rollback, ActionError> {
        let request = format!("RollBack {task} {selector}");
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if let Some(answer) = self.answered_before(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let (mut rollback, goals) = rollback(&mut write, by, task, selector, now_ms).await?;
        if goals.is_empty() {
            return Err(ActionError::NothingToRollBack(task.clone()));
        }
        let expires_at_ms = now_ms + self.settings.assignment_lifetime_ms;
        let mut consequences = Consequences::default();
        for (package, kind, robots) in goals {
            let order =
                CreateDeployment::new(task.clone(), package.manifest.digest, selector.clone());
            let placed =
                Placed { package: &package, kind, order: &order, robots: &robots, expires_at_ms };
            let id = placed.place(&mut write, &self.chooser, now_ms, &mut consequences).await?;
            rollback.deployments.push(id);
        }
        let deployments: Vec<&str> =
            rollback.deployments.iter().map(DeploymentId::as_str).collect();
        let deed = Deed::by(by, Act::TaskRollBack, task)
            .with("robots", selector)
            .with("count", rollback.robots.len())
            .with("deployments", deployments.join(","));
        write.audit(&deed, now_ms).await?;
        self.remember_answer(&mut write, by, key, &request, &rollback, now_ms).await?;
        write.commit().await?;
        self.changes.publish(consequences);
        Ok(rollback)
    }

    pub async fn rollback(
        &self,
        by: &Person,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Rollback, ActionError> {
        // This transaction is never committed.
        let mut write = self.store.begin_keeping_rights().await?;
        Ok(rollback(&mut write, by, task, selector, self.clock.now_ms()).await?.0)
    }

    async fn past_deployment(&self, id: &DeploymentId) -> Result<DeploymentView, ActionError> {
        let found = self.store.deployment_summary(id).await?;
        found.ok_or_else(|| ActionError::DeploymentNotFound(id.clone()))
    }
}

async fn to_retry(
    write: &mut Write,
    by: &Person,
    past: &DeploymentView,
    retry: &RetryDeployment,
) -> Result<Vec<KnownRobot>, ActionError> {
    if !by.scope.is_everything() {
        let all = write.robots_of_deployment(&past.id).await?;
        if !all.iter().any(|robot| by.scope.covers(&robot.id, &robot.name, &robot.labels)) {
            check_scope(by, &all, || format!("deployment {}", past.id))?;
        }
    }
    let mut found = write.unsuccessful(&past.id).await?;
    if let Some(code) = &retry.code {
        found.retain(|one| one.failure.as_ref().is_some_and(|failure| failure.code == *code));
    }
    if let Some(selector) = &retry.selector {
        all_known(write.matching_robots(selector, &by.scope).await?)?;
        found.retain(|one| selector.matches(&one.robot.id, &one.robot.name, &one.robot.labels));
    }
    let robots: Vec<KnownRobot> = found.into_iter().map(|one| one.robot).collect();
    if robots.is_empty() {
        return Err(ActionError::NothingToRetry(past.id.clone()));
    }
    check_scope(by, &robots, || format!("deployment {}", past.id))?;
    Ok(robots)
}

/// The robots to roll back, with their packages; an error if no robot has the task.
async fn rollback(
    write: &mut Write,
    by: &Person,
    task: &TaskName,
    selector: &Selector,
    now_ms: u64,
) -> Result<(Rollback, Vec<Goal>), ActionError> {
    let robots = meant(write, by, task, selector, now_ms).await?;
    let ids: Vec<RobotId> = robots.iter().map(|robot| robot.id.clone()).collect();
    let earlier = write.earlier_packages(task, &ids).await?;
    let mut package_of: HashMap<RobotId, (PackageRef, TaskKind)> = earlier
        .into_iter()
        .map(|earlier| (earlier.robot, (earlier.package, earlier.kind)))
        .collect();
    let (mut rollback, mut goals) = (Rollback::default(), BTreeMap::<Digest, Goal>::new());
    for robot in robots {
        match package_of.remove(&robot.id) {
            Some((package, kind)) => {
                let goal = goals
                    .entry(package.manifest.digest)
                    .or_insert_with(|| (package, kind, Vec::new()));
                goal.2.push(robot.id.clone());
                rollback.robots.push(matched(robot));
            }
            None => rollback.without.push(matched(robot)),
        }
    }
    Ok((rollback, goals.into_values().collect()))
}
