//! Orders that follow from earlier ones: retries of failed deployments, and rollbacks to the
//! previous package.

use std::collections::{BTreeMap, HashMap, HashSet};

use task_proto::api::{CreateDeployment, RetryDeployment};
use task_proto::desired::PackageRef;
use task_proto::ids::selector::Selector;
use task_proto::packages::manifest::TaskKind;
use task_proto::{DeploymentId, Digest, RobotId, TaskName};

use super::tasks::robots_with_task;
use super::{DeploymentActions, DeploymentError, Placement, WriteBudget};
use crate::domain::person::Person;
use crate::orders::actions::OrderError;
use crate::orders::actions::idempotency::{
    IdempotencyKey, StoredAnswer, store_answer, stored_answer,
};
use crate::orders::actions::selection::{check_scope, matched, require_known};
use crate::orders::changes::PendingNotifications;
use crate::store::{
    AuditAction, AuditEvent, DeploymentRow, KnownRobot, SelectedRobot, Transaction,
};

/// The result of a rollback, or its preview.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Rollback {
    /// The deployments of the rollback, one for each package.
    pub deployments: Vec<DeploymentId>,
    /// Robots that are rolled back, sorted by name.
    pub robots: Vec<SelectedRobot>,
    /// Robots without an earlier package, sorted by name.
    pub without: Vec<SelectedRobot>,
}

impl StoredAnswer for Rollback {
    fn keep_robots(&mut self, own: &HashSet<RobotId>) {
        self.robots.keep_robots(own);
        self.without.keep_robots(own);
    }
}

/// Robots that go back to one package.
type RollbackTarget = (PackageRef, TaskKind, Vec<RobotId>);

impl DeploymentActions {
    /// Orders the package of deployment `id` once more, in the same way, on the robots where the
    /// deployment ended badly. The same key with the same order gives the same deployment.
    pub async fn retry(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        id: &DeploymentId,
        retry: &RetryDeployment,
    ) -> Result<DeploymentId, DeploymentError> {
        let options = serde_json::to_string(retry).expect("an order always has a JSON form");
        let request = format!("Retry {id} {options}");
        let now_ms = self.clock.now_ms();
        let past = self.deployment(id).await?;
        let package =
            self.store.packages().get(&past.package.name, &past.package.manifest.digest).await?;
        let mut write = self.store.begin().await?;
        if let Some(answer) = stored_answer(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let PackageRef { name, version, .. } = &past.package;
        let package = package
            .ok_or_else(|| DeploymentError::PackageNotFound(name.clone(), version.clone()))?;
        let selector = match &retry.selector {
            Some(selector) => Some(selector.clone()),
            None => self.store.deployments().selector(id).await?,
        };
        let selector = selector.ok_or_else(|| DeploymentError::NotFound(id.clone()))?;
        let robots: Vec<RobotId> = failed_robots(&mut write, by, &past, retry)
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
        self.check_inline_size(&order, &package)?;
        // Deployments taken over from robots after the database was restored have no lifetime of
        // their own.
        let lifetime_ms = match past.expires_at_ms.saturating_sub(past.created_at_ms) {
            0 => self.assignment_lifetime_ms,
            lifetime_ms => lifetime_ms,
        };
        let expires_at_ms = now_ms + lifetime_ms;
        let kind = package.manifest.run.kind;
        let placement = Placement {
            package: &package.package,
            kind,
            order: &order,
            robots: &robots,
            expires_at_ms,
        };
        let mut notifications = PendingNotifications::default();
        let mut budget = WriteBudget::of(self.chunk_robots);
        let new = placement
            .place(&mut write, &self.planner, &mut budget, now_ms, &mut notifications)
            .await?;
        let event = AuditEvent::by(by, AuditAction::DeploymentRetry, &new)
            .with("of", id)
            .with("package", format!("{} {}", package.package.name, package.package.version))
            .with_some("robots", retry.selector.as_ref())
            .with_some("code", retry.code.as_ref().map(|code| code.as_str()))
            .with("count", robots.len());
        write.audit().record(&event, now_ms).await?;
        store_answer(&mut write, by, key, &request, &new, now_ms).await?;
        write.commit().await?;
        self.changes.publish(notifications);
        self.to_continue.notify_one();
        Ok(new)
    }

    /// The robots that [`DeploymentActions::retry`] would retry; an error if there are none.
    pub async fn preview_retry(
        &self,
        by: &Person,
        id: &DeploymentId,
        retry: &RetryDeployment,
    ) -> Result<Vec<SelectedRobot>, DeploymentError> {
        let past = self.deployment(id).await?;
        // This transaction is never committed.
        let mut write = self.store.begin_without_auth_invalidation().await?;
        Ok(failed_robots(&mut write, by, &past, retry).await?.into_iter().map(matched).collect())
    }

    /// Rolls the matching robots back to the package of `task` that ran there before the one they
    /// should have now; one deployment for each package. The same key gives the same answer.
    pub async fn rollback(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Rollback, DeploymentError> {
        let request = format!("RollBack {task} {selector}");
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if let Some(answer) = stored_answer(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let (mut rollback, targets) = plan_rollback(&mut write, by, task, selector, now_ms).await?;
        if targets.is_empty() {
            return Err(DeploymentError::NothingToRollBack(task.clone()));
        }
        let expires_at_ms = now_ms + self.assignment_lifetime_ms;
        let (mut budget, mut notifications) =
            (WriteBudget::of(self.chunk_robots), PendingNotifications::default());
        for (package, kind, robots) in targets {
            let order =
                CreateDeployment::new(task.clone(), package.manifest.digest, selector.clone());
            let placement = Placement {
                package: &package,
                kind,
                order: &order,
                robots: &robots,
                expires_at_ms,
            };
            let id = placement
                .place(&mut write, &self.planner, &mut budget, now_ms, &mut notifications)
                .await?;
            rollback.deployments.push(id);
        }
        let deployments: Vec<&str> =
            rollback.deployments.iter().map(DeploymentId::as_str).collect();
        let event = AuditEvent::by(by, AuditAction::TaskRollBack, task)
            .with("robots", selector)
            .with("count", rollback.robots.len())
            .with("deployments", deployments.join(","));
        write.audit().record(&event, now_ms).await?;
        store_answer(&mut write, by, key, &request, &rollback, now_ms).await?;
        write.commit().await?;
        self.changes.publish(notifications);
        self.to_continue.notify_one();
        Ok(rollback)
    }

    pub async fn preview_rollback(
        &self,
        by: &Person,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Rollback, DeploymentError> {
        // This transaction is never committed.
        let mut write = self.store.begin_without_auth_invalidation().await?;
        Ok(plan_rollback(&mut write, by, task, selector, self.clock.now_ms()).await?.0)
    }

    async fn deployment(&self, id: &DeploymentId) -> Result<DeploymentRow, DeploymentError> {
        let found = self.store.deployments().summary(id).await?;
        found.ok_or_else(|| DeploymentError::NotFound(id.clone()))
    }
}

async fn failed_robots(
    write: &mut Transaction,
    by: &Person,
    past: &DeploymentRow,
    retry: &RetryDeployment,
) -> Result<Vec<KnownRobot>, DeploymentError> {
    if !by.scope.is_everything() {
        let all = write.robots().of_deployment(&past.id).await?;
        if !all.iter().any(|robot| by.scope.covers(&robot.id, &robot.name, &robot.labels)) {
            check_scope(by, &all, || format!("deployment {}", past.id))?;
        }
    }
    let mut found = write.assignments().unsuccessful(&past.id).await?;
    if let Some(code) = &retry.code {
        found.retain(|one| one.failure.as_ref().is_some_and(|failure| failure.code == *code));
    }
    if let Some(selector) = &retry.selector {
        require_known(write.robots().unknown(selector, &by.scope).await?)?;
        found.retain(|one| selector.matches(&one.robot.id, &one.robot.name, &one.robot.labels));
    }
    let robots: Vec<KnownRobot> = found.into_iter().map(|one| one.robot).collect();
    if robots.is_empty() {
        return Err(DeploymentError::NothingToRetry(past.id.clone()));
    }
    check_scope(by, &robots, || format!("deployment {}", past.id))?;
    Ok(robots)
}

/// The robots to roll back, with their packages; an error if no robot has the task.
async fn plan_rollback(
    write: &mut Transaction,
    by: &Person,
    task: &TaskName,
    selector: &Selector,
    now_ms: u64,
) -> Result<(Rollback, Vec<RollbackTarget>), OrderError> {
    let robots = robots_with_task(write, by, task, selector, now_ms).await?;
    let ids: Vec<RobotId> = robots.iter().map(|robot| robot.id.clone()).collect();
    let earlier = write.assignments().previous_packages(task, &ids).await?;
    let mut package_of: HashMap<RobotId, (PackageRef, TaskKind)> = earlier
        .into_iter()
        .map(|earlier| (earlier.robot, (earlier.package, earlier.kind)))
        .collect();
    let (mut rollback, mut targets) =
        (Rollback::default(), BTreeMap::<Digest, RollbackTarget>::new());
    for robot in robots {
        match package_of.remove(&robot.id) {
            Some((package, kind)) => {
                let target = targets
                    .entry(package.manifest.digest)
                    .or_insert_with(|| (package, kind, Vec::new()));
                target.2.push(robot.id.clone());
                rollback.robots.push(robot);
            }
            None => rollback.without.push(robot),
        }
    }
    Ok((rollback, targets.into_values().collect()))
}
