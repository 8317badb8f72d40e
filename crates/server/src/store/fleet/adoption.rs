//! Diverged robots: after the database was restored from an older copy, a robot reports a
//! generation that the database does not know. Before the next order for such a robot is applied,
//! its reported tasks become its desired state.

use std::collections::{BTreeMap, HashSet};

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::messages::report::{Phase, Report, TaskReport};
use task_proto::packages::manifest::TaskKind;
use task_proto::{Generation, RobotId, TaskName};

use crate::store::repositories::Robots;
use crate::store::rows::{from_json, id, json, number, stored, word};
use crate::store::timelines::{appended_phase, appended_step, step};
use crate::store::{StoreError, Transaction};

/// The highest run that is adopted. A made-up one beyond this would leave no room above it, and an
/// order for this robot and others would fail for all of them.
const MAX_RUN: u64 = 1 << 53;

impl Robots<&mut Transaction> {
    /// Whether there are diverged robots. Mostly there are none.
    pub async fn are_any_diverged(&mut self) -> Result<bool, StoreError> {
        let sql = "SELECT id FROM robots
             WHERE observed_generation > generation AND removed_at_ms IS NULL AND report IS NOT NULL LIMIT 1";
        let found: Option<String> =
            sqlx::query_scalar(sql).fetch_optional(self.0.connection()).await?;
        Ok(found.is_some())
    }

    /// Adopts those of `robots` that are diverged.
    pub async fn adopt_diverged(
        &mut self,
        robots: &[RobotId],
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let rows = sqlx::query(
            "SELECT id, observed_generation, report FROM robots
             WHERE observed_generation > generation AND removed_at_ms IS NULL AND report IS NOT NULL",
        )
        .fetch_all(self.0.connection())
        .await?;
        if rows.is_empty() {
            return Ok(());
        }
        let wanted: HashSet<&RobotId> = robots.iter().collect();
        for row in rows {
            let robot: RobotId = id("robots.id", row.try_get("id")?)?;
            if wanted.contains(&robot) {
                let report: Report = from_json("robots.report", row.try_get("report")?)?;
                let observed = Generation(number(row.try_get("observed_generation")?));
                self.adopt(&robot, &report, observed, now_ms).await?;
            }
        }
        Ok(())
    }

    async fn adopt(
        &mut self,
        robot: &RobotId,
        report: &Report,
        observed: Generation,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        // The stored desired state is out of date as a whole. Tasks that the robot also reports
        // come back below.
        sqlx::query(AssertSqlSafe(format!(
            "UPDATE assignments SET desired = 0, ended = 1, progress = NULL, updated_at_ms = $2,
                 phase = CASE ended WHEN 1 THEN phase ELSE 'stopped' END,
                 timeline = CASE ended WHEN 1 THEN timeline ELSE {} END
             WHERE robot_id = $1 AND desired = 1",
            appended_phase(Phase::Stopped, "$2")
        )))
        .bind(robot.as_str())
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        // A robot could list a task twice. The database would refuse that, and the whole order with
        // it.
        let tasks: BTreeMap<&TaskName, &TaskReport> =
            report.tasks.iter().map(|task| (&task.task, task)).collect();
        for task in tasks.into_values() {
            self.adopt_task(robot, task, now_ms).await?;
        }
        sqlx::query("UPDATE robots SET generation = $2 WHERE id = $1")
            .bind(robot.as_str())
            .bind(stored(observed.0))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    async fn adopt_task(
        &mut self,
        robot: &RobotId,
        task: &TaskReport,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        // The number is older than the orders of this write, so that the task can be rolled back to
        // this deployment.
        let number = stored(self.0.sequence().saturating_sub(1));
        // The order itself may be lost as well. Then the robot's report is its only record.
        sqlx::query(
            "INSERT INTO deployments (id, number, task, version, package, kind, selector, delivery, created_at_ms,
                 expires_at_ms)
             VALUES ($1, $2, $3, $4, $5, $6, $7, 'push-pull', $8, $8) ON CONFLICT (id) DO NOTHING",
        )
        .bind(task.deployment.as_str())
        .bind(number)
        .bind(task.task.as_str())
        .bind(task.package.version.as_str())
        .bind(json(&task.package))
        .bind(word(&task.kind.unwrap_or(TaskKind::Service)))
        .bind(robot.as_str())
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        sqlx::query(AssertSqlSafe(format!(
            "INSERT INTO assignments (deployment_id, robot_id, task, place, released, desired, ended, wanted, run, phase,
                 failure, updated_at_ms, timeline, ran)
             SELECT id, CAST($2 AS TEXT), task, 0, 1, 1, CAST($4 AS BIGINT), CAST($5 AS TEXT), CAST($6 AS BIGINT),
                 CAST($7 AS TEXT), CAST($8 AS TEXT), CAST($9 AS BIGINT), CAST($10 AS TEXT),
                 CASE WHEN CAST($7 AS TEXT) IN ('running', 'succeeded') THEN 1 ELSE 0 END
             FROM deployments WHERE id = $1 AND task = $3
             ON CONFLICT (deployment_id, robot_id) DO UPDATE SET released = 1, desired = 1, ended = excluded.ended,
                 wanted = excluded.wanted, run = excluded.run, phase = excluded.phase, failure = excluded.failure,
                 superseded_by = NULL, removed_generation = NULL, updated_at_ms = excluded.updated_at_ms,
                 ran = CASE excluded.ran WHEN 1 THEN 1 ELSE assignments.ran END, timeline = {}",
            appended_step("excluded.timeline")
        )))
        .bind(task.deployment.as_str())
        .bind(robot.as_str())
        .bind(task.task.as_str())
        .bind(i64::from(task.phase.is_final()))
        .bind(word(&task.wanted))
        .bind(stored(task.run.min(MAX_RUN)))
        .bind(task.phase.as_str())
        .bind(task.failure.as_ref().map(json))
        .bind(stored(now_ms))
        .bind(step(task.phase, now_ms, task.attempts))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }
}
