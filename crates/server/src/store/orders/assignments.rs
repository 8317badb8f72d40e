//! Assignments: each deployment's part for each robot, and which of them is desired. Every change
//! is a few statements over sets of rows, whatever the number of robots. A write that changes a
//! robot's desired state also raises the robot's generation.

use std::collections::BTreeSet;

use sqlx::AssertSqlSafe;
use task_proto::messages::report::Phase;
use task_proto::{DeploymentId, RobotId, TaskName};

use crate::store::repositories::Assignments;
use crate::store::rows::{deployment_robot_pairs, groups, id, json, stored, values};
use crate::store::timelines::{appended_phase, step};
use crate::store::{OrderChunk, StoreError, Transaction};

/// An order on a task that a robot has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TaskOrder {
    /// Run the task, if it does not run.
    Start,
    /// Run the task anew.
    Restart,
    /// Stop the task and keep it installed.
    Stop,
    /// Remove the task from the robot.
    Remove,
}

/// The outcome of beginning a batch.
#[derive(Debug, Default)]
pub struct ReleasedBatch {
    /// The robots with a new desired state.
    pub robots: Vec<RobotId>,
    /// The deployments that were replaced on some of these robots.
    pub superseded: BTreeSet<DeploymentId>,
}

impl Assignments<&mut Transaction> {
    /// Gives each of `robots` that is still registered its part of a deployment, in this order,
    /// from `first_place` on. Nothing is released yet.
    pub async fn insert(
        &mut self,
        deployment: &DeploymentId,
        task: &TaskName,
        robots: &[RobotId],
        first_place: u64,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let mut place = stored(first_place);
        for group in groups(robots) {
            let sql = format!(
                "WITH v (robot_id, place) AS ({})
                 INSERT INTO assignments (deployment_id, robot_id, task, place, updated_at_ms, timeline)
                 SELECT CAST($1 AS TEXT), v.robot_id, CAST($2 AS TEXT), v.place, CAST($3 AS BIGINT), CAST($4 AS TEXT)
                 FROM v JOIN robots r ON r.id = v.robot_id WHERE r.removed_at_ms IS NULL",
                values(5, group.len(), &["TEXT", "BIGINT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql))
                .bind(deployment.as_str())
                .bind(task.as_str())
                .bind(stored(now_ms))
                .bind(step(Phase::Assigned, now_ms, 0));
            for robot in group {
                query = query.bind(robot.as_str()).bind(place);
                place += 1;
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }

    /// Ends older parts of the task that wait for their batch, on the robots that wait in
    /// `deployment` from `first_place` on. Returns the deployments of these parts.
    pub async fn supersede_waiting(
        &mut self,
        deployment: &DeploymentId,
        task: &TaskName,
        first_place: u64,
        now_ms: u64,
    ) -> Result<BTreeSet<DeploymentId>, StoreError> {
        let superseded = sqlx::query_scalar(AssertSqlSafe(format!(
            "UPDATE assignments SET phase = 'superseded', ended = 1, superseded_by = $1, updated_at_ms = $3,
                 timeline = {}
             WHERE task = $2 AND released = 0 AND ended = 0 AND deployment_id <> $1
               AND robot_id IN (SELECT robot_id FROM assignments
                   WHERE deployment_id = $1 AND released = 0 AND ended = 0 AND place >= $4)
             RETURNING deployment_id",
            appended_phase(Phase::Superseded, "$3")
        )))
        .bind(deployment.as_str())
        .bind(task.as_str())
        .bind(stored(now_ms))
        .bind(stored(first_place))
        .fetch_all(self.0.connection())
        .await?;
        deployments(superseded)
    }

    /// Takes a deployment's parts away from `robots`, which were just placed from `first_place` on,
    /// as [`Self::drop_waiting`] does.
    pub async fn drop_from(
        &mut self,
        deployment: &DeploymentId,
        first_place: u64,
        robots: &[RobotId],
        now_ms: u64,
    ) -> Result<(), StoreError> {
        if robots.is_empty() {
            return Ok(());
        }
        let sql = format!(
            "UPDATE assignments SET phase = 'cancelled', ended = 1, wanted = 'stopped', updated_at_ms = $2,
                 timeline = {}
             WHERE deployment_id = $1 AND released = 0 AND ended = 0 AND place >= $3 AND robot_id IN ({})",
            appended_phase(Phase::Cancelled, "$2"),
            self.0.dialect.texts(4)
        );
        sqlx::query(AssertSqlSafe(sql))
            .bind(deployment.as_str())
            .bind(stored(now_ms))
            .bind(stored(first_place))
            .bind(json(&robots))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    /// Ends parts of a chunk that was just placed, on robots that have received a newer order for
    /// the task since: as a part that waits for its batch, they would have ended with that order.
    pub async fn yield_to_newer(
        &mut self,
        chunk: &OrderChunk,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let newer: Option<String> = sqlx::query_scalar(
            "SELECT id FROM deployments WHERE number > $1 AND task = $2 LIMIT 1",
        )
        .bind(stored(chunk.number))
        .bind(chunk.task.as_str())
        .fetch_optional(self.0.connection())
        .await?;
        if newer.is_none() {
            return Ok(());
        }
        let newer = "FROM assignments newer JOIN deployments d ON d.id = newer.deployment_id
             WHERE newer.robot_id = assignments.robot_id AND newer.task = assignments.task AND d.number > $4";
        let sql = format!(
            "UPDATE assignments SET phase = 'superseded', ended = 1, updated_at_ms = $2, timeline = {},
                 superseded_by = (SELECT d.id {newer} ORDER BY d.number LIMIT 1)
             WHERE deployment_id = $1 AND released = 0 AND ended = 0 AND place >= $3
               AND EXISTS (SELECT 1 {newer})",
            appended_phase(Phase::Superseded, "$2")
        );
        sqlx::query(AssertSqlSafe(sql))
            .bind(chunk.deployment.as_str())
            .bind(stored(now_ms))
            .bind(stored(chunk.first_place))
            .bind(stored(chunk.number))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    /// Settles a new deployment on the robots from `first_place` on that run its package already,
    /// as of their last report: nothing begins there. Their desired state stays the earlier
    /// deployment, so that they receive nothing new.
    pub async fn settle_running(
        &mut self,
        deployment: &DeploymentId,
        first_place: u64,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        // The same package has the same text.
        sqlx::query(AssertSqlSafe(format!(
            "UPDATE assignments SET released = 1, ended = 1, ran = 1, phase = 'running', updated_at_ms = $2, timeline = {}
             WHERE deployment_id = $1 AND released = 0 AND ended = 0 AND place >= $3 AND EXISTS (
                 SELECT 1 FROM deployments ordered
                 JOIN assignments has ON has.task = ordered.task AND has.desired = 1
                 JOIN deployments present ON present.id = has.deployment_id
                 JOIN robots r ON r.id = has.robot_id
                 WHERE ordered.id = $1 AND has.robot_id = assignments.robot_id
                   AND ordered.kind = 'service' AND present.package = ordered.package
                   AND has.wanted = 'running' AND has.phase = 'running'
                   AND r.observed_generation <= r.generation)",
            appended_phase(Phase::Running, "$2")
        )))
        .bind(deployment.as_str())
        .bind(stored(now_ms))
        .bind(stored(first_place))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Moves waiting robots behind all others, and keeps their order.
    pub async fn postpone(
        &mut self,
        deployment: &DeploymentId,
        robots: &[&RobotId],
    ) -> Result<(), StoreError> {
        // Robots that have no assignment yet have their places as well.
        let (last, selected): (Option<i64>, Option<i64>) = sqlx::query_as(
            "SELECT (SELECT MAX(place) FROM assignments WHERE deployment_id = $1), selected
             FROM deployments WHERE id = $1",
        )
        .bind(deployment.as_str())
        .fetch_one(self.0.connection())
        .await?;
        let last = last.max(selected).unwrap_or(0);
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id) AS ({}) UPDATE assignments SET place = place + $2 FROM v
                 WHERE deployment_id = $1 AND robot_id = v.id AND released = 0 AND ended = 0",
                values(3, group.len(), &["TEXT"])
            );
            let mut query =
                sqlx::query(AssertSqlSafe(sql)).bind(deployment.as_str()).bind(last + 1);
            for robot in group {
                query = query.bind(robot.as_str());
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }

    /// Starts the expiry of all robots that wait for their batch, unless it has started: the
    /// deployment waits for no other robots. Returns whether there were any.
    pub async fn await_offline(
        &mut self,
        deployment: &DeploymentId,
        now_ms: u64,
    ) -> Result<bool, StoreError> {
        let begun = sqlx::query(
            "UPDATE assignments SET expires_at_ms =
                 CAST($2 AS BIGINT) + (SELECT expires_at_ms - created_at_ms FROM deployments WHERE id = $1)
             WHERE deployment_id = $1 AND released = 0 AND ended = 0 AND expires_at_ms IS NULL",
        )
        .bind(deployment.as_str())
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        Ok(begun.rows_affected() > 0)
    }

    /// Begins the next batch of at most `count` robots, and replaces their present assignment of
    /// the task. Their time begins now.
    pub async fn release(
        &mut self,
        deployment: &DeploymentId,
        count: u64,
        now_ms: u64,
    ) -> Result<ReleasedBatch, StoreError> {
        let batch: Vec<(String, i64)> = sqlx::query_as(
            "SELECT robot_id, place FROM assignments WHERE deployment_id = $1 AND released = 0 AND ended = 0
             ORDER BY place LIMIT $2",
        )
        .bind(deployment.as_str())
        .bind(stored(count))
        .fetch_all(self.0.connection())
        .await?;
        let Some(&(_, last)) = batch.last() else { return Ok(ReleasedBatch::default()) };
        self.0.mark_auth_change();
        let robots = batch
            .iter()
            .map(|(robot, _)| id("assignments.robot_id", robot))
            .collect::<Result<Vec<_>, _>>()?;
        self.0.robots().adopt_diverged(&robots, now_ms).await?;
        sqlx::query(
            "UPDATE assignments SET previous = (
                 SELECT old.deployment_id FROM assignments old
                 WHERE old.robot_id = assignments.robot_id AND old.task = assignments.task AND old.desired = 1)
             WHERE deployment_id = $1 AND released = 0 AND ended = 0 AND place <= $2",
        )
        .bind(deployment.as_str())
        .bind(last)
        .execute(self.0.connection())
        .await?;
        let superseded = sqlx::query_scalar(AssertSqlSafe(format!(
            "UPDATE assignments SET desired = 0, superseded_by = $1, ended = 1, progress = NULL, updated_at_ms = $3,
                 phase = CASE ended WHEN 1 THEN phase ELSE 'superseded' END,
                 timeline = CASE ended WHEN 1 THEN timeline ELSE {} END
             WHERE desired = 1 AND task = (SELECT task FROM deployments WHERE id = $1) AND robot_id IN (
                 SELECT robot_id FROM assignments
                 WHERE deployment_id = $1 AND released = 0 AND ended = 0 AND place <= $2)
             RETURNING deployment_id",
            appended_phase(Phase::Superseded, "$3")
        )))
        .bind(deployment.as_str())
        .bind(last)
        .bind(stored(now_ms))
        .fetch_all(self.0.connection())
        .await?;
        // The first batch has just got this entry in its timeline.
        sqlx::query(AssertSqlSafe(format!(
            "UPDATE assignments SET released = 1, desired = 1, updated_at_ms = $3,
                 expires_at_ms = CAST($3 AS BIGINT) + (SELECT expires_at_ms - created_at_ms FROM deployments WHERE id = $1),
                 timeline = CASE WHEN updated_at_ms = $3 THEN timeline ELSE {} END
             WHERE deployment_id = $1 AND released = 0 AND ended = 0 AND place <= $2",
            appended_phase(Phase::Assigned, "$3")
        )))
        .bind(deployment.as_str())
        .bind(last)
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        self.0.robots().raise_generations(&robots).await?;
        Ok(ReleasedBatch { robots, superseded: deployments(superseded)? })
    }

    /// Applies an order on `task` to those of `robots` where it changes anything. Returns the
    /// changed assignments.
    pub async fn apply(
        &mut self,
        order: TaskOrder,
        task: &TaskName,
        robots: &[RobotId],
        expires_at_ms: u64,
        now_ms: u64,
    ) -> Result<Vec<(DeploymentId, RobotId)>, StoreError> {
        let begun = appended_phase(Phase::Assigned, "$3");
        let restart = format!(
            "SET wanted = 'running', run = CASE WHEN last_run > run THEN last_run ELSE run END + 1, phase = 'assigned', ended = 0, progress = NULL, failure = NULL,
                 attempts = 0, expires_at_ms = $2, updated_at_ms = $3, timeline = {begun} FROM v WHERE desired = 1"
        );
        let start = format!("{restart} AND (wanted = 'stopped' OR ended = 1)");
        let set = match order {
            TaskOrder::Start => start.as_str(),
            TaskOrder::Restart => restart.as_str(),
            TaskOrder::Stop => {
                "SET wanted = 'stopped', expires_at_ms = CASE WHEN expires_at_ms IS NULL THEN NULL ELSE $2 END,
                     updated_at_ms = $3 FROM v
                 WHERE desired = 1 AND wanted = 'running'"
            }
            TaskOrder::Remove => {
                "SET desired = 0, wanted = 'stopped', updated_at_ms = $3,
                     expires_at_ms = CASE WHEN expires_at_ms IS NULL THEN NULL ELSE $2 END,
                     removed_generation = (SELECT generation + 1 FROM robots WHERE robots.id = assignments.robot_id)
                 FROM v WHERE desired = 1"
            }
        };
        let mut changed: Vec<(DeploymentId, RobotId)> = Vec::new();
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id) AS ({}) UPDATE assignments {set} AND assignments.robot_id = v.id AND task = $1
                 RETURNING assignments.deployment_id, assignments.robot_id",
                values(4, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query_as(AssertSqlSafe(sql))
                .bind(task.as_str())
                .bind(stored(expires_at_ms))
                .bind(stored(now_ms));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            changed.extend(deployment_robot_pairs(query.fetch_all(self.0.connection()).await?)?);
        }
        let robots: Vec<RobotId> = changed.iter().map(|(_, robot)| robot.clone()).collect();
        self.0.robots().raise_generations(&robots).await?;
        Ok(changed)
    }

    /// Ends the parts that wait for their batch on `robots`, of `task` or of all tasks: a stopped
    /// or removed task must not come back with a later batch. Returns their deployments.
    pub async fn drop_waiting(
        &mut self,
        task: Option<&TaskName>,
        robots: &[RobotId],
        now_ms: u64,
    ) -> Result<BTreeSet<DeploymentId>, StoreError> {
        let mut dropped = Vec::new();
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id) AS ({}) UPDATE assignments SET phase = 'cancelled', ended = 1, wanted = 'stopped', updated_at_ms = $2,
                     timeline = {} FROM v
                 WHERE released = 0 AND ended = 0 AND robot_id = v.id AND (task = $1 OR $1 = '')
                 RETURNING deployment_id",
                values(3, group.len(), &["TEXT"]),
                appended_phase(Phase::Cancelled, "$2")
            );
            let mut query = sqlx::query_scalar(AssertSqlSafe(sql))
                .bind(task.map_or("", TaskName::as_str).to_owned())
                .bind(stored(now_ms));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            dropped.append(&mut query.fetch_all(self.0.connection()).await?);
        }
        deployments(dropped)
    }

    /// Ends all assignments of robots that are being removed. Returns their deployments.
    pub async fn end_all_of(
        &mut self,
        robots: &[RobotId],
        now_ms: u64,
    ) -> Result<BTreeSet<DeploymentId>, StoreError> {
        let mut ended = Vec::new();
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id) AS ({}) UPDATE assignments SET desired = 0, ended = 1, updated_at_ms = $1,
                     phase = CASE ended WHEN 1 THEN phase ELSE 'cancelled' END,
                     timeline = CASE ended WHEN 1 THEN timeline ELSE {} END FROM v
                 WHERE robot_id = v.id AND (ended = 0 OR desired = 1)
                 RETURNING deployment_id",
                values(2, group.len(), &["TEXT"]),
                appended_phase(Phase::Cancelled, "$1")
            );
            let mut query = sqlx::query_scalar(AssertSqlSafe(sql)).bind(stored(now_ms));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            ended.append(&mut query.fetch_all(self.0.connection()).await?);
        }
        deployments(ended)
    }
}

fn deployments(rows: Vec<String>) -> Result<BTreeSet<DeploymentId>, StoreError> {
    let distinct: BTreeSet<String> = rows.into_iter().collect();
    distinct.iter().map(|row| id("assignments.deployment_id", row)).collect()
}
