//! Reports: reads the known state of a batch of robots at once, and writes their reports at once.
//!
//! On Postgres, several servers write reports at the same time, while no order is written. A
//! statement of a [`ReportTransaction`] therefore may change only the rows of the robots that the
//! transaction holds, and may rely on these rows and on all that only orders change.

use std::collections::BTreeSet;

use futures_util::TryStreamExt as _;
use serde::Deserialize;
use sqlx::any::AnyRow;
use sqlx::{AssertSqlSafe, Row as _};
use task_proto::ids::Labels;
use task_proto::messages::report::{Phase, Report};
use task_proto::packages::manifest::TaskKind;
use task_proto::{DeploymentId, Digest, Generation, InstanceId, RobotId, RobotName};

use crate::domain::deployment::AssignmentState;
use crate::store::repositories::Reports;
use crate::store::rows::{
    from_json, from_optional_json, from_word, groups, id, json, number, stored, values,
};
use crate::store::timelines::{appended_step, step};
use crate::store::{Store, StoreError, Transaction};

/// Columns of an assignment's state in a statement.
const STATE_COLUMNS: &[&str] =
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
    pub state: AssignmentState,
}

/// The agent that wrote a stored report.
#[derive(Debug, Deserialize)]
pub struct ReportingAgent {
    /// The agent's instance id, which identifies its start.
    pub instance: InstanceId,
    /// A digest of the place where the agent ran, if reported.
    #[serde(default)]
    pub place: Option<Digest>,
}

impl Reports<&Store> {
    /// The generations of `robots`.
    pub async fn generations(
        self,
        robots: &[&RobotId],
    ) -> Result<Vec<(RobotId, Generation)>, StoreError> {
        let mut found = Vec::with_capacity(robots.len());
        for group in groups(robots) {
            let sql = format!(
                "SELECT id, generation FROM robots WHERE id IN ({})",
                values(1, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query_as::<_, (String, i64)>(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for (robot, generation) in query.fetch_all(&self.0.reads).await? {
                found.push((id("robots.id", &robot)?, Generation(number(generation))));
            }
        }
        Ok(found)
    }

    /// The agent of each robot's last report. Unreadable reports are left out.
    pub async fn last_agents(self) -> Result<Vec<(RobotId, ReportingAgent)>, StoreError> {
        let sql =
            "SELECT id, report FROM robots WHERE report IS NOT NULL AND removed_at_ms IS NULL";
        let mut rows = sqlx::query(sql).fetch(&self.0.reads);
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

/// A write of robots' reports in progress. It holds these robots' rows: no other write of reports
/// is about any of them before this one has ended.
pub struct ReportTransaction {
    write: Transaction,
    robots: Vec<ReportedRobot>,
}

impl ReportTransaction {
    /// Takes the rows of `robots`, with a query that ends with `lock`.
    pub(in crate::store) async fn lock(
        mut write: Transaction,
        robots: &BTreeSet<&RobotId>,
        lock: &str,
    ) -> Result<Self, StoreError> {
        let ordered: Vec<&RobotId> = robots.iter().copied().collect();
        let mut robots = Vec::with_capacity(ordered.len());
        for group in groups(&ordered) {
            let sql = format!(
                "WITH v (id) AS ({})
                 SELECT r.id, r.name, r.labels, r.generation, r.report_start, r.report_seq,
                     r.token_number
                 FROM v JOIN robots r ON r.id = v.id WHERE r.removed_at_ms IS NULL {lock}",
                values(1, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for row in query.fetch_all(write.connection()).await? {
                robots.push(reported_robot(&row)?);
            }
        }
        Ok(Self { write, robots })
    }

    /// The number of the last order; while it stays the same, reports alone have changed anything.
    pub fn last_order(&self) -> u64 {
        self.write.sequence()
    }

    /// The registered ones of the robots of this write, as they stood when it began.
    pub fn robots(&self) -> &[ReportedRobot] {
        &self.robots
    }

    /// The statements of this write.
    pub fn reports(&mut self) -> Reports<&mut Transaction> {
        self.write.reports()
    }

    /// Commits the write. The commit runs to its end even if the caller does not wait for it.
    pub async fn commit(self) -> Result<(), StoreError> {
        self.write.commit().await
    }
}

impl Reports<&mut Transaction> {
    /// The released assignments of `robots` that have not ended.
    pub async fn open_assignments(
        &mut self,
        robots: &[RobotId],
    ) -> Result<Vec<OpenAssignment>, StoreError> {
        let sql = "SELECT a.deployment_id, a.robot_id, d.kind, a.run, a.phase, a.progress,
                 a.failure, a.attempts, a.removed_generation
             FROM v JOIN assignments a ON a.robot_id = v.id
                 JOIN deployments d ON d.id = a.deployment_id
             WHERE a.ended = 0 AND a.released = 1";
        self.rows_of(robots, sql).await?.iter().map(open_assignment).collect()
    }

    /// The rows that `sql` selects for `robots`, whose ids it finds in a table `v`.
    async fn rows_of(
        &mut self,
        robots: &[RobotId],
        sql: &'static str,
    ) -> Result<Vec<AnyRow>, StoreError> {
        let mut rows = Vec::with_capacity(robots.len());
        for group in groups(robots) {
            let ids = values(1, group.len(), &["TEXT"]);
            let mut query = sqlx::query(AssertSqlSafe(format!("WITH v (id) AS ({ids}) {sql}")));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            rows.extend(query.fetch_all(self.0.connection()).await?);
        }
        Ok(rows)
    }

    /// Those of `deployments` that may begin another batch: robots wait for theirs, and the rollout
    /// is neither paused nor cancelled. No report changes which ones these are.
    pub async fn waiting(
        &mut self,
        deployments: &[DeploymentId],
    ) -> Result<BTreeSet<DeploymentId>, StoreError> {
        let mut found = BTreeSet::new();
        for group in groups(deployments) {
            let sql = format!(
                "WITH v (id) AS ({})
                 SELECT d.id FROM v JOIN deployments d ON d.id = v.id
                 WHERE d.paused = 0 AND d.cancelled_at_ms IS NULL AND EXISTS (
                     SELECT 1 FROM assignments a WHERE a.deployment_id = d.id AND a.released = 0 AND a.ended = 0)",
                values(1, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query_scalar(AssertSqlSafe(sql));
            for deployment in group {
                query = query.bind(deployment.as_str());
            }
            let rows: Vec<String> = query.fetch_all(self.0.connection()).await?;
            for row in rows {
                found.insert(id("deployments.id", &row)?);
            }
        }
        Ok(found)
    }

    /// Stores reports, at most one of each robot.
    pub async fn store(&mut self, reports: &[&Report], now_ms: u64) -> Result<(), StoreError> {
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
            query.execute(self.0.connection()).await?;
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
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }

    /// Stores the new phases of assignments, and records phase changes and retries in their
    /// timelines. An assignment that has run or ended no longer expires.
    pub async fn store_assignment_states(
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
                values(2, group.len(), STATE_COLUMNS),
                appended_step("v.step")
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for OpenAssignment { deployment, robot, state, .. } in group {
                let ended = state.phase.is_final();
                query = query
                    .bind(deployment.as_str())
                    .bind(robot.as_str())
                    .bind(state.phase.as_str())
                    .bind(i64::from(ended))
                    .bind(state.progress.as_ref().map(json))
                    .bind(state.failure.as_ref().map(json))
                    .bind(i64::from(state.attempts))
                    .bind(i64::from(ended || state.phase == Phase::Running))
                    .bind(step(state.phase, now_ms, state.attempts));
            }
            query.execute(self.0.connection()).await?;
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
            for OpenAssignment { deployment, robot, state, .. } in group {
                query = query
                    .bind(deployment.as_str())
                    .bind(robot.as_str())
                    .bind(state.progress.as_ref().map(json))
                    .bind(state.failure.as_ref().map(json))
                    .bind(i64::from(state.attempts));
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }
}

fn reported_robot(row: &AnyRow) -> Result<ReportedRobot, StoreError> {
    Ok(ReportedRobot {
        id: id("robots.id", row.try_get("id")?)?,
        name: id("robots.name", row.try_get("name")?)?,
        labels: from_json("robots.labels", row.try_get("labels")?)?,
        generation: Generation(number(row.try_get("generation")?)),
        last_report: (number(row.try_get("report_start")?), number(row.try_get("report_seq")?)),
        token_number: number(row.try_get("token_number")?),
    })
}

fn open_assignment(row: &AnyRow) -> Result<OpenAssignment, StoreError> {
    Ok(OpenAssignment {
        deployment: id("assignments.deployment_id", row.try_get("deployment_id")?)?,
        robot: id("assignments.robot_id", row.try_get("robot_id")?)?,
        kind: from_word("deployments.kind", row.try_get("kind")?)?,
        removed: row
            .try_get::<Option<i64>, _>("removed_generation")?
            .map(|stored| Generation(number(stored))),
        state: AssignmentState {
            run: number(row.try_get("run")?),
            phase: Phase::from_text(row.try_get("phase")?),
            progress: from_optional_json("assignments.progress", row.try_get("progress")?)?,
            failure: from_optional_json("assignments.failure", row.try_get("failure")?)?,
            attempts: u32::try_from(row.try_get::<i64, _>("attempts")?).unwrap_or(u32::MAX),
        },
    })
}
