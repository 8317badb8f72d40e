//! Deployments: the operators' orders, and how far they have come.

use std::collections::HashMap;

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::api::{AssignmentView, CreateDeployment, DeploymentView, PhaseCount};
use task_proto::desired::PackageRef;
use task_proto::manifest::TaskKind;
use task_proto::report::Phase;
use task_proto::{DeploymentId, RobotId};

use super::deliveries;
use super::rows::{from_json, from_optional_json, from_word, groups, id, json, number, priority, stored, values, word};
use super::{Store, StoreError, Write};
use crate::deployment;
use crate::rollout::{Rollout, Tally};

/// An order to be stored.
#[derive(Debug)]
pub struct NewDeployment<'a> {
    /// Its identity.
    pub id: &'a DeploymentId,
    /// What it brings.
    pub package: &'a PackageRef,
    /// Service or job.
    pub kind: TaskKind,
    /// What the operator asked for.
    pub order: &'a CreateDeployment,
    /// When what is left of it expires.
    pub expires_at_ms: u64,
}

/// The most deployments that are listed; older ones are found by id.
const LISTED: &str = "(SELECT id FROM deployments WHERE id = $1 OR $1 = '' ORDER BY number DESC LIMIT 200)";

impl Store {
    /// The newest deployments, newest first, without assignments.
    pub async fn deployments(&self) -> Result<Vec<DeploymentView>, StoreError> {
        self.deployment_views("", self.counted("", None).await?).await
    }

    /// Of the newest deployments those that concern one of these robots, as far as they do.
    pub async fn deployments_of(&self, robots: &[RobotId]) -> Result<Vec<DeploymentView>, StoreError> {
        let mut counts: HashMap<String, Vec<PhaseCount>> = HashMap::new();
        for group in groups(robots) {
            for (deployment, counted) in self.counted("", Some(group)).await? {
                let sum = counts.entry(deployment).or_default();
                for PhaseCount { phase, count } in counted {
                    match sum.iter_mut().find(|known| known.phase == phase) {
                        Some(known) => known.count += count,
                        None => sum.push(PhaseCount { phase, count }),
                    }
                }
            }
        }
        let mut views = self.deployment_views("", counts).await?;
        views.retain(|view| !view.counts.is_empty());
        Ok(views)
    }

    /// One deployment without its assignments.
    pub async fn deployment_summary(&self, id: &DeploymentId) -> Result<Option<DeploymentView>, StoreError> {
        Ok(self.deployment_views(id.as_str(), self.counted(id.as_str(), None).await?).await?.pop())
    }

    /// One deployment with its assignments, sorted by robot name; their `online` is left false.
    pub async fn deployment(&self, id: &DeploymentId) -> Result<Option<DeploymentView>, StoreError> {
        let Some(mut view) = self.deployment_summary(id).await? else { return Ok(None) };
        let rows = sqlx::query(
            "SELECT a.robot_id, r.name, a.released, a.phase, a.progress, a.failure, a.attempts, a.superseded_by,
                 a.updated_at_ms, a.mechanism, a.rule, a.because
             FROM assignments a JOIN robots r ON r.id = a.robot_id WHERE a.deployment_id = $1",
        )
        .bind(id.as_str())
        .fetch_all(&self.reads)
        .await?;
        let mut assignments = rows.iter().map(assignment_view).collect::<Result<Vec<_>, _>>()?;
        assignments.sort_by(|one, other| one.name.cmp(&other.name));
        view.assignments = Some(assignments);
        Ok(Some(view))
    }

    /// The packages some robot should have, or may get (back): what must not be collected.
    pub async fn packages_in_use(&self) -> Result<Vec<PackageRef>, StoreError> {
        let rows: Vec<String> = sqlx::query_scalar(
            "SELECT DISTINCT d.package FROM deployments d WHERE d.id IN (
                 SELECT deployment_id FROM assignments WHERE desired = 1 OR ended = 0
                 UNION SELECT previous FROM assignments WHERE desired = 1 AND previous IS NOT NULL)",
        )
        .fetch_all(&self.reads)
        .await?;
        rows.iter().map(|row| from_json("deployments.package", row)).collect()
    }

    /// How many assignments of each deployment stand in which phase: of one, or with an empty `id` of the newest; of all
    /// robots or of a group of them.
    async fn counted(
        &self,
        id: &str,
        robots: Option<&[RobotId]>,
    ) -> Result<HashMap<String, Vec<PhaseCount>>, StoreError> {
        let among = match robots {
            Some(group) => format!("AND robot_id IN ({})", values(2, group.len(), &["TEXT"])),
            None => String::new(),
        };
        let sql = format!(
            "SELECT deployment_id, phase, COUNT(*) FROM assignments WHERE deployment_id IN {LISTED} {among}
             GROUP BY deployment_id, phase"
        );
        let mut query = sqlx::query_as::<_, (String, String, i64)>(AssertSqlSafe(sql)).bind(id);
        for robot in robots.unwrap_or_default() {
            query = query.bind(robot.as_str());
        }
        let mut counts: HashMap<String, Vec<PhaseCount>> = HashMap::new();
        for (deployment, phase, count) in query.fetch_all(&self.reads).await? {
            let count = PhaseCount { phase: Phase::from_text(&phase), count: number(count) };
            counts.entry(deployment).or_default().push(count);
        }
        Ok(counts)
    }

    /// The views of one deployment, or with an empty `id` of the newest, with these counts.
    async fn deployment_views(
        &self,
        id: &str,
        mut counts: HashMap<String, Vec<PhaseCount>>,
    ) -> Result<Vec<DeploymentView>, StoreError> {
        let rows = sqlx::query(AssertSqlSafe(format!(
            "SELECT id, package, kind, selector, delivery, priority, batch, max_failures, paused, created_at_ms, expires_at_ms,
                 cancelled_at_ms
             FROM deployments WHERE id IN {LISTED} ORDER BY number DESC"
        )))
        .bind(id)
        .fetch_all(&self.reads)
        .await?;
        let superseded: Vec<(String, String)> = sqlx::query_as(AssertSqlSafe(format!(
            "SELECT DISTINCT superseded_by, deployment_id FROM assignments WHERE superseded_by IN {LISTED}
             ORDER BY deployment_id"
        )))
        .bind(id)
        .fetch_all(&self.reads)
        .await?;
        let mut supersedes: HashMap<String, Vec<DeploymentId>> = HashMap::new();
        for (newer, older) in superseded {
            supersedes.entry(newer).or_default().push(super::rows::id("assignments.deployment_id", &older)?);
        }
        let view = |row: &sqlx::any::AnyRow| {
            let id: String = row.try_get("id")?;
            deployment_view(row, counts.remove(&id).unwrap_or_default(), supersedes.remove(&id).unwrap_or_default())
        };
        rows.iter().map(view).collect()
    }
}

impl Write {
    /// Stores an order.
    pub async fn insert_deployment(&mut self, new: &NewDeployment<'_>, now_ms: u64) -> Result<(), StoreError> {
        let number = stored(self.turn());
        sqlx::query(
            "INSERT INTO deployments (id, number, task, version, package, kind, selector, delivery, batch, max_failures,
                 created_at_ms, expires_at_ms, priority)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13)",
        )
        .bind(new.id.as_str())
        .bind(number)
        .bind(new.package.name.as_str())
        .bind(new.package.version.as_str())
        .bind(json(new.package))
        .bind(word(&new.kind))
        .bind(new.order.selector.to_string())
        .bind(word(&new.order.delivery))
        .bind(new.order.batch.map(stored))
        .bind(new.order.max_failures.map(stored))
        .bind(stored(now_ms))
        .bind(stored(new.expires_at_ms))
        .bind(i64::from(new.order.priority))
        .execute(self.connection())
        .await?;
        Ok(())
    }

    /// Whether the operator took a deployment back; `None` if there is none.
    pub async fn is_cancelled(&mut self, id: &DeploymentId) -> Result<Option<bool>, StoreError> {
        let row: Option<(Option<i64>,)> = sqlx::query_as("SELECT cancelled_at_ms FROM deployments WHERE id = $1")
            .bind(id.as_str())
            .fetch_optional(self.connection())
            .await?;
        Ok(row.map(|(cancelled_at_ms,)| cancelled_at_ms.is_some()))
    }

    /// The pace and the tally of a deployment that has robots waiting; `None` for any other.
    pub async fn rollout(&mut self, id: &DeploymentId) -> Result<Option<(Rollout, Tally)>, StoreError> {
        let row = sqlx::query(
            "SELECT kind, batch, max_failures, forgiven, paused FROM deployments
             WHERE id = $1 AND cancelled_at_ms IS NULL AND EXISTS (
                 SELECT 1 FROM assignments WHERE deployment_id = $1 AND released = 0 AND ended = 0)",
        )
        .bind(id.as_str())
        .fetch_optional(self.connection())
        .await?;
        let Some(row) = row else { return Ok(None) };
        let kind: TaskKind = from_word("deployments.kind", row.try_get("kind")?)?;
        let rollout = Rollout {
            batch: row.try_get::<Option<i64>, _>("batch")?.map(number),
            max_failures: row.try_get::<Option<i64>, _>("max_failures")?.map(number),
            forgiven: number(row.try_get("forgiven")?),
            paused: row.try_get::<i64, _>("paused")? == 1,
        };
        let counted: Vec<(i64, String, i64)> = sqlx::query_as(
            "SELECT released, phase, COUNT(*) FROM assignments WHERE deployment_id = $1 GROUP BY released, phase",
        )
        .bind(id.as_str())
        .fetch_all(self.connection())
        .await?;
        let mut tally = Tally::default();
        for (released, phase, count) in counted {
            let (phase, count) = (Phase::from_text(&phase), number(count));
            if deployment::is_failure(phase, kind) {
                tally.failed += count;
            } else if !phase.is_settled(kind) {
                *(if released == 1 { &mut tally.busy } else { &mut tally.waiting }) += count;
            }
        }
        Ok(Some((rollout, tally)))
    }

    /// Stops a deployment from beginning further batches.
    pub async fn pause(&mut self, id: &DeploymentId) -> Result<(), StoreError> {
        self.update_deployment("UPDATE deployments SET paused = $2 WHERE id = $1", id, 1).await
    }

    /// Lets a deployment begin batches again and forgives it `failures`.
    pub async fn resume(&mut self, id: &DeploymentId, failures: u64) -> Result<(), StoreError> {
        self.update_deployment("UPDATE deployments SET paused = 0, forgiven = $2 WHERE id = $1", id, failures).await
    }

    /// Marks a deployment as taken back by the operator.
    pub async fn mark_cancelled(&mut self, id: &DeploymentId, now_ms: u64) -> Result<(), StoreError> {
        self.update_deployment("UPDATE deployments SET cancelled_at_ms = $2 WHERE id = $1", id, now_ms).await
    }

    async fn update_deployment(&mut self, sql: &'static str, id: &DeploymentId, value: u64) -> Result<(), StoreError> {
        sqlx::query(sql).bind(id.as_str()).bind(stored(value)).execute(self.connection()).await?;
        Ok(())
    }
}

fn deployment_view(
    row: &sqlx::any::AnyRow,
    mut counts: Vec<PhaseCount>,
    supersedes: Vec<DeploymentId>,
) -> Result<DeploymentView, StoreError> {
    counts.sort_by_key(|count| Phase::ALL.iter().position(|phase| *phase == count.phase));
    let kind = from_word("deployments.kind", row.try_get("kind")?)?;
    let cancelled = row.try_get::<Option<i64>, _>("cancelled_at_ms")?.is_some();
    let paused = row.try_get::<i64, _>("paused")? == 1;
    Ok(DeploymentView {
        id: id("deployments.id", row.try_get("id")?)?,
        package: from_json("deployments.package", row.try_get("package")?)?,
        kind,
        selector: id("deployments.selector", row.try_get("selector")?)?,
        delivery: from_word("deployments.delivery", row.try_get("delivery")?)?,
        priority: priority(row)?,
        state: deployment::state(kind, cancelled, paused, &counts),
        batch: row.try_get::<Option<i64>, _>("batch")?.map(number),
        max_failures: row.try_get::<Option<i64>, _>("max_failures")?.map(number),
        created_at_ms: number(row.try_get("created_at_ms")?),
        expires_at_ms: number(row.try_get("expires_at_ms")?),
        counts,
        supersedes,
        assignments: None,
    })
}

fn assignment_view(row: &sqlx::any::AnyRow) -> Result<AssignmentView, StoreError> {
    let superseded_by: Option<String> = row.try_get("superseded_by")?;
    Ok(AssignmentView {
        robot: id("assignments.robot_id", row.try_get("robot_id")?)?,
        name: id("robots.name", row.try_get("name")?)?,
        online: false,
        released: row.try_get::<i64, _>("released")? == 1,
        delivery: deliveries::decision(row)?,
        phase: Phase::from_text(row.try_get("phase")?),
        progress: from_optional_json("assignments.progress", row.try_get("progress")?)?,
        failure: from_optional_json("assignments.failure", row.try_get("failure")?)?,
        attempts: u32::try_from(row.try_get::<i64, _>("attempts")?).unwrap_or(u32::MAX),
        superseded_by: superseded_by.map(|newer| id("assignments.superseded_by", &newer)).transpose()?,
        updated_at_ms: number(row.try_get("updated_at_ms")?),
    })
}
