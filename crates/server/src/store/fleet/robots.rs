//! Robots: their identities, their rows in lists, and their desired states.

use std::collections::{BTreeSet, HashMap, HashSet};

use serde::{Deserialize, Serialize};
use sqlx::{AssertSqlSafe, Row as _};
use task_proto::api::RobotTask;
use task_proto::desired::settings::RobotSettings;
use task_proto::desired::{BlobRef, Delivery, DesiredTask, Evidence, PackageRef, RobotDescription};
use task_proto::ids::Labels;
use task_proto::messages::report::{Condition, HostFacts, LinkFacts, Phase, Report, TaskReport};
use task_proto::{DeploymentId, Digest, Generation, MacAddress, RobotId, RobotName, TaskName};

use crate::domain::instance_history::InstanceHistory;
use crate::domain::person::Scope;
use crate::store::deliveries;
use crate::store::repositories::Robots;
use crate::store::rows::{
    from_json, from_optional_json, from_word, groups, id, json, number, priority, stored, values,
};
use crate::store::{Store, StoreError, Transaction};

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct KnownRobot {
    pub id: RobotId,
    pub name: RobotName,
    /// The MAC address of its registration.
    pub mac: MacAddress,
    pub labels: Labels,
}

/// A registered robot with its tasks and its last report.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotRow {
    pub robot: KnownRobot,
    /// Time of the last report.
    pub last_seen_ms: Option<u64>,
    pub enrolled_at_ms: u64,
    pub generation: Generation,
    pub observed_generation: Generation,
    pub is_revoked: bool,
    pub awaits_approval: bool,
    /// The conditions that the robot reported.
    pub conditions: Vec<Condition>,
    pub host: Option<HostFacts>,
    pub link: Option<LinkFacts>,
    /// The tasks, sorted by name.
    pub tasks: Vec<RobotTask>,
    pub settings: Option<RobotSettings>,
    /// The agents that displaced each other, as the servers of a cluster have seen them.
    pub instances: Option<InstanceHistory>,
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
    pub bundled_blobs: Vec<BlobRef>,
    /// The publishers' signed documents on these tasks' packages, and on those that the robot goes
    /// back to if they do not get ready.
    pub evidence: Evidence,
    pub settings: RobotSettings,
    pub description: RobotDescription,
}

pub(in crate::store) const KNOWN: &str =
    "SELECT id, name, mac, labels FROM robots WHERE removed_at_ms IS NULL";

/// A robot's generation after a change of its name or labels.
const NEXT_WITH_LABELS: &str =
    "generation + CASE WHEN generation > 0 AND observed_generation <= generation THEN 1 ELSE 0 END";

const KNOWN_BY_ID_OR_NAME: &str = "SELECT id, name, mac, labels FROM robots WHERE removed_at_ms IS NULL AND (id = $1 OR name = $1)";

impl Robots<&Store> {
    /// The robots of a scope, sorted by name.
    pub async fn list(self, scope: &Scope) -> Result<Vec<RobotRow>, StoreError> {
        if !scope.is_everything() {
            return self.among(&self.ids_in(scope).await?).await;
        }
        // The tasks first: no phase stands beside a report that is older than the phase.
        let tasks = sqlx::query(TASK_ROWS).fetch_all(&self.0.reads).await?;
        let robots = sqlx::query(ROBOT_ROWS).fetch_all(&self.0.reads).await?;
        robot_rows(&robots, &tasks, &self.0.deployments().outdated().await?)
    }

    /// Those of `robots` that are registered, sorted by name.
    pub async fn among(self, robots: &[RobotId]) -> Result<Vec<RobotRow>, StoreError> {
        let mut rows: Vec<RobotRow> = Vec::with_capacity(robots.len());
        let outdated = self.0.deployments().outdated().await?;
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
            let tasks = tasks.fetch_all(&self.0.reads).await?;
            rows.extend(robot_rows(&robots.fetch_all(&self.0.reads).await?, &tasks, &outdated)?);
        }
        rows.sort_by(|one, other| one.robot.name.cmp(&other.robot.name));
        Ok(rows)
    }

    /// One robot; `None` if there is none or the robot was removed.
    pub async fn get(self, robot: &RobotId) -> Result<Option<RobotRow>, StoreError> {
        Ok(self.among(std::slice::from_ref(robot)).await?.pop())
    }

    /// The robot with this id or name.
    pub async fn find(self, id_or_name: &str) -> Result<Option<KnownRobot>, StoreError> {
        let row =
            sqlx::query(KNOWN_BY_ID_OR_NAME).bind(id_or_name).fetch_optional(&self.0.reads).await?;
        row.map(|row| known_robot(&row)).transpose()
    }

    /// The robots of a scope, with the measured facts of their links.
    pub async fn with_links(
        self,
        scope: &Scope,
    ) -> Result<Vec<(KnownRobot, Option<LinkFacts>)>, StoreError> {
        let rows = self.in_scope("r.id, r.name, r.mac, r.labels, r.link", scope).await?;
        let read = |row: &sqlx::any::AnyRow| {
            Ok((known_robot(row)?, from_optional_json("robots.link", row.try_get("link")?)?))
        };
        rows.iter().map(read).collect()
    }

    /// The robots of a scope.
    pub async fn known(self, scope: &Scope) -> Result<Vec<KnownRobot>, StoreError> {
        let rows = self.in_scope("r.id, r.name, r.mac, r.labels", scope).await?;
        rows.iter().map(known_robot).collect()
    }

    pub async fn ids(self) -> Result<Vec<RobotId>, StoreError> {
        let known = "SELECT id FROM robots WHERE removed_at_ms IS NULL";
        let rows: Vec<String> = sqlx::query_scalar(known).fetch_all(&self.0.reads).await?;
        rows.iter().map(|row| id("robots.id", row)).collect()
    }

    /// The robots' credentials at an external broker, sorted by robot. Revoked robots and robots
    /// that wait for approval have none there.
    pub async fn broker_credentials(self) -> Result<Vec<BrokerCredential>, StoreError> {
        let approved = format!("{CREDENTIALS} AND awaits_approval = 0 ORDER BY id");
        let rows = sqlx::query(AssertSqlSafe(approved)).bind("");
        rows.fetch_all(&self.0.reads).await?.iter().map(broker_credential).collect()
    }

    /// One robot's credential; `None` if the robot is not registered, or was revoked.
    pub async fn broker_credential(
        self,
        robot: &RobotId,
    ) -> Result<Option<BrokerCredential>, StoreError> {
        let row = sqlx::query(CREDENTIALS).bind(robot.as_str());
        row.fetch_optional(&self.0.reads).await?.as_ref().map(broker_credential).transpose()
    }

    /// The robots that should have this version of the package.
    pub async fn with_package(
        self,
        name: &TaskName,
        manifest: &Digest,
    ) -> Result<Vec<RobotId>, StoreError> {
        let rows: Vec<String> = sqlx::query_scalar(
            "SELECT DISTINCT a.robot_id FROM assignments a JOIN deployments d ON d.id = a.deployment_id
             WHERE a.desired = 1 AND d.task = $1 AND d.package LIKE $2",
        )
        .bind(name.as_str())
        .bind(format!("%\"{manifest}\"%"))
        .fetch_all(&self.0.reads)
        .await?;
        rows.iter().map(|row| id("assignments.robot_id", row)).collect()
    }

    /// The desired state of each of `robots`. Robots that are not registered, were revoked or wait
    /// for approval are left out.
    pub async fn desired_tasks(self, robots: &[RobotId]) -> Result<Vec<DesiredTasks>, StoreError> {
        let mut found: Vec<DesiredTasks> = Vec::with_capacity(robots.len());
        let mut may_go_back = BTreeSet::new();
        for group in groups(robots) {
            // One statement, so that generation and tasks belong together.
            let sql = format!(
                "SELECT r.id, r.name, r.labels, r.generation, r.observed_generation, r.settings, a.task, a.deployment_id, a.wanted, a.run, d.package,
                     a.ran, a.phase, COALESCE(a.mechanism, d.delivery) AS mechanism, d.priority
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
            for row in query.fetch_all(&self.0.reads).await? {
                let robot = id("robots.id", row.try_get("id")?)?;
                if found.last().is_none_or(|last| last.robot != robot) {
                    found.push(DesiredTasks {
                        robot,
                        generation: Generation(number(row.try_get("generation")?)),
                        observed_generation: Generation(number(
                            row.try_get("observed_generation")?,
                        )),
                        tasks: Vec::new(),
                        bundled_blobs: Vec::new(),
                        evidence: Evidence::default(),
                        settings: settings(&row)?.unwrap_or_default(),
                        description: RobotDescription {
                            name: Some(id("robots.name", row.try_get("name")?)?),
                            labels: from_json("robots.labels", row.try_get("labels")?)?,
                        },
                    });
                }
                if let (Some(last), Some(task)) = (found.last_mut(), desired_task(&row)?) {
                    if matches!(
                        Phase::from_text(row.try_get("phase")?),
                        Phase::Assigned | Phase::Fetching
                    ) {
                        last.bundled_blobs.extend(bundled_blobs_of(&task));
                    }
                    if row.try_get::<i64, _>("ran")? == 0 {
                        may_go_back.insert(last.robot.clone());
                    }
                    last.tasks.push(task);
                }
            }
        }
        let may_go_back: Vec<RobotId> = may_go_back.into_iter().collect();
        let proven = self.proven_packages(&may_go_back).await?;
        self.0.publishers().add_evidence(&mut found, &proven).await?;
        Ok(found)
    }
}

impl Robots<&mut Transaction> {
    /// The robot registered by `mac`.
    pub async fn find_by_mac(
        &mut self,
        mac: &MacAddress,
    ) -> Result<Option<KnownRobot>, StoreError> {
        let row = sqlx::query(
            "SELECT id, name, mac, labels FROM robots WHERE removed_at_ms IS NULL AND mac = $1",
        )
        .bind(mac.to_string())
        .fetch_optional(self.0.connection())
        .await?;
        row.map(|row| known_robot(&row)).transpose()
    }

    /// The robot with this id or name.
    pub async fn find(&mut self, id_or_name: &str) -> Result<Option<KnownRobot>, StoreError> {
        let row = sqlx::query(KNOWN_BY_ID_OR_NAME)
            .bind(id_or_name)
            .fetch_optional(self.0.connection())
            .await?;
        row.map(|row| known_robot(&row)).transpose()
    }

    /// The robots that a deployment is for.
    pub async fn of_deployment(
        &mut self,
        deployment: &DeploymentId,
    ) -> Result<Vec<KnownRobot>, StoreError> {
        let of_deployment = "id IN (SELECT robot_id FROM assignments WHERE deployment_id = $1)";
        let rows = sqlx::query(AssertSqlSafe(format!("{KNOWN} AND {of_deployment}")))
            .bind(deployment.as_str())
            .fetch_all(self.0.connection())
            .await?;
        rows.iter().map(known_robot).collect()
    }

    pub async fn insert(&mut self, robot: &KnownRobot, now_ms: u64) -> Result<(), StoreError> {
        sqlx::query("INSERT INTO robots (id, name, mac, labels, enrolled_at_ms) VALUES ($1, $2, $3, $4, $5)")
            .bind(robot.id.as_str())
            .bind(robot.name.as_str())
            .bind(robot.mac.to_string())
            .bind(json(&robot.labels))
            .bind(stored(now_ms))
            .execute(self.0.connection())
            .await?;
        self.index_labels(&[robot]).await
    }

    /// Stores a robot's name and labels. They are part of the desired state, so a change raises its
    /// generation, except before the first order and for a diverged robot: its tasks are unknown
    /// until the next order.
    pub async fn update(&mut self, robot: &KnownRobot) -> Result<(), StoreError> {
        let sql = format!(
            "UPDATE robots SET name = $2, labels = $3, generation = {NEXT_WITH_LABELS} WHERE id = $1"
        );
        sqlx::query(AssertSqlSafe(sql))
            .bind(robot.id.as_str())
            .bind(robot.name.as_str())
            .bind(json(&robot.labels))
            .execute(self.0.connection())
            .await?;
        self.index_labels(&[robot]).await
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
        .execute(self.0.connection())
        .await?;
        Ok(changed.rows_affected() > 0)
    }

    /// Raises the generations of robots whose desired state has changed.
    pub(in crate::store) async fn raise_generations(
        &mut self,
        robots: &[RobotId],
    ) -> Result<(), StoreError> {
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id) AS ({}) UPDATE robots SET generation = generation + 1 FROM v WHERE robots.id = v.id",
                values(1, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }

    /// Stores these robots' labels, which are other ones than before, as [`Self::update`] does.
    pub async fn update_labels(&mut self, robots: &[&KnownRobot]) -> Result<(), StoreError> {
        for group in groups(robots) {
            let sql = format!(
                "WITH v (id, labels) AS ({}) UPDATE robots SET labels = v.labels, generation = {NEXT_WITH_LABELS} FROM v WHERE robots.id = v.id",
                values(1, group.len(), &["TEXT", "TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.id.as_str()).bind(json(&robot.labels));
            }
            query.execute(self.0.connection()).await?;
        }
        self.index_labels(robots).await
    }

    /// Makes the rows by which selectors find these robots those of their stored labels.
    async fn index_labels(&mut self, robots: &[&KnownRobot]) -> Result<(), StoreError> {
        let ids = json(&robots.iter().map(|robot| &robot.id).collect::<Vec<_>>());
        let (texts, labels) = (self.0.dialect.texts(1), self.0.dialect.labels);
        for sql in [
            format!("DELETE FROM robot_labels WHERE robot_id IN ({texts})"),
            format!(
                "INSERT INTO robot_labels (robot_id, key, value)
                 SELECT r.id, label.key, label.value FROM robots r CROSS JOIN {labels} AS label
                 WHERE r.id IN ({texts})"
            ),
        ] {
            sqlx::query(AssertSqlSafe(sql)).bind(&ids).execute(self.0.connection()).await?;
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
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Raises the number of a robot's password at an external broker.
    pub async fn renew_broker_credential(&mut self, robot: &RobotId) -> Result<(), StoreError> {
        sqlx::query("UPDATE robots SET broker_credential = broker_credential + 1 WHERE id = $1")
            .bind(robot.as_str())
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    /// Marks robots as removed. Their MAC addresses and names become free, their ids do not.
    pub async fn remove(&mut self, robots: &[RobotId], now_ms: u64) -> Result<(), StoreError> {
        for group in groups(robots) {
            let sql = format!(
                "UPDATE robots SET removed_at_ms = $1, report = NULL WHERE id IN ({})",
                values(2, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }
}

const CREDENTIALS: &str = "SELECT id, broker_credential FROM robots
     WHERE removed_at_ms IS NULL AND revoked_at_ms IS NULL AND (id = $1 OR $1 = '')";

const ROBOT_ROWS: &str =
    "SELECT r.id, r.name, r.mac, r.labels, r.enrolled_at_ms, r.generation, r.observed_generation,
         r.report, r.link, r.last_seen_ms, r.revoked_at_ms, r.awaits_approval, r.settings, r.instances
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
fn bundled_blobs_of(task: &DesiredTask) -> Vec<BlobRef> {
    let PackageRef { config, content, .. } = task.package;
    match task.delivery {
        Delivery::Inline => vec![config, content],
        Delivery::DirectPush => vec![config],
        Delivery::PushPull | Delivery::Poll => Vec::new(),
    }
}

fn robot_rows(
    robots: &[sqlx::any::AnyRow],
    tasks: &[sqlx::any::AnyRow],
    outdated: &HashSet<String>,
) -> Result<Vec<RobotRow>, StoreError> {
    let mut tasks_of: HashMap<&str, Vec<&sqlx::any::AnyRow>> = HashMap::new();
    for row in tasks {
        tasks_of.entry(row.try_get("robot_id")?).or_default().push(row);
    }
    let mut rows = Vec::with_capacity(robots.len());
    for row in robots {
        let tasks = tasks_of.remove(row.try_get::<&str, _>("id")?).unwrap_or_default();
        rows.push(robot_row(row, &tasks, outdated)?);
    }
    rows.sort_by(|one, other| one.robot.name.cmp(&other.robot.name));
    Ok(rows)
}

fn robot_row(
    row: &sqlx::any::AnyRow,
    tasks: &[&sqlx::any::AnyRow],
    outdated: &HashSet<String>,
) -> Result<RobotRow, StoreError> {
    let report: Option<Report> = from_optional_json("robots.report", row.try_get("report")?)?;
    let (conditions, host, mut reported) = match report {
        Some(Report { conditions, host, tasks, .. }) => (conditions, Some(host), tasks),
        None => (Vec::new(), None, Vec::new()),
    };
    let mut tasks = tasks
        .iter()
        .map(|task| robot_task(task, &mut reported, outdated))
        .collect::<Result<Vec<_>, _>>()?;
    tasks.sort_by(|one, other| one.task.cmp(&other.task));
    Ok(RobotRow {
        robot: known_robot(row)?,
        last_seen_ms: row.try_get::<Option<i64>, _>("last_seen_ms")?.map(number),
        enrolled_at_ms: number(row.try_get("enrolled_at_ms")?),
        generation: Generation(number(row.try_get("generation")?)),
        observed_generation: Generation(number(row.try_get("observed_generation")?)),
        is_revoked: row.try_get::<Option<i64>, _>("revoked_at_ms")?.is_some(),
        awaits_approval: row.try_get::<i64, _>("awaits_approval")? != 0,
        conditions,
        host,
        link: from_optional_json("robots.link", row.try_get("link")?)?,
        tasks,
        settings: settings(row)?,
        instances: from_optional_json("robots.instances", row.try_get("instances")?)?,
    })
}

/// A task as ordered, with the robot's report on it.
fn robot_task(
    row: &sqlx::any::AnyRow,
    reported: &mut [TaskReport],
    outdated: &HashSet<String>,
) -> Result<RobotTask, StoreError> {
    let task: TaskName = id("assignments.task", row.try_get("task")?)?;
    let deployment: DeploymentId = id("assignments.deployment_id", row.try_get("deployment_id")?)?;
    let mut report = reported.iter_mut().find(|report| report.task == task);
    let active = report.as_mut().and_then(|report| report.active.take());
    // The rest of a report on another deployment says nothing about this one.
    let report = report.filter(|report| report.deployment == deployment);
    let (degraded, restarts) =
        report.map_or((None, 0), |report| (report.degraded.take(), report.restarts));
    Ok(RobotTask {
        version: id("deployments.version", row.try_get("version")?)?,
        wanted: from_word("assignments.wanted", row.try_get("wanted")?)?,
        run: number(row.try_get("run")?),
        delivery: deliveries::decision(row)?,
        phase: Phase::from_text(row.try_get("phase")?),
        progress: from_optional_json("assignments.progress", row.try_get("progress")?)?,
        failure: from_optional_json("assignments.failure", row.try_get("failure")?)?,
        degraded,
        active,
        outdated: outdated.contains(deployment.as_str()),
        restarts,
        task,
        deployment,
    })
}
