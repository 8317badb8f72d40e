//! Reports: reads the known state of a batch of robots at once, and writes their reports at once.

use futures_util::TryStreamExt as _;
use serde::Deserialize;
use sqlx::{AssertSqlSafe, Row as _};
use task_proto::id::Labels;
use task_proto::manifest::TaskKind;
use task_proto::report::{Phase, Report};
use task_proto::{DeploymentId, Digest, Generation, InstanceId, RobotId, RobotName};

use crate::domain::deployment::Standing;
use crate::store::rows::{
    from_json, from_optional_json, from_word, groups, id, json, number, stored, values,
};
use crate::store::timelines::{grown, step};
use crate::store::{Store, StoreError, Write};

/// Columns of an assignment's state in a statement.
const STANDING: &[&str] =
    &["TEXT", "TEXT", "TEXT", "BIGINT", "TEXT", "TEXT", "BIGINT", "BIGINT", "TEXT"];
/// The highest generation that we accept from a robot. A made-up one beyond this would leave no
/// room above it.
const MAX_GENERATION: Generation = Generation(1 << 53);

/// The stored state of a robot that has reported.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReportedRobot {
    pub id: RobotId,
    /// The robot's name on the server.
    pub name: RobotName,
    /// The robot's labels on the server.
    pub labels: Labels,
    /// The generation of the robot's desired state.
    pub generation: Generation,
    /// Start and number of the robot's last report.
    pub last_report: (u64, u64),
    /// The number of the token in use.
    pub token_number: u64,
}

/// A released assignment that has not ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OpenAssignment {
    pub deployment: DeploymentId,
    pub robot: RobotId,
    /// Whether the task is a service or a job.
    pub kind: TaskKind,
    /// The generation in which the assignment left the desired state.
    pub removed: Option<Generation>,
    /// The progress of the assignment.
    pub standing: Standing,
}

/// The agent that wrote a stored report.
#[derive(Debug, Deserialize)]
pub struct ReportedBy {
    /// The agent's instance id, which identifies its start.
    pub instance: InstanceId,
    /// A digest of the place where the agent ran, if reported.
    #[serde(default)]
    pub place: Option<Digest>,
}

impl Store {
    /// The agent of each robot's last report. Unreadable reports are left out.
    pub async fn last_agents(&self) -> Result<Vec<(RobotId, ReportedBy)>, StoreError> {
        let sql =
            "SELECT id, report FROM robots WHERE report IS NOT NULL AND removed_at_ms IS NULL";
        let mut rows = sqlx::query(sql).fetch(&self.reads);
        let mut found = Vec::new();
        // A report may be large, and each robot has one.
        while let Some(row) = rows.try_next().await? {
            if let Ok(by) = from_json("robots.report", row.try_get("report")?) {
                found.push((id("robots.id", row.try_get("id")?)?, by));
            }
        }
        Ok(found)
    }
}

impl Write {
    /// Those of `robots` that are registered.
    pub async fn reported_robots(
        &mut self,
        robots: &[RobotId],
    ) -> Result<Vec<ReportedRobot>, StoreError> {
        let mut found = Vec::with_capacity(robots.len());
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id) AS ({})
                 SELECT r.id, r.name, r.labels, r.generation, r.report_start, r.report_seq,
                     r.token_number
                 FROM v JOIN robots r ON r.id = v.id WHERE r.removed_at_ms IS NULL",
                values(1, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for row in query.fetch_all(self.connection()).await? {
                found.push(ReportedRobot {
                    id: id("robots.id", row.try_get("id")?)?,
                    name: id("robots.name", row.try_get("name")?)?,
                    labels: from_json("robots.labels", row.try_get("labels")?)?,
                    generation: Generation(number(row.try_get("generation")?)),
                    last_report: (
                        number(row.try_get("report_start")?),
                        number(row.try_get("report_seq")?),
                    ),
                    token_number: number(row.try_get("token_number")?),
                });
            }
        }
        Ok(found)
    }

    /// The released assignments of `robots` that have not ended.
    pub async fn open_assignments(
        &mut self,
        robots: &[RobotId],
    ) -> Result<Vec<OpenAssignment>, StoreError> {
        let mut found = Vec::with_capacity(robots.len());
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id) AS ({})
                 SELECT a.deployment_id, a.robot_id, d.kind, a.run, a.phase, a.progress, a.failure, a.attempts,
                     a.removed_generation
                 FROM v JOIN assignments a ON a.robot_id = v.id JOIN deployments d ON d.id = a.deployment_id
                 WHERE a.ended = 0 AND a.released = 1",
                values(1, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for row in query.fetch_all(self.connection()).await? {
                found.push(open_assignment(&row)?);
            }
        }
        Ok(found)
    }

    /// Stores reports, at most one of each robot.
    pub async fn store_reports(
        &mut self,
        reports: &[&Report],
        now_ms: u64,
    ) -> Result<(), StoreError> {
        for group in groups(reports) {
            let sql = format!(
                "WITH v (id, start, seq, observed, report, link, battery) AS ({})
                 UPDATE robots SET report_start = v.start, report_seq = v.seq, observed_generation = v.observed,
                     report = v.report, link = COALESCE(v.link, robots.link), battery = v.battery, last_seen_ms = $1
                 FROM v WHERE robots.id = v.id",
                values(2, group.len(), &["TEXT", "BIGINT", "BIGINT", "BIGINT", "TEXT", "TEXT", "BIGINT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for report in group {
                query = query
                    .bind(report.robot_id.as_str())
                    .bind(stored(report.start))
                    .bind(stored(report.seq))
                    .bind(stored(report.reached_generation().min(MAX_GENERATION).0))
                    .bind(json(report))
                    .bind(report.link.as_ref().map(json))
                    .bind(report.host.battery_percent.map(|percent| i64::from(percent.min(100))));
            }
            query.execute(self.connection()).await?;
        }
        Ok(())
    }

    /// Stores only the numbers of reports without news. The stored reports stay, with the times and
    /// the progress of when they were written.
    pub async fn store_repeated(
        &mut self,
        reports: &[&Report],
        now_ms: u64,
    ) -> Result<(), StoreError> {
        for group in groups(reports) {
            let sql = format!(
                "WITH v (id, start, seq, observed) AS ({})
                 UPDATE robots SET report_start = v.start, report_seq = v.seq, observed_generation = v.observed,
                     last_seen_ms = $1
                 FROM v WHERE robots.id = v.id",
                values(2, group.len(), &["TEXT", "BIGINT", "BIGINT", "BIGINT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for report in group {
                query = query
                    .bind(report.robot_id.as_str())
                    .bind(stored(report.start))
                    .bind(stored(report.seq))
                    .bind(stored(report.reached_generation().min(MAX_GENERATION).0));
            }
            query.execute(self.connection()).await?;
        }
        Ok(())
    }

    /// Stores the new phases of assignments, and records phase changes and retries in their
    /// timelines. An assignment that has run or ended no longer expires.
    pub async fn store_standings(
        &mut self,
        assignments: &[OpenAssignment],
        now_ms: u64,
    ) -> Result<(), StoreError> {
        for group in groups(assignments) {
            let sql = format!(
                "WITH v (deployment_id, robot_id, phase, ended, progress, failure, attempts, reached, step) AS ({})
                 UPDATE assignments SET phase = v.phase, ended = v.ended, progress = v.progress, failure = v.failure,
                     attempts = v.attempts, updated_at_ms = $1, timeline = {},
                     expires_at_ms = CASE v.reached WHEN 1 THEN NULL ELSE expires_at_ms END,
                     ran = CASE WHEN v.phase IN ('running', 'succeeded') THEN 1 ELSE ran END
                 FROM v WHERE assignments.deployment_id = v.deployment_id AND assignments.robot_id = v.robot_id",
                values(2, group.len(), STANDING),
                grown("v.step")
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for OpenAssignment { deployment, robot, standing, .. } in group {
                let ended = standing.phase.is_final();
                query = query
                    .bind(deployment.as_str())
                    .bind(robot.as_str())
                    .bind(standing.phase.as_str())
                    .bind(i64::from(ended))
                    .bind(standing.progress.as_ref().map(json))
                    .bind(standing.failure.as_ref().map(json))
                    .bind(i64::from(standing.attempts))
                    .bind(i64::from(ended || standing.phase == Phase::Running))
                    .bind(step(standing.phase, now_ms, standing.attempts));
            }
            query.execute(self.connection()).await?;
        }
        Ok(())
    }

    /// Stores the progress of assignments in an unchanged phase: writes only columns without an
    /// index.
    pub async fn store_progress(
        &mut self,
        assignments: &[OpenAssignment],
        now_ms: u64,
    ) -> Result<(), StoreError> {
        for group in groups(assignments) {
            let sql = format!(
                "WITH v (deployment_id, robot_id, progress, failure, attempts) AS ({})
                 UPDATE assignments SET progress = v.progress, failure = v.failure, attempts = v.attempts,
                     updated_at_ms = $1
                 FROM v WHERE assignments.deployment_id = v.deployment_id AND assignments.robot_id = v.robot_id",
                values(2, group.len(), &["TEXT", "TEXT", "TEXT", "TEXT", "BIGINT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for OpenAssignment { deployment, robot, standing, .. } in group {
                query = query
                    .bind(deployment.as_str())
                    .bind(robot.as_str())
                    .bind(standing.progress.as_ref().map(json))
                    .bind(standing.failure.as_ref().map(json))
                    .bind(i64::from(standing.attempts));
            }
            query.execute(self.connection()).await?;
        }
        Ok(())
    }
}

fn open_assignment(row: &sqlx::any::AnyRow) -> Result<OpenAssignment, StoreError> {
    Ok(OpenAssignment {
        deployment: id("assignments.deployment_id", row.try_get("deployment_id")?)?,
        robot: id("assignments.robot_id", row.try_get("robot_id")?)?,
        kind: from_word("deployments.kind", row.try_get("kind")?)?,
        removed: row
            .try_get::<Option<i64>, _>("removed_generation")?
            .map(|stored| Generation(number(stored))),
        standing: Standing {
            run: number(row.try_get("run")?),
            phase: Phase::from_text(row.try_get("phase")?),
            progress: from_optional_json("assignments.progress", row.try_get("progress")?)?,
            failure: from_optional_json("assignments.failure", row.try_get("failure")?)?,
            attempts: u32::try_from(row.try_get::<i64, _>("attempts")?).unwrap_or(u32::MAX),
        },
    })
}
