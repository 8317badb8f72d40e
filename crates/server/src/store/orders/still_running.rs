//! Orders for a package that a robot still runs although a later one was ordered there: the later
//! one failed, and the robot kept the earlier one or went back to it. The earlier deployment then
//! becomes the desired one again, so that the robot starts nothing anew.

use sqlx::Row as _;
use task_proto::desired::TargetState;
use task_proto::messages::report::{Phase, Report};
use task_proto::{DeploymentId, RobotId, TaskName};

use crate::store::repositories::Assignments;
use crate::store::rows::{from_json, id, stored};
use crate::store::timelines::appended_phase;
use crate::store::{StoreError, Transaction};

/// A robot that still runs an ordered package.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StillRunning {
    pub robot: RobotId,
    /// The deployment that has failed, and was desired until now.
    pub failed: DeploymentId,
    /// The earlier deployment, which brought the package that runs.
    pub earlier: DeploymentId,
}

impl Assignments<&mut Transaction> {
    /// Settles a new deployment of `task` on the robots from `first_place` on that, as of their
    /// last reports, still run its package after a later one failed. Returns these robots: their
    /// desired state is new.
    pub async fn settle_still_running(
        &mut self,
        deployment: &DeploymentId,
        task: &TaskName,
        first_place: u64,
        now_ms: u64,
    ) -> Result<Vec<StillRunning>, StoreError> {
        let found = self.still_running(deployment, task, first_place).await?;
        if found.is_empty() {
            return Ok(found);
        }
        self.0.mark_auth_change();
        // Only one of a robot's deployments is desired at a time, so this comes first.
        let displace = "SET desired = 0, superseded_by = $2, updated_at_ms = $1";
        self.update_pairs(
            displace,
            deployment.as_str(),
            now_ms,
            found.iter().map(|one| (&one.failed, &one.robot)),
        )
        .await?;
        let timeline = appended_phase(Phase::Running, "$1");
        let restore = format!(
            "SET desired = 1, superseded_by = NULL, removed_generation = NULL, wanted = 'running', phase = $2, ended = 0,
                 progress = NULL, failure = NULL, expires_at_ms = NULL, updated_at_ms = $1, timeline = {timeline}"
        );
        let settle = format!(
            "SET released = 1, ended = 1, ran = 1, phase = $2, updated_at_ms = $1, timeline = {timeline}"
        );
        let running = Phase::Running.as_str();
        self.update_pairs(
            &restore,
            running,
            now_ms,
            found.iter().map(|one| (&one.earlier, &one.robot)),
        )
        .await?;
        self.update_pairs(
            &settle,
            running,
            now_ms,
            found.iter().map(|one| (deployment, &one.robot)),
        )
        .await?;
        let robots: Vec<RobotId> = found.iter().map(|one| one.robot.clone()).collect();
        self.0.robots().raise_generations(&robots).await?;
        Ok(found)
    }

    async fn still_running(
        &mut self,
        deployment: &DeploymentId,
        task: &TaskName,
        first_place: u64,
    ) -> Result<Vec<StillRunning>, StoreError> {
        // The same package has the same text.
        let rows = sqlx::query(
            "SELECT new.robot_id, has.deployment_id AS failed, earlier.deployment_id AS earlier, r.report
             FROM deployments ordered
             JOIN assignments new ON new.deployment_id = ordered.id AND new.released = 0 AND new.ended = 0
                 AND new.place >= $3
             JOIN assignments has ON has.robot_id = new.robot_id AND has.task = $2 AND has.desired = 1
             JOIN deployments present ON present.id = has.deployment_id
             JOIN assignments earlier ON earlier.robot_id = new.robot_id AND earlier.task = $2
             JOIN deployments brought ON brought.id = earlier.deployment_id
             JOIN robots r ON r.id = new.robot_id
             WHERE ordered.id = $1 AND ordered.kind = 'service' AND present.package <> ordered.package
               AND has.wanted = 'running' AND has.ended = 1
               AND earlier.ran = 1 AND earlier.desired = 0 AND brought.package = ordered.package
               AND r.report IS NOT NULL AND r.observed_generation <= r.generation",
        )
        .bind(deployment.as_str())
        .bind(task.as_str())
        .bind(stored(first_place))
        .fetch_all(self.0.connection())
        .await?;
        let mut found = Vec::new();
        for row in &rows {
            let one = StillRunning {
                robot: id("assignments.robot_id", row.try_get("robot_id")?)?,
                failed: id("assignments.deployment_id", row.try_get("failed")?)?,
                earlier: id("assignments.deployment_id", row.try_get("earlier")?)?,
            };
            let report: Report = from_json("robots.report", row.try_get("report")?)?;
            let runs = report.tasks.iter().any(|task_report| {
                let brought = task_report.active.as_ref().map(|active| &active.deployment);
                let is_over =
                    task_report.wanted == TargetState::Running && task_report.phase.is_final();
                task_report.task == *task
                    && task_report.deployment == one.failed
                    && is_over
                    && brought == Some(&one.earlier)
            });
            if runs {
                found.push(one);
            }
        }
        Ok(found)
    }
}
