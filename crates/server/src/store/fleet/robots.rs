//! Robots: their identities, and the operator's view of them.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::api::{AWAITS_APPROVAL, RobotTask, RobotView};
use task_proto::desired::{BlobRef, Delivery, DesiredTask, Evidence, PackageRef};
use task_proto::id::Labels;
use task_proto::report::{Condition, LinkFacts, Phase, Report};
use task_proto::settings::RobotSettings;
use task_proto::{DeploymentId, Digest, Generation, MacAddress, RobotId, RobotName, TaskName};

use crate::domain::person::Scope;
use crate::store::deliveries;
use crate::store::rows::{
    from_json, from_optional_json, from_word, groups, id, json, number, priority, stored, values,
};
use crate::store::{Store, StoreError, Write};

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct KnownRobot {
    pub id: RobotId,
    pub name: RobotName,
    /// The MAC address of its registration.
    pub mac: MacAddress,
    pub labels: Labels,
}

/// The version of a robot's password at an external broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BrokerCredential {
    pub robot: RobotId,
    /// The password's number; each further enrollment raises it.
    pub number: u64,
}

/// A robot's desired state, read at one moment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DesiredTasks {
    pub robot: RobotId,
    /// The number of this state.
    pub generation: Generation,
    /// The generation of the robot's last report.
    pub observed_generation: Generation,
    /// The tasks, sorted by name.
    pub tasks: Vec<DesiredTask>,
    /// Blobs sent along with the state: the robot does not have them yet.
    pub along: Vec<BlobRef>,
    /// The publishers' signed documents on these tasks' packages.
    pub evidence: Evidence,
    pub settings: RobotSettings,
}

/// The order for which a robot fetches a blob.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FetchedBy {
    pub priority: i32,
    /// The deployment's number: a later deployment has a higher one.
    pub number: u64,
    pub labels: Labels,
}

pub(in crate::store) const KNOWN: &str =
    "SELECT id, name, mac, labels FROM robots WHERE removed_at_ms IS NULL";

const KNOWN_BY_ID_OR_NAME: &str = "SELECT id, name, mac, labels FROM robots WHERE removed_at_ms IS NULL AND (id = $1 OR name = $1)";

impl Store {
    /// All robots, sorted by name. `online` and `address` are left empty: only presence knows them.
    pub async fn robots(&self) -> Result<Vec<RobotView>, StoreError> {
        // The tasks first: no phase stands beside a report that is older than the phase.
        let tasks = sqlx::query(TASK_ROWS).fetch_all(&self.reads).await?;
        let robots = sqlx::query(ROBOT_ROWS).fetch_all(&self.reads).await?;
        robot_views(robots, tasks, &self.outdated_deployments().await?)
    }

    /// Those of `robots` that are registered, sorted by name. `online` and `address` are left
    /// empty.
    pub async fn robots_among(&self, robots: &[RobotId]) -> Result<Vec<RobotView>, StoreError> {
        let mut views = Vec::with_capacity(robots.len());
        let outdated = self.outdated_deployments().await?;
        for group in groups(robots) {
            let ids = values(1, group.len(), &["TEXT"]);
            let mut robots =
                sqlx::query(AssertSqlSafe(format!("{ROBOT_ROWS} AND r.id IN ({ids})")));
            let mut tasks =
                sqlx::query(AssertSqlSafe(format!("{TASK_ROWS} AND a.robot_id IN ({ids})")));
            for robot in group {
                robots = robots.bind(robot.as_str());
                tasks = tasks.bind(robot.as_str());
            }
            let tasks = tasks.fetch_all(&self.reads).await?;
            views.extend(robot_views(robots.fetch_all(&self.reads).await?, tasks, &outdated)?);
        }
        views.sort_by(|one: &RobotView, other| one.name.cmp(&other.name));
        Ok(views)
    }

    /// One robot; `None` if there is none or the robot was removed.
    pub async fn robot(&self, robot: &RobotId) -> Result<Option<RobotView>, StoreError> {
        Ok(self.robots_among(std::slice::from_ref(robot)).await?.pop())
    }

    /// The robot with this id or name.
    pub async fn find_robot(&self, id_or_name: &str) -> Result<Option<KnownRobot>, StoreError> {
        let row =
            sqlx::query(KNOWN_BY_ID_OR_NAME).bind(id_or_name).fetch_optional(&self.reads).await?;
        row.map(|row| known_robot(&row)).transpose()
    }

    /// The robots in a scope.
    pub async fn robots_in(&self, scope: &Scope) -> Result<Vec<RobotId>, StoreError> {
        Ok(self.known_robots(scope).await?.into_iter().map(|robot| robot.id).collect())
    }

    /// The robots of a scope, with the measured facts of their links.
    pub async fn robots_and_links(
        &self,
        scope: &Scope,
    ) -> Result<Vec<(KnownRobot, Option<LinkFacts>)>, StoreError> {
        let sql = "SELECT id, name, mac, labels, link FROM robots WHERE removed_at_ms IS NULL";
        let rows = sqlx::query(sql).fetch_all(&self.reads).await?;
        let read = |row: &sqlx::any::AnyRow| {
            Ok((known_robot(row)?, from_optional_json("robots.link", row.try_get("link")?)?))
        };
        let mut robots =
            rows.iter().map(read).collect::<Result<Vec<(KnownRobot, _)>, StoreError>>()?;
        robots.retain(|(robot, _)| scope.covers(&robot.id, &robot.name, &robot.labels));
        Ok(robots)
    }

    /// The robots of a scope.
    pub async fn known_robots(&self, scope: &Scope) -> Result<Vec<KnownRobot>, StoreError> {
        let rows = sqlx::query(KNOWN).fetch_all(&self.reads).await?;
        let mut robots = rows.iter().map(known_robot).collect::<Result<Vec<_>, _>>()?;
        robots.retain(|robot| scope.covers(&robot.id, &robot.name, &robot.labels));
        Ok(robots)
    }

    pub async fn robot_ids(&self) -> Result<Vec<RobotId>, StoreError> {
        let known = "SELECT id FROM robots WHERE removed_at_ms IS NULL";
        let rows: Vec<String> = sqlx::query_scalar(known).fetch_all(&self.reads).await?;
        rows.iter().map(|row| id("robots.id", row)).collect()
    }

    /// The robots' credentials at an external broker, sorted by robot. Revoked robots and robots
    /// that wait for approval have none there.
    pub async fn broker_credentials(&self) -> Result<Vec<BrokerCredential>, StoreError> {
        let approved = format!("{CREDENTIALS} AND awaits_approval = 0 ORDER BY id");
        let rows = sqlx::query(AssertSqlSafe(approved)).bind("");
        rows.fetch_all(&self.reads).await?.iter().map(broker_credential).collect()
    }

    /// One robot's credential; `None` if the robot is not registered, or was revoked.
    pub async fn broker_credential(
        &self,
        robot: &RobotId,
    ) -> Result<Option<BrokerCredential>, StoreError> {
        let row = sqlx::query(CREDENTIALS).bind(robot.as_str());
        row.fetch_optional(&self.reads).await?.as_ref().map(broker_credential).transpose()
    }

    /// The robots that should have `task`.
    pub async fn robots_with_task(&self, task: &TaskName) -> Result<Vec<RobotId>, StoreError> {
        let rows: Vec<String> =
            sqlx::query_scalar(WITH_TASK).bind(task.as_str()).fetch_all(&self.reads).await?;
        rows.iter().map(|row| id("assignments.robot_id", row)).collect()
    }

    /// The desired state of each of `robots`. Robots that are not registered, were revoked or wait
    /// for approval are left out.
    pub async fn desired_tasks(&self, robots: &[RobotId]) -> Result<Vec<DesiredTasks>, StoreError> {
        let mut found: Vec<DesiredTasks> = Vec::with_capacity(robots.len());
        for group in groups(robots) {
            // One statement, so that generation and tasks belong together.
            let sql = format!(
                "SELECT r.id, r.generation, r.observed_generation, r.settings, a.task, a.deployment_id, a.wanted, a.run, d.package,
                     a.phase, COALESCE(a.mechanism, d.delivery) AS mechanism, d.priority
                 FROM robots r
                 LEFT JOIN assignments a ON a.robot_id = r.id AND a.desired = 1
                 LEFT JOIN deployments d ON d.id = a.deployment_id
                 WHERE r.removed_at_ms IS NULL AND r.revoked_at_ms IS NULL AND r.awaits_approval = 0 AND r.id IN ({})
                 ORDER BY r.id, a.task",
                values(1, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for row in query.fetch_all(&self.reads).await? {
                let robot = id("robots.id", row.try_get("id")?)?;
                if found.last().is_none_or(|last| last.robot != robot) {
                    found.push(DesiredTasks {
                        robot,
                        generation: Generation(number(row.try_get("generation")?)),
                        observed_generation: Generation(number(
                            row.try_get("observed_generation")?,
                        )),
                        tasks: Vec::new(),
                        along: Vec::new(),
                        evidence: Evidence::default(),
                        settings: settings(&row)?.unwrap_or_default(),
                    });
                }
                if let (Some(last), Some(task)) = (found.last_mut(), desired_task(&row)?) {
                    if matches!(
                        Phase::from_text(row.try_get("phase")?),
                        Phase::Assigned | Phase::Fetching
                    ) {
                        last.along.extend(riding(&task));
                    }
                    last.tasks.push(task);
                }
            }
        }
        self.add_evidence(&mut found).await?;
        Ok(found)
    }

    /// The order by which `robot` may fetch the blob: the first one if there are several. `None` if
    /// the blob belongs to no package that the robot should have. An order adopted from a robot's
    /// report, which has no time limit, only counts if its package is here.
    pub async fn fetched_by(
        &self,
        robot: &RobotId,
        digest: &Digest,
    ) -> Result<Option<Arc<FetchedBy>>, StoreError> {
        if let Some(order) = self.access.fetched_by(robot, digest) {
            return Ok(Some(order));
        }
        let asked = self.access.ask();
        let rows = sqlx::query(
            "SELECT d.package, d.priority, d.number, r.labels FROM assignments a JOIN deployments d ON d.id = a.deployment_id
             JOIN robots r ON r.id = a.robot_id
             WHERE a.robot_id = $1 AND a.desired = 1
               AND (d.expires_at_ms > d.created_at_ms
                    OR EXISTS (SELECT 1 FROM packages p WHERE p.name = d.task AND p.package = d.package))
             ORDER BY d.priority DESC, d.number",
        )
        .bind(robot.as_str())
        .fetch_all(&self.reads)
        .await?;
        for row in rows {
            let package: PackageRef = from_json("deployments.package", row.try_get("package")?)?;
            if [package.manifest, package.config, package.content]
                .iter()
                .any(|blob| blob.digest == *digest)
            {
                let labels = from_json("robots.labels", row.try_get("labels")?)?;
                let (priority, number) = (priority(&row)?, number(row.try_get("number")?));
                let order = FetchedBy { priority, number, labels };
                return Ok(Some(self.access.remember_fetch(asked, robot, digest, order)));
            }
        }
        Ok(None)
    }
}

impl Write {
    /// The robots of a scope, including removed robots that were in it at their removal.
    pub async fn robots_ever_in(&mut self, scope: &Scope) -> Result<Vec<RobotId>, StoreError> {
        let rows = sqlx::query("SELECT id, name, mac, labels FROM robots")
            .fetch_all(self.connection())
            .await?;
        let robots = rows.iter().map(known_robot).collect::<Result<Vec<_>, _>>()?;
        let own =
            robots.into_iter().filter(|robot| scope.covers(&robot.id, &robot.name, &robot.labels));
        Ok(own.map(|robot| robot.id).collect())
    }

    /// The robots that should have `task`.
    pub async fn robots_with_task(&mut self, task: &TaskName) -> Result<Vec<RobotId>, StoreError> {
        let rows: Vec<String> =
            sqlx::query_scalar(WITH_TASK).bind(task.as_str()).fetch_all(self.connection()).await?;
        rows.iter().map(|row| id("assignments.robot_id", row)).collect()
    }

    /// The robot registered by `mac`.
    pub async fn robot_by_mac(
        &mut self,
        mac: &MacAddress,
    ) -> Result<Option<KnownRobot>, StoreError> {
        let row = sqlx::query(
            "SELECT id, name, mac, labels FROM robots WHERE removed_at_ms IS NULL AND mac = $1",
        )
        .bind(mac.to_string())
        .fetch_optional(self.connection())
        .await?;
        row.map(|row| known_robot(&row)).transpose()
    }

    /// The robot with this id or name.
    pub async fn known_robot(
        &mut self,
        id_or_name: &str,
    ) -> Result<Option<KnownRobot>, StoreError> {
        let row = sqlx::query(KNOWN_BY_ID_OR_NAME)
            .bind(id_or_name)
            .fetch_optional(self.connection())
            .await?;
        row.map(|row| known_robot(&row)).transpose()
    }

    /// The robots that a deployment is for.
    pub async fn robots_of_deployment(
        &mut self,
        deployment: &DeploymentId,
    ) -> Result<Vec<KnownRobot>, StoreError> {
        let of_deployment = "id IN (SELECT robot_id FROM assignments WHERE deployment_id = $1)";
        let rows = sqlx::query(AssertSqlSafe(format!("{KNOWN} AND {of_deployment}")))
            .bind(deployment.as_str())
            .fetch_all(self.connection())
            .await?;
        rows.iter().map(known_robot).collect()
    }

    pub async fn insert_robot(
        &mut self,
        robot: &KnownRobot,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query("INSERT INTO robots (id, name, mac, labels, enrolled_at_ms) VALUES ($1, $2, $3, $4, $5)")
            .bind(robot.id.as_str())
            .bind(robot.name.as_str())
            .bind(robot.mac.to_string())
            .bind(json(&robot.labels))
            .bind(stored(now_ms))
            .execute(self.connection())
            .await?;
        Ok(())
    }

    /// Stores a robot's name and labels.
    pub async fn update_robot(&mut self, robot: &KnownRobot) -> Result<(), StoreError> {
        sqlx::query("UPDATE robots SET name = $2, labels = $3 WHERE id = $1")
            .bind(robot.id.as_str())
            .bind(robot.name.as_str())
            .bind(json(&robot.labels))
            .execute(self.connection())
            .await?;
        Ok(())
    }

    /// Stores a robot's settings, if they differ from the stored ones. The settings are part of the
    /// desired state, so a change raises its generation.
    pub async fn update_settings(
        &mut self,
        robot: &RobotId,
        settings: &RobotSettings,
    ) -> Result<bool, StoreError> {
        let settings = Some(settings).filter(|settings| !settings.is_empty()).map(json);
        let changed = sqlx::query(
            "UPDATE robots SET settings = $2, generation = generation + 1
             WHERE id = $1 AND COALESCE(settings, '') <> COALESCE(CAST($2 AS TEXT), '')",
        )
        .bind(robot.as_str())
        .bind(settings)
        .execute(self.connection())
        .await?;
        Ok(changed.rows_affected() > 0)
    }

    /// Stores these robots' labels.
    pub async fn update_labels(&mut self, robots: &[&KnownRobot]) -> Result<(), StoreError> {
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id, labels) AS ({}) UPDATE robots SET labels = v.labels FROM v WHERE robots.id = v.id",
                values(1, group.len(), &["TEXT", "TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.id.as_str()).bind(json(&robot.labels));
            }
            query.execute(self.connection()).await?;
        }
        Ok(())
    }

    /// Forgets a robot's reports: the robot registers again, perhaps with an empty disk, and counts
    /// from 1.
    pub async fn forget_report(&mut self, robot: &RobotId) -> Result<(), StoreError> {
        sqlx::query(
            "UPDATE robots SET report_start = 0, report_seq = 0, observed_generation = 0, report = NULL,
                 link = NULL, battery = NULL WHERE id = $1",
        )
        .bind(robot.as_str())
        .execute(self.connection())
        .await?;
        Ok(())
    }

    /// Raises the number of a robot's password at an external broker.
    pub async fn renew_broker_credential(&mut self, robot: &RobotId) -> Result<(), StoreError> {
        sqlx::query("UPDATE robots SET broker_credential = broker_credential + 1 WHERE id = $1")
            .bind(robot.as_str())
            .execute(self.connection())
            .await?;
        Ok(())
    }

    /// Marks robots as removed. Their MAC addresses and names become free, their ids do not.
    pub async fn remove_robots(
        &mut self,
        robots: &[RobotId],
        now_ms: u64,
    ) -> Result<(), StoreError> {
        for group in groups(robots) {
            let sql = format!(
                "UPDATE robots SET removed_at_ms = $1, report = NULL WHERE id IN ({})",
                values(2, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            query.execute(self.connection()).await?;
        }
        Ok(())
    }
}

const CREDENTIALS: &str = "SELECT id, broker_credential FROM robots
     WHERE removed_at_ms IS NULL AND revoked_at_ms IS NULL AND (id = $1 OR $1 = '')";

const WITH_TASK: &str = "SELECT robot_id FROM assignments WHERE task = $1 AND desired = 1";

const ROBOT_ROWS: &str =
    "SELECT r.id, r.name, r.mac, r.labels, r.enrolled_at_ms, r.generation, r.observed_generation,
         r.report, r.link, r.last_seen_ms, r.revoked_at_ms, r.awaits_approval, r.settings
     FROM robots r WHERE r.removed_at_ms IS NULL";

/// The desired tasks of each robot, and the tasks that it is still removing. The first condition
/// repeats that of an index, word for word: without it all past orders would be read.
const TASK_ROWS: &str =
    "SELECT a.robot_id, a.task, a.deployment_id, a.wanted, a.run, a.phase, a.progress, a.failure,
         a.mechanism, a.rule, a.because, d.version
     FROM assignments a JOIN deployments d ON d.id = a.deployment_id
     WHERE (a.desired = 1 OR a.ended = 0) AND (a.desired = 1 OR a.released = 1)";

pub(in crate::store) fn known_robot(row: &sqlx::any::AnyRow) -> Result<KnownRobot, StoreError> {
    Ok(KnownRobot {
        id: id("robots.id", row.try_get("id")?)?,
        name: id("robots.name", row.try_get("name")?)?,
        mac: id("robots.mac", row.try_get("mac")?)?,
        labels: from_json("robots.labels", row.try_get("labels")?)?,
    })
}

fn broker_credential(row: &sqlx::any::AnyRow) -> Result<BrokerCredential, StoreError> {
    let number = number(row.try_get("broker_credential")?);
    Ok(BrokerCredential { robot: id("robots.id", row.try_get("id")?)?, number })
}

/// A robot's settings; `None` if there are none.
fn settings(row: &sqlx::any::AnyRow) -> Result<Option<RobotSettings>, StoreError> {
    from_optional_json("robots.settings", row.try_get("settings")?)
}

fn desired_task(row: &sqlx::any::AnyRow) -> Result<Option<DesiredTask>, StoreError> {
    let Some(task) = row.try_get::<Option<String>, _>("task")? else { return Ok(None) };
    Ok(Some(DesiredTask {
        task: id("assignments.task", &task)?,
        deployment: id("assignments.deployment_id", row.try_get("deployment_id")?)?,
        package: from_json("deployments.package", row.try_get("package")?)?,
        wanted: from_word("assignments.wanted", row.try_get("wanted")?)?,
        run: number(row.try_get("run")?),
        delivery: from_word("assignments.mechanism", row.try_get("mechanism")?)?,
        priority: priority(row)?,
    }))
}

/// The blobs of a task that are sent along with the state which orders it.
fn riding(task: &DesiredTask) -> Vec<BlobRef> {
    let PackageRef { config, content, .. } = task.package;
    match task.delivery {
        Delivery::Inline => vec![config, content],
        Delivery::DirectPush => vec![config],
        Delivery::PushPull | Delivery::Poll => Vec::new(),
    }
}

fn robot_views(
    robots: Vec<sqlx::any::AnyRow>,
    tasks: Vec<sqlx::any::AnyRow>,
    outdated: &HashSet<String>,
) -> Result<Vec<RobotView>, StoreError> {
    let mut tasks_of: HashMap<String, Vec<RobotTask>> = HashMap::new();
    for row in &tasks {
        let task = robot_task(row)?;
        let outdated = outdated.contains(task.deployment.as_str());
        tasks_of.entry(row.try_get("robot_id")?).or_default().push(RobotTask { outdated, ..task });
    }
    let mut views = Vec::with_capacity(robots.len());
    for row in &robots {
        let id: String = row.try_get("id")?;
        views.push(robot_view(row, tasks_of.remove(&id).unwrap_or_default())?);
    }
    views.sort_by(|one, other| one.name.cmp(&other.name));
    Ok(views)
}

fn robot_view(row: &sqlx::any::AnyRow, mut tasks: Vec<RobotTask>) -> Result<RobotView, StoreError> {
    let report: Option<Report> = from_optional_json("robots.report", row.try_get("report")?)?;
    let generation = Generation(number(row.try_get("generation")?));
    let observed_generation = Generation(number(row.try_get("observed_generation")?));
    let mut conditions = Vec::new();
    if row.try_get::<Option<i64>, _>("revoked_at_ms")?.is_some() {
        let text = "its tokens have ended; it comes back with an enrolment token made for it, or is removed".to_owned();
        conditions.push(Condition { code: "revoked".to_owned(), text });
    }
    if row.try_get::<i64, _>("awaits_approval")? != 0 {
        let text =
            "it gets nothing until an administrator approves it (taskd robot approve)".to_owned();
        conditions.push(Condition { code: AWAITS_APPROVAL.to_owned(), text });
    }
    if observed_generation > generation {
        let text = format!(
            "it has come to generation {observed_generation}, this server to {generation}; left alone until its next order"
        );
        conditions.push(Condition { code: "diverged".to_owned(), text });
    }
    let (mut host, mut effective_settings, mut reported) = (None, None, Vec::new());
    if let Some(mut report) = report {
        conditions.extend(report.conditions);
        effective_settings = report.host.settings.take();
        host = Some(report.host);
        reported = report.tasks;
    }
    tasks.sort_by(|one, other| one.task.cmp(&other.task));
    for task in &mut tasks {
        if let Some(said) = reported.iter_mut().find(|said| said.task == task.task) {
            task.active = said.active.take();
            task.degraded = said.degraded.take().filter(|_| said.deployment == task.deployment);
            task.restarts = if said.deployment == task.deployment { said.restarts } else { 0 };
        }
    }
    Ok(RobotView {
        id: id("robots.id", row.try_get("id")?)?,
        name: id("robots.name", row.try_get("name")?)?,
        mac: id("robots.mac", row.try_get("mac")?)?,
        labels: from_json("robots.labels", row.try_get("labels")?)?,
        online: false,
        address: None,
        last_seen_ms: row.try_get::<Option<i64>, _>("last_seen_ms")?.map(number),
        enrolled_at_ms: number(row.try_get("enrolled_at_ms")?),
        generation,
        observed_generation,
        conditions,
        host,
        link: from_optional_json("robots.link", row.try_get("link")?)?,
        tasks,
        mqtt: None,
        vitals: None,
        settings: settings(row)?,
        effective_settings,
    })
}

fn robot_task(row: &sqlx::any::AnyRow) -> Result<RobotTask, StoreError> {
    Ok(RobotTask {
        task: id("assignments.task", row.try_get("task")?)?,
        version: id("deployments.version", row.try_get("version")?)?,
        deployment: id("assignments.deployment_id", row.try_get("deployment_id")?)?,
        wanted: from_word("assignments.wanted", row.try_get("wanted")?)?,
        run: number(row.try_get("run")?),
        delivery: deliveries::decision(row)?,
        phase: Phase::from_text(row.try_get("phase")?),
        progress: from_optional_json("assignments.progress", row.try_get("progress")?)?,
        failure: from_optional_json("assignments.failure", row.try_get("failure")?)?,
        degraded: None,
        active: None,
        outdated: false,
        restarts: 0,
    })
}
