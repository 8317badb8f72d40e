//! Assignments that end before they were done, because they were cancelled or expired. The
//! assignment that each had replaced becomes desired again. If a task has run and only its start or
//! restart was not carried out, nothing is replaced: the task is left as it is.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::desired::TargetState;
use task_proto::messages::report::{Failure, Phase, Report};
use task_proto::{DeploymentId, RobotId};

use crate::store::repositories::Assignments;
use crate::store::rows::{
    deployment_robot_pairs, from_optional_json, from_word, groups, id, json, number, stored,
    values, word,
};
use crate::store::timelines::appended_phase;
use crate::store::{StoreError, Transaction};

/// An assignment that is to be revoked.
#[derive(Debug, Clone)]
pub struct Revocable {
    pub deployment: DeploymentId,
    pub robot: RobotId,
    /// The place of the robot in the deployment.
    pub place: u64,
    /// The deployment that this one replaced, which becomes desired again.
    pub previous: Option<DeploymentId>,
    desired: bool,
    wanted: TargetState,
    retained: Option<RetainedTask>,
}

/// The final state of an assignment after which the robot keeps its task.
#[derive(Debug, Clone)]
struct RetainedTask {
    run: u64,
    wanted: TargetState,
    /// `None`: the phase in which the assignment ends.
    phase: Option<Phase>,
    failure: Option<Failure>,
    /// Whether the robot is told about the change. A diverged robot is left alone.
    needs_notice: bool,
}

/// Columns of a list of assignments in a statement.
const PAIR_COLUMNS: &[&str] = &["TEXT", "TEXT"];
/// Columns of [`RetainedTask`] in a statement.
const RETAINED_COLUMNS: &[&str] = &["TEXT", "TEXT", "BIGINT", "TEXT", "TEXT", "BIGINT", "TEXT"];
/// The columns that [`revocable`] reads. A robot's report is only read if the task has run there.
const COLUMNS: &str =
    "a.deployment_id, a.robot_id, a.place, a.desired, a.previous, a.wanted, a.run, a.ran, a.phase,
     CASE WHEN a.ran = 1 THEN r.report END AS report,
     CAST(CASE WHEN r.observed_generation > r.generation THEN 1 ELSE 0 END AS BIGINT) AS diverged";

impl Assignments<&mut Transaction> {
    /// The first assignments in these places that a cancel revokes, at most `most`: all unsettled
    /// ones, and those that ended without success but are still desired. A running service has
    /// settled: there is nothing left to interrupt.
    pub async fn revocable(
        &mut self,
        deployment: &DeploymentId,
        places: RangeInclusive<u64>,
        most: usize,
    ) -> Result<Vec<Revocable>, StoreError> {
        let rows = sqlx::query(AssertSqlSafe(format!(
            "SELECT {COLUMNS} FROM assignments a
             JOIN deployments d ON d.id = a.deployment_id JOIN robots r ON r.id = a.robot_id
             WHERE a.deployment_id = $1 AND NOT (a.phase = 'running' AND d.kind = 'service')
               AND (a.ended = 0 OR (a.desired = 1 AND a.phase NOT IN ('succeeded', 'stopped')))
               AND a.place BETWEEN $2 AND $3
             ORDER BY a.place LIMIT $4"
        )))
        .bind(deployment.as_str())
        .bind(stored(*places.start()))
        .bind(stored(*places.end()))
        .bind(stored(most as u64))
        .fetch_all(self.0.connection())
        .await?;
        // A task that is on its way to run, or runs, is interrupted. An order to run once more is
        // not undone.
        rows.iter().map(|row| revocable(row, |phase| phase == Phase::Assigned)).collect()
    }

    /// Whether the cancel of a later deployment would restore this one on a robot.
    pub async fn may_be_restored(&mut self, deployment: &DeploymentId) -> Result<bool, StoreError> {
        let count: i64 = sqlx::query_scalar(
            "SELECT COUNT(*) FROM assignments a JOIN deployments d ON d.id = a.deployment_id
             WHERE a.previous = $1 AND a.desired = 1 AND NOT (a.phase = 'running' AND d.kind = 'service')
               AND a.phase NOT IN ('succeeded', 'stopped')",
        )
        .bind(deployment.as_str())
        .fetch_one(self.0.connection())
        .await?;
        Ok(count > 0)
    }

    /// Assignments past their time limit, at most `most`.
    pub async fn overdue(
        &mut self,
        now_ms: u64,
        most: usize,
    ) -> Result<Vec<Revocable>, StoreError> {
        let rows = sqlx::query(AssertSqlSafe(format!(
            "SELECT {COLUMNS} FROM assignments a JOIN robots r ON r.id = a.robot_id
             WHERE a.ended = 0 AND a.expires_at_ms <= $1 LIMIT $2"
        )))
        .bind(stored(now_ms))
        .bind(stored(most as u64))
        .fetch_all(self.0.connection())
        .await?;
        rows.iter().map(|row| revocable(row, |_| true)).collect()
    }

    /// Revokes assignments: those that have not ended take the phase `phase`. Makes the assignments
    /// that they had replaced desired again. Returns the robots with a new desired state.
    pub async fn revert(
        &mut self,
        reverted: &[Revocable],
        phase: Phase,
        now_ms: u64,
    ) -> Result<Vec<RobotId>, StoreError> {
        let (retained, reverted): (Vec<&Revocable>, Vec<&Revocable>) =
            reverted.iter().partition(|row| row.retained.is_some());
        self.retain_tasks(&retained, phase, now_ms).await?;
        let end = format!(
            "SET desired = 0, ended = 1, progress = NULL, updated_at_ms = $1,
                 phase = CASE ended WHEN 1 THEN phase ELSE CAST($2 AS TEXT) END,
                 timeline = CASE ended WHEN 1 THEN timeline ELSE {} END",
            appended_phase(phase, "$1")
        );
        self.update_pairs(
            &end,
            phase.as_str(),
            now_ms,
            reverted.iter().map(|row| (&row.deployment, &row.robot)),
        )
        .await?;
        // A task that was stopped since stays stopped, whatever version of it comes back.
        for (wanted, stop) in
            [(TargetState::Running, ""), (TargetState::Stopped, "wanted = 'stopped', ")]
        {
            // The robot's next report gives the phase of the restored assignment; $2 is the phase
            // until then.
            let revive = format!(
                "SET {stop}desired = 1, superseded_by = NULL, removed_generation = NULL, updated_at_ms = $1,
                     ended = CASE phase WHEN 'superseded' THEN 0 ELSE ended END,
                     timeline = CASE phase WHEN 'superseded' THEN {} ELSE timeline END,
                     phase = CASE phase WHEN 'superseded' THEN CAST($2 AS TEXT) ELSE phase END",
                appended_phase(Phase::Assigned, "$1")
            );
            let replaced = reverted.iter().filter(|row| row.desired && row.wanted == wanted);
            let previous: Vec<_> =
                replaced.filter_map(|row| Some((row.previous.as_ref()?, &row.robot))).collect();
            self.update_pairs(&revive, Phase::Assigned.as_str(), now_ms, previous.iter().copied())
                .await?;
            self.skip_deleted_predecessors(&previous).await?;
        }
        let needs_notice = |row: &&Revocable| {
            row.retained.as_ref().map_or(row.desired, |retained| retained.needs_notice)
        };
        let robots: BTreeSet<RobotId> = retained
            .into_iter()
            .chain(reverted)
            .filter(needs_notice)
            .map(|row| row.robot.clone())
            .collect();
        let robots: Vec<RobotId> = robots.into_iter().collect();
        self.0.robots().raise_generations(&robots).await?;
        Ok(robots)
    }

    /// Ends the orders on tasks that stay on their robots. A run that a robot never reported may
    /// have begun there, so its number is not used again.
    async fn retain_tasks(
        &mut self,
        rows: &[&Revocable],
        phase: Phase,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let rows: Vec<_> =
            rows.iter().filter_map(|row| Some((*row, row.retained.as_ref()?))).collect();
        for group in groups(&rows) {
            let sql = format!(
                "WITH v (deployment_id, robot_id, run, wanted, phase, ended, failure) AS ({})
                 UPDATE assignments SET run = v.run,
                     last_run = CASE WHEN assignments.run > last_run THEN assignments.run ELSE last_run END, wanted = v.wanted, phase = v.phase, ended = v.ended,
                     failure = v.failure, progress = NULL, expires_at_ms = NULL, updated_at_ms = $1, timeline = {}
                 FROM v WHERE assignments.deployment_id = v.deployment_id AND assignments.robot_id = v.robot_id",
                values(2, group.len(), RETAINED_COLUMNS),
                appended_phase(phase, "$1")
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for (row, retained) in group {
                let phase = retained.phase.unwrap_or(phase);
                query = query
                    .bind(row.deployment.as_str())
                    .bind(row.robot.as_str())
                    .bind(stored(retained.run))
                    .bind(word(&retained.wanted))
                    .bind(phase.as_str())
                    .bind(i64::from(phase.is_final()))
                    .bind(retained.failure.as_ref().map(json));
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }

    /// Keeps later cancels from restoring the cancelled `deployment`. A deployment that replaced it
    /// now restores the predecessor of `deployment` instead.
    pub async fn skip_in_rollback_chain(
        &mut self,
        deployment: &DeploymentId,
    ) -> Result<(), StoreError> {
        let changed: Vec<(String, String)> = sqlx::query_as(
            "UPDATE assignments SET previous = (
                 SELECT skipped.previous FROM assignments skipped
                 WHERE skipped.deployment_id = $1 AND skipped.robot_id = assignments.robot_id)
             WHERE previous = $1
             RETURNING deployment_id, robot_id",
        )
        .bind(deployment.as_str())
        .fetch_all(self.0.connection())
        .await?;
        let changed = deployment_robot_pairs(changed)?;
        let changed: Vec<_> =
            changed.iter().map(|(deployment, robot)| (deployment, robot)).collect();
        self.skip_deleted_predecessors(&changed).await
    }

    /// Keeps these assignments from restoring a deleted package: they restore its own predecessor
    /// instead. A deleted package's bytes are kept while the package is desired, or while the
    /// cancel of a desired one would restore it. These assignments only become restorable now, so
    /// the bytes may be gone.
    async fn skip_deleted_predecessors(
        &mut self,
        pairs: &[(&DeploymentId, &RobotId)],
    ) -> Result<(), StoreError> {
        for group in groups(pairs) {
            // The same package has the same text.
            let sql = format!(
                "WITH v (deployment_id, robot_id) AS ({})
                 UPDATE assignments SET previous = (
                     SELECT gone.previous FROM assignments gone
                     WHERE gone.deployment_id = assignments.previous AND gone.robot_id = assignments.robot_id)
                 FROM v
                 WHERE assignments.deployment_id = v.deployment_id AND assignments.robot_id = v.robot_id
                   AND EXISTS (
                     SELECT 1 FROM deployments d WHERE d.id = assignments.previous AND NOT EXISTS (
                         SELECT 1 FROM packages p WHERE p.name = d.task AND p.package = d.package))",
                values(1, group.len(), PAIR_COLUMNS)
            );
            // The next predecessor may be deleted as well.
            let mut changed = 1;
            while changed > 0 {
                let mut query = sqlx::query(AssertSqlSafe(sql.as_str()));
                for (deployment, robot) in group {
                    query = query.bind(deployment.as_str()).bind(robot.as_str());
                }
                changed = query.execute(self.0.connection()).await?.rows_affected();
            }
        }
        Ok(())
    }

    /// Runs `UPDATE assignments` with `set` on the given rows. Its $1 is the time, and $2 is
    /// `word`.
    pub(super) async fn update_pairs<'a>(
        &mut self,
        set: &str,
        word: &str,
        now_ms: u64,
        pairs: impl Iterator<Item = (&'a DeploymentId, &'a RobotId)>,
    ) -> Result<(), StoreError> {
        let pairs: Vec<_> = pairs.collect();
        for group in groups(&pairs) {
            let sql = format!(
                "WITH v (deployment_id, robot_id) AS ({}) UPDATE assignments {set} FROM v
                 WHERE assignments.deployment_id = v.deployment_id AND assignments.robot_id = v.robot_id",
                values(3, group.len(), PAIR_COLUMNS)
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms)).bind(word);
            for (deployment, robot) in group {
                query = query.bind(deployment.as_str()).bind(robot.as_str());
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }
}

/// Reads [`COLUMNS`]. A task that has run stays as it is if its phase satisfies `is_retained`.
fn revocable(
    row: &sqlx::any::AnyRow,
    is_retained: impl Fn(Phase) -> bool,
) -> Result<Revocable, StoreError> {
    let deployment: DeploymentId = id("assignments.deployment_id", row.try_get("deployment_id")?)?;
    let previous: Option<String> = row.try_get("previous")?;
    let is = |column| row.try_get::<i64, _>(column).map(|value| value == 1);
    let (desired, wanted, run) = (
        is("desired")?,
        from_word("assignments.wanted", row.try_get("wanted")?)?,
        number(row.try_get("run")?),
    );
    let unchanged = RetainedTask { run, wanted, phase: None, failure: None, needs_notice: false };
    let retained = if is("diverged")? {
        Some(unchanged)
    } else if desired && is("ran")? && is_retained(Phase::from_text(row.try_get("phase")?)) {
        let report: Option<Report> = from_optional_json("robots.report", row.try_get("report")?)?;
        Some(as_reported(report, &deployment, unchanged))
    } else {
        None
    };
    Ok(Revocable {
        robot: id("assignments.robot_id", row.try_get("robot_id")?)?,
        place: number(row.try_get("place")?),
        previous: previous.map(|previous| id("assignments.previous", &previous)).transpose()?,
        deployment,
        desired,
        wanted,
        retained,
    })
}

/// A robot that never received the last order on its task keeps the state that it reported. A robot
/// that received the order, and did not carry it out in time, does not do so later.
fn as_reported(
    report: Option<Report>,
    deployment: &DeploymentId,
    ordered: RetainedTask,
) -> RetainedTask {
    let tasks = report.into_iter().flat_map(|report| report.tasks);
    match tasks.into_iter().find(|task| task.deployment == *deployment) {
        Some(task) if task.run < ordered.run => RetainedTask {
            run: task.run,
            wanted: task.wanted,
            phase: Some(task.phase),
            failure: task.failure,
            needs_notice: true,
        },
        _ => RetainedTask { wanted: TargetState::Stopped, needs_notice: true, ..ordered },
    }
}
