//! Deployments: the operators' orders and their progress.

use std::collections::{BTreeSet, HashMap, HashSet};

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::api::{
    AssignmentView, CreateDeployment, DeliveryChoice, DeliveryDecision, DeploymentState,
    DeploymentView, PhaseCount, Placing, TimelineEntry,
};
use task_proto::desired::PackageRef;
use task_proto::ids::selector::Selector;
use task_proto::messages::report::{Failure, Phase, Progress};
use task_proto::packages::manifest::TaskKind;
use task_proto::{DeploymentId, RobotId, RobotName};

use crate::domain::deployment;
use crate::domain::rollout::{RobotProgress, Rollout};
use crate::store::fleet::needed_packages::with_needed_where;
use crate::store::repositories::Deployments;
use crate::store::rows::{
    from_json, from_optional_json, from_word, groups, id, json, number, priority, stored, values,
    word,
};
use crate::store::{Store, StoreError, Transaction};
use crate::store::{deliveries, timelines};

/// A deployment to be stored.
#[derive(Debug)]
pub struct NewDeployment<'a> {
    pub id: &'a DeploymentId,
    /// The package to deploy.
    pub package: &'a PackageRef,
    /// Whether the task is a service or a job.
    pub kind: TaskKind,
    pub order: &'a CreateDeployment,
    /// The number of robots that the order selects.
    pub selected: u64,
    /// The number of these robots for which the order is placed in the same write.
    pub placed: u64,
    /// The time at which unfinished assignments expire.
    pub expires_at_ms: u64,
}

/// A deployment with robots that wait for their batch.
#[derive(Debug)]
pub struct OpenRollout {
    pub rollout: Rollout,
    /// The number of robots on which the deployment has failed; 0 if the order tolerates any
    /// number.
    pub failed: u64,
    /// The unsettled robots, in the order of their turns. Without batches and a limit of failures,
    /// only the robots that wait.
    pub robots: Vec<OpenRobot>,
}

/// A robot with an unsettled assignment of a deployment.
#[derive(Debug)]
pub struct OpenRobot {
    pub robot: RobotId,
    /// The progress of the assignment.
    pub progress: RobotProgress,
    /// Whether the deployment's service has run there before.
    pub has_run: bool,
    /// Whether the robot was revoked, and so does nothing any more.
    pub is_revoked: bool,
}

/// One page of deployments, the newest first.
#[derive(Debug)]
pub struct DeploymentPage {
    pub deployments: Vec<DeploymentRow>,
    /// The last deployment of this page, if there are older ones.
    pub next: Option<DeploymentId>,
}

/// A deployment without its assignments.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeploymentRow {
    pub id: DeploymentId,
    pub package: PackageRef,
    pub kind: TaskKind,
    /// The selector as ordered; `None` in lists if it is long.
    pub selector: Option<Selector>,
    pub delivery: DeliveryChoice,
    pub priority: i32,
    pub is_cancelled: bool,
    pub is_paused: bool,
    pub batch: Option<u64>,
    pub max_failures: Option<u64>,
    pub created_at_ms: u64,
    pub expires_at_ms: u64,
    /// The number of assignments in each phase, in life-cycle order, without zeros.
    pub counts: Vec<PhaseCount>,
    /// The deployments that this one replaced on at least one robot.
    pub supersedes: Vec<DeploymentId>,
    /// How far the order is placed, if it isn't for some of its robots.
    pub placing: Option<Placing>,
    /// Whether the version now names another package.
    pub is_outdated: bool,
}

/// A deployment's assignment to one robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AssignmentRow {
    pub robot: RobotId,
    pub name: RobotName,
    /// Whether the robot's batch has begun.
    pub is_released: bool,
    pub delivery: Option<DeliveryDecision>,
    pub phase: Phase,
    pub progress: Option<Progress>,
    pub failure: Option<Failure>,
    pub attempts: u32,
    pub superseded_by: Option<DeploymentId>,
    pub updated_at_ms: u64,
    /// The past phases, if they were read.
    pub timeline: Option<Vec<TimelineEntry>>,
}

impl DeploymentRow {
    /// The state of the deployment as a whole.
    pub fn state(&self) -> DeploymentState {
        let is_placing = self.placing.is_some();
        deployment::state(self.kind, self.is_cancelled, self.is_paused, is_placing, &self.counts)
    }

    /// The deployment as operators see it; `None`: without assignments, as in lists.
    pub fn into_view(self, assignments: Option<Vec<AssignmentView>>) -> DeploymentView {
        DeploymentView {
            state: self.state(),
            id: self.id,
            package: self.package,
            kind: self.kind,
            selector: self.selector,
            delivery: self.delivery,
            priority: self.priority,
            batch: self.batch,
            max_failures: self.max_failures,
            created_at_ms: self.created_at_ms,
            expires_at_ms: self.expires_at_ms,
            counts: self.counts,
            supersedes: self.supersedes,
            placing: self.placing,
            outdated: self.is_outdated,
            assignments,
        }
    }
}

impl AssignmentRow {
    /// The assignment as operators see it, to a robot that is `online` or not.
    pub fn into_view(self, online: bool) -> AssignmentView {
        AssignmentView {
            robot: self.robot,
            name: self.name,
            online,
            released: self.is_released,
            delivery: self.delivery,
            phase: self.phase,
            progress: self.progress,
            failure: self.failure,
            attempts: self.attempts,
            superseded_by: self.superseded_by,
            updated_at_ms: self.updated_at_ms,
            timeline: self.timeline,
        }
    }
}

/// SQL for the selector in lists and events: it may name thousands of robots.
const SHORT_SELECTOR: &str = "CASE WHEN length(selector) <= 1000 THEN selector END";

/// Deployments with numbers from $1 to $2, so that deployments ordered meanwhile are not counted.
const NUMBER_RANGE: &str = "(SELECT id FROM deployments WHERE number BETWEEN $1 AND $2)";

impl Deployments<&Store> {
    /// The newest `limit` deployments, or the newest older than `before`; `None` if there is no
    /// such deployment. With `robots`, only deployments and assignments of these robots.
    pub async fn page(
        self,
        robots: Option<&[RobotId]>,
        before: Option<&DeploymentId>,
        limit: u32,
    ) -> Result<Option<DeploymentPage>, StoreError> {
        let number = match before {
            Some(before) => {
                let query = sqlx::query_scalar("SELECT number FROM deployments WHERE id = $1")
                    .bind(before.as_str());
                match query.fetch_optional(&self.0.reads).await? {
                    Some(number) => number,
                    None => return Ok(None),
                }
            }
            None => i64::MAX,
        };
        // Deployments of the same write have the same number.
        let older = "number < $1 OR (number = $1 AND id < $2)";
        let select = select(SHORT_SELECTOR);
        let sql = format!("{select} WHERE {older} ORDER BY number DESC, id DESC LIMIT $3");
        let mut rows = sqlx::query(AssertSqlSafe(sql))
            .bind(number)
            .bind(before.map_or("", DeploymentId::as_str))
            .bind(i64::from(limit) + 1)
            .fetch_all(&self.0.reads)
            .await?;
        let has_more = rows.len() > limit as usize;
        rows.truncate(limit as usize);
        let next = match rows.last() {
            Some(last) if has_more => Some(id("deployments.id", last.try_get("id")?)?),
            _ => None,
        };
        let mut deployments = self.read(&rows, robots).await?;
        deployments.retain(|row| robots.is_none() || !row.counts.is_empty());
        Ok(Some(DeploymentPage { deployments, next }))
    }

    /// One deployment without its assignments, and without its selector if that is long.
    pub async fn summary(self, id: &DeploymentId) -> Result<Option<DeploymentRow>, StoreError> {
        self.row(id, SHORT_SELECTOR).await
    }

    async fn row(
        self,
        id: &DeploymentId,
        selector: &str,
    ) -> Result<Option<DeploymentRow>, StoreError> {
        let sql = format!("{} WHERE id = $1", select(selector));
        let query = sqlx::query(AssertSqlSafe(sql)).bind(id.as_str());
        Ok(self.read(&query.fetch_all(&self.0.reads).await?, None).await?.pop())
    }

    /// One deployment with its assignments, sorted by robot name. Most callers don't ask for
    /// timelines.
    pub async fn get(
        self,
        id: &DeploymentId,
        with_timelines: bool,
    ) -> Result<Option<(DeploymentRow, Vec<AssignmentRow>)>, StoreError> {
        let Some(deployment) = self.row(id, "selector").await? else { return Ok(None) };
        let timeline = if with_timelines { "a.timeline" } else { "NULL" };
        let rows = sqlx::query(AssertSqlSafe(format!(
            "SELECT a.robot_id, r.name, a.released, a.phase, a.progress, a.failure, a.attempts, a.superseded_by,
                 a.updated_at_ms, a.mechanism, a.rule, a.because, CAST({timeline} AS TEXT) AS timeline
             FROM assignments a JOIN robots r ON r.id = a.robot_id WHERE a.deployment_id = $1"
        )))
        .bind(id.as_str())
        .fetch_all(&self.0.reads)
        .await?;
        let mut assignments = rows.iter().map(assignment_row).collect::<Result<Vec<_>, _>>()?;
        assignments.sort_by(|one, other| one.name.cmp(&other.name));
        Ok(Some((deployment, assignments)))
    }

    /// The selector that a deployment was ordered with.
    pub async fn selector(self, deployment: &DeploymentId) -> Result<Option<Selector>, StoreError> {
        let query = sqlx::query_scalar("SELECT selector FROM deployments WHERE id = $1")
            .bind(deployment.as_str());
        let selector: Option<String> = query.fetch_optional(&self.0.reads).await?;
        selector.map(|selector| id("deployments.selector", &selector)).transpose()
    }

    /// Batched deployments that may proceed on their own: they have waiting robots and are not
    /// paused.
    pub async fn open_rollouts(self) -> Result<BTreeSet<DeploymentId>, StoreError> {
        let rows: Vec<String> = sqlx::query_scalar(
            "SELECT id FROM deployments WHERE batch IS NOT NULL AND paused = 0 AND cancelled_at_ms IS NULL AND id IN (
                 SELECT deployment_id FROM assignments WHERE released = 0 AND ended = 0)",
        )
        .fetch_all(&self.0.reads)
        .await?;
        rows.iter().map(|row| id("deployments.id", row)).collect()
    }

    /// The deployments whose package lost its version to another one. Mostly there are none.
    pub(in crate::store) async fn outdated(self) -> Result<HashSet<String>, StoreError> {
        // The same package has the same text.
        let rows: Vec<String> = sqlx::query_scalar(
            "SELECT d.id FROM packages p JOIN deployments d ON d.task = p.name AND d.package = p.package
             WHERE p.replaced_by IS NOT NULL",
        )
        .fetch_all(&self.0.reads)
        .await?;
        Ok(rows.into_iter().collect())
    }

    /// The packages that a robot should have, or may get (back): they must not be collected.
    pub async fn packages_in_use(self) -> Result<Vec<PackageRef>, StoreError> {
        let sql = format!(
            "{} SELECT DISTINCT d.package FROM deployments d WHERE d.id IN (
                 SELECT deployment_id FROM assignments WHERE ended = 0
                 UNION SELECT deployment_id FROM order_chunks
                 UNION SELECT deployment_id FROM needed
                 UNION SELECT previous FROM assignments WHERE desired = 1 AND previous IS NOT NULL)",
            with_needed_where("desired = 1")
        );
        let rows: Vec<String> =
            sqlx::query_scalar(AssertSqlSafe(sql)).fetch_all(&self.0.reads).await?;
        rows.iter().map(|row| from_json("deployments.package", row)).collect()
    }

    /// Reads consecutive rows, limited to `robots` if that is given.
    async fn read(
        self,
        rows: &[sqlx::any::AnyRow],
        robots: Option<&[RobotId]>,
    ) -> Result<Vec<DeploymentRow>, StoreError> {
        let (Some(newest), Some(oldest)) = (rows.first(), rows.last()) else {
            return Ok(Vec::new());
        };
        let numbers = (oldest.try_get("number")?, newest.try_get("number")?);
        let mut counts = self.phase_counts(numbers, robots).await?;
        let superseded: Vec<(String, String)> = sqlx::query_as(AssertSqlSafe(format!(
            "SELECT DISTINCT superseded_by, deployment_id FROM assignments WHERE superseded_by IN {NUMBER_RANGE}
             ORDER BY deployment_id"
        )))
        .bind(numbers.0)
        .bind(numbers.1)
        .fetch_all(&self.0.reads)
        .await?;
        let mut supersedes: HashMap<String, Vec<DeploymentId>> = HashMap::new();
        for (newer, older) in superseded {
            supersedes
                .entry(newer)
                .or_default()
                .push(crate::store::rows::id("assignments.deployment_id", &older)?);
        }
        let outdated = self.outdated().await?;
        let read = |row: &sqlx::any::AnyRow| {
            let id: String = row.try_get("id")?;
            deployment_row(
                row,
                counts.remove(&id).unwrap_or_default(),
                supersedes.remove(&id).unwrap_or_default(),
                outdated.contains(&id),
            )
        };
        rows.iter().map(read).collect()
    }

    /// The number of assignments in each phase, for each deployment with one of these numbers: of
    /// all robots, or of some.
    async fn phase_counts(
        self,
        numbers: (i64, i64),
        robots: Option<&[RobotId]>,
    ) -> Result<HashMap<String, Vec<PhaseCount>>, StoreError> {
        let groups: Vec<&[RobotId]> =
            robots.map_or_else(|| vec![[].as_slice()], |robots| groups(robots).collect());
        let mut counts: HashMap<String, Vec<PhaseCount>> = HashMap::new();
        for group in groups {
            let among = match group.len() {
                0 => String::new(),
                robots => format!("AND robot_id IN ({})", values(3, robots, &["TEXT"])),
            };
            let sql = format!(
                "SELECT deployment_id, phase, COUNT(*) FROM assignments WHERE deployment_id IN {NUMBER_RANGE} {among}
                 GROUP BY deployment_id, phase"
            );
            let mut query = sqlx::query_as::<_, (String, String, i64)>(AssertSqlSafe(sql))
                .bind(numbers.0)
                .bind(numbers.1);
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for (deployment, phase, count) in query.fetch_all(&self.0.reads).await? {
                let (phase, count) = (Phase::from_text(&phase), number(count));
                let sum = counts.entry(deployment).or_default();
                match sum.iter_mut().find(|known| known.phase == phase) {
                    Some(known) => known.count += count,
                    None => sum.push(PhaseCount { phase, count }),
                }
            }
        }
        Ok(counts)
    }
}

impl Deployments<&mut Transaction> {
    pub async fn insert(&mut self, new: &NewDeployment<'_>, now_ms: u64) -> Result<(), StoreError> {
        let number = stored(self.0.sequence());
        sqlx::query(
            "INSERT INTO deployments (id, number, task, version, package, kind, selector, delivery, batch, max_failures,
                 created_at_ms, expires_at_ms, priority, selected, placed, restart)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, $16)",
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
        .bind(stored(new.selected))
        .bind(stored(new.placed))
        .bind(i64::from(new.order.restart))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Whether the operator cancelled a deployment; `None` if there is no such deployment.
    pub async fn is_cancelled(&mut self, id: &DeploymentId) -> Result<Option<bool>, StoreError> {
        let row: Option<(Option<i64>,)> =
            sqlx::query_as("SELECT cancelled_at_ms FROM deployments WHERE id = $1")
                .bind(id.as_str())
                .fetch_optional(self.0.connection())
                .await?;
        Ok(row.map(|(cancelled_at_ms,)| cancelled_at_ms.is_some()))
    }

    /// The pace and the open robots of a deployment with waiting robots; `None` for any other.
    pub async fn rollout(&mut self, id: &DeploymentId) -> Result<Option<OpenRollout>, StoreError> {
        let row = sqlx::query(
            "SELECT kind, batch, max_failures, forgiven, paused, selected, placed FROM deployments
             WHERE id = $1 AND cancelled_at_ms IS NULL AND EXISTS (
                 SELECT 1 FROM assignments WHERE deployment_id = $1 AND released = 0 AND ended = 0)",
        )
        .bind(id.as_str())
        .fetch_optional(self.0.connection())
        .await?;
        let Some(row) = row else { return Ok(None) };
        let kind: TaskKind = from_word("deployments.kind", row.try_get("kind")?)?;
        let rollout = Rollout {
            batch: row.try_get::<Option<i64>, _>("batch")?.map(number),
            max_failures: row.try_get::<Option<i64>, _>("max_failures")?.map(number),
            forgiven: number(row.try_get("forgiven")?),
            paused: row.try_get::<i64, _>("paused")? == 1,
            is_placing: placing(&row)?.is_some(),
        };
        if rollout.batch.is_none() && rollout.max_failures.is_none() {
            let robots = self.open_robots(id, kind, "AND a.released = 0").await?;
            return Ok(Some(OpenRollout { rollout, failed: 0, robots }));
        }
        let phase_counts: Vec<(String, i64)> = sqlx::query_as(
            "SELECT phase, COUNT(*) FROM assignments WHERE deployment_id = $1 GROUP BY phase",
        )
        .bind(id.as_str())
        .fetch_all(self.0.connection())
        .await?;
        let failures = phase_counts
            .iter()
            .filter(|(phase, _)| deployment::is_failure(Phase::from_text(phase), kind));
        let failed = failures.map(|(_, count)| number(*count)).sum();
        Ok(Some(OpenRollout { rollout, failed, robots: self.open_robots(id, kind, "").await? }))
    }

    /// The unsettled robots of a deployment that meet a further condition, in the order of their
    /// turns.
    async fn open_robots(
        &mut self,
        deployment: &DeploymentId,
        kind: TaskKind,
        condition: &str,
    ) -> Result<Vec<OpenRobot>, StoreError> {
        let rows: Vec<(String, i64, String, i64, i64)> = sqlx::query_as(AssertSqlSafe(format!(
            "SELECT a.robot_id, a.released, a.phase, a.ran,
                 CAST(CASE WHEN r.revoked_at_ms IS NULL THEN 0 ELSE 1 END AS BIGINT)
             FROM assignments a JOIN robots r ON r.id = a.robot_id
             WHERE a.deployment_id = $1 AND a.ended = 0 AND NOT (a.phase = 'running' AND $2 = 'service')
                 {condition}
             ORDER BY a.place"
        )))
        .bind(deployment.as_str())
        .bind(word(&kind))
        .fetch_all(self.0.connection())
        .await?;
        let mut robots = Vec::with_capacity(rows.len());
        for (robot, released, phase, ran, is_revoked) in rows {
            let (robot, phase) =
                (self::id("assignments.robot_id", &robot)?, Phase::from_text(&phase));
            let progress = match phase {
                _ if released == 0 => RobotProgress::Waiting,
                Phase::Assigned | Phase::Deferred => RobotProgress::Released,
                _ => RobotProgress::Begun,
            };
            // A service that ran has given the result that its batch waits for, whatever was
            // ordered since.
            let has_run = ran == 1 && kind == TaskKind::Service;
            robots.push(OpenRobot { robot, progress, has_run, is_revoked: is_revoked == 1 });
        }
        Ok(robots)
    }

    /// The deployments that have begun on `robot` and have not ended there.
    pub async fn begun_on(
        &mut self,
        robot: &RobotId,
    ) -> Result<BTreeSet<DeploymentId>, StoreError> {
        let rows: Vec<String> = sqlx::query_scalar(
            "SELECT deployment_id FROM assignments WHERE robot_id = $1 AND released = 1 AND ended = 0",
        )
        .bind(robot.as_str())
        .fetch_all(self.0.connection())
        .await?;
        rows.iter().map(|row| id("assignments.deployment_id", row)).collect()
    }

    /// Stops a deployment from beginning further batches.
    pub async fn pause(&mut self, id: &DeploymentId) -> Result<(), StoreError> {
        self.update("UPDATE deployments SET paused = $2 WHERE id = $1", id, 1).await
    }

    /// Lets a deployment begin batches again, and sets its forgiven failures to `failures`.
    pub async fn resume(&mut self, id: &DeploymentId, failures: u64) -> Result<(), StoreError> {
        self.update("UPDATE deployments SET paused = 0, forgiven = $2 WHERE id = $1", id, failures)
            .await
    }

    /// Marks a deployment as cancelled by the operator.
    pub async fn mark_cancelled(
        &mut self,
        id: &DeploymentId,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        self.update("UPDATE deployments SET cancelled_at_ms = $2 WHERE id = $1", id, now_ms).await
    }

    /// Stores the place from which a cancelled deployment is still to be taken away from robots;
    /// `None`: from none.
    pub async fn set_cancel_from(
        &mut self,
        id: &DeploymentId,
        place: Option<u64>,
    ) -> Result<(), StoreError> {
        sqlx::query("UPDATE deployments SET cancel_from = $2 WHERE id = $1")
            .bind(id.as_str())
            .bind(place.map(stored))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    /// The oldest cancelled deployment that is still to be taken away from robots, and the place to
    /// go on from.
    pub async fn next_to_cancel(&mut self) -> Result<Option<(DeploymentId, u64)>, StoreError> {
        let sql = "SELECT id, cancel_from FROM deployments WHERE cancel_from IS NOT NULL
             ORDER BY number LIMIT 1";
        let row: Option<(String, i64)> =
            sqlx::query_as(sql).fetch_optional(self.0.connection()).await?;
        row.map(|(deployment, place)| Ok((id("deployments.id", &deployment)?, number(place))))
            .transpose()
    }

    async fn update(
        &mut self,
        sql: &'static str,
        id: &DeploymentId,
        value: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(sql).bind(id.as_str()).bind(stored(value)).execute(self.0.connection()).await?;
        Ok(())
    }
}

/// SQL for the columns of a deployment, with this SQL for its selector.
fn select(selector: &str) -> String {
    format!(
        "SELECT id, number, package, kind, {selector} AS selector, delivery, priority, batch, max_failures,
             paused, created_at_ms, expires_at_ms, cancelled_at_ms, selected, placed
         FROM deployments"
    )
}

fn deployment_row(
    row: &sqlx::any::AnyRow,
    mut counts: Vec<PhaseCount>,
    supersedes: Vec<DeploymentId>,
    is_outdated: bool,
) -> Result<DeploymentRow, StoreError> {
    counts.sort_by_key(|count| Phase::ALL.iter().position(|phase| *phase == count.phase));
    Ok(DeploymentRow {
        id: id("deployments.id", row.try_get("id")?)?,
        package: from_json("deployments.package", row.try_get("package")?)?,
        kind: from_word("deployments.kind", row.try_get("kind")?)?,
        selector: row
            .try_get::<Option<&str>, _>("selector")?
            .map(|it| id("deployments.selector", it))
            .transpose()?,
        delivery: from_word("deployments.delivery", row.try_get("delivery")?)?,
        priority: priority(row)?,
        is_cancelled: row.try_get::<Option<i64>, _>("cancelled_at_ms")?.is_some(),
        is_paused: row.try_get::<i64, _>("paused")? == 1,
        batch: row.try_get::<Option<i64>, _>("batch")?.map(number),
        max_failures: row.try_get::<Option<i64>, _>("max_failures")?.map(number),
        created_at_ms: number(row.try_get("created_at_ms")?),
        expires_at_ms: number(row.try_get("expires_at_ms")?),
        counts,
        supersedes,
        placing: placing(row)?,
        is_outdated,
    })
}

/// How far an order is placed; `None`: for all its robots.
fn placing(row: &sqlx::any::AnyRow) -> Result<Option<Placing>, StoreError> {
    let read =
        |column| row.try_get::<Option<i64>, _>(column).map(|count| number(count.unwrap_or(0)));
    let placing = Placing { selected: read("selected")?, placed: read("placed")? };
    Ok((placing.placed < placing.selected).then_some(placing))
}

fn assignment_row(row: &sqlx::any::AnyRow) -> Result<AssignmentRow, StoreError> {
    let superseded_by: Option<String> = row.try_get("superseded_by")?;
    Ok(AssignmentRow {
        robot: id("assignments.robot_id", row.try_get("robot_id")?)?,
        name: id("robots.name", row.try_get("name")?)?,
        is_released: row.try_get::<i64, _>("released")? == 1,
        delivery: deliveries::decision(row)?,
        phase: Phase::from_text(row.try_get("phase")?),
        progress: from_optional_json("assignments.progress", row.try_get("progress")?)?,
        failure: from_optional_json("assignments.failure", row.try_get("failure")?)?,
        attempts: u32::try_from(row.try_get::<i64, _>("attempts")?).unwrap_or(u32::MAX),
        superseded_by: superseded_by
            .map(|newer| id("assignments.superseded_by", &newer))
            .transpose()?,
        updated_at_ms: number(row.try_get("updated_at_ms")?),
        timeline: row.try_get::<Option<&str>, _>("timeline")?.map(timelines::read),
    })
}
