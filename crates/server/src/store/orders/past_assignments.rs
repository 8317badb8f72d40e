//! Earlier orders that matter for the next one: unsuccessful assignments, and the packages that ran
//! before the present ones.

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::desired::PackageRef;
use task_proto::messages::report::Failure;
use task_proto::packages::manifest::TaskKind;
use task_proto::{DeploymentId, RobotId, TaskName};

use crate::store::fleet::robots::known_robot;
use crate::store::repositories::Assignments;
use crate::store::rows::{from_json, from_optional_json, from_word, groups, id, values};
use crate::store::{KnownRobot, StoreError, Transaction};

/// A robot on which a deployment has ended without success: failed, expired or cancelled, for
/// example.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnsuccessfulRobot {
    pub robot: KnownRobot,
    /// The cause, if the deployment failed there.
    pub failure: Option<Failure>,
}

/// A robot's earlier package.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PreviousPackage {
    pub robot: RobotId,
    /// The package, which is still stored.
    pub package: PackageRef,
    /// Whether the task is a service or a job.
    pub kind: TaskKind,
}

impl Assignments<&mut Transaction> {
    /// The robots on which `deployment` has ended without success, sorted by name. Robots with a
    /// later order for the task, including one to stop or remove it, are left out.
    pub async fn unsuccessful(
        &mut self,
        deployment: &DeploymentId,
    ) -> Result<Vec<UnsuccessfulRobot>, StoreError> {
        let rows = sqlx::query(
            "SELECT r.id, r.name, r.mac, r.labels, a.failure
             FROM assignments a JOIN deployments d ON d.id = a.deployment_id JOIN robots r ON r.id = a.robot_id
             WHERE a.deployment_id = $1 AND a.superseded_by IS NULL
               AND a.phase IN ('failed', 'rolled_back', 'unmet', 'expired', 'cancelled') AND a.wanted = 'running'
               AND r.removed_at_ms IS NULL AND r.awaits_approval = 0
               AND NOT EXISTS (
                   SELECT 1 FROM assignments newer JOIN deployments ordered ON ordered.id = newer.deployment_id
                   WHERE newer.robot_id = a.robot_id AND newer.task = a.task AND ordered.number > d.number)",
        )
        .bind(deployment.as_str())
        .fetch_all(self.0.connection())
        .await?;
        let read = |row: &sqlx::any::AnyRow| {
            let failure = from_optional_json("assignments.failure", row.try_get("failure")?)?;
            Ok::<_, StoreError>(UnsuccessfulRobot { robot: known_robot(row)?, failure })
        };
        let mut found = rows.iter().map(read).collect::<Result<Vec<_>, _>>()?;
        found.sort_by(|one, other| one.robot.name.cmp(&other.robot.name));
        Ok(found)
    }

    /// For each of `robots`, the newest package of `task` that ran there before the desired one,
    /// differs from it, and is still stored. Robots without such a package are left out.
    pub async fn previous_packages(
        &mut self,
        task: &TaskName,
        robots: &[RobotId],
    ) -> Result<Vec<PreviousPackage>, StoreError> {
        let mut found = Vec::new();
        for group in groups(robots) {
            // The same package has the same text.
            let sql = format!(
                "WITH v (id) AS ({})
                 SELECT v.id AS robot, d.package, d.kind
                 FROM v JOIN assignments now ON now.robot_id = v.id AND now.task = $1 AND now.desired = 1
                 JOIN deployments present ON present.id = now.deployment_id
                 JOIN deployments d ON d.id = (
                     SELECT older.id FROM assignments a JOIN deployments older ON older.id = a.deployment_id
                     WHERE a.robot_id = v.id AND a.task = $1 AND a.ran = 1 AND older.number < present.number
                       AND older.package <> present.package
                       AND EXISTS (SELECT 1 FROM packages p WHERE p.name = $1 AND p.package = older.package)
                     ORDER BY older.number DESC LIMIT 1)",
                values(2, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(task.as_str());
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for row in query.fetch_all(self.0.connection()).await? {
                let package: PackageRef =
                    from_json("deployments.package", row.try_get("package")?)?;
                let kind = from_word("deployments.kind", row.try_get("kind")?)?;
                found.push(PreviousPackage {
                    robot: id("robots.id", row.try_get("robot")?)?,
                    package,
                    kind,
                });
            }
        }
        Ok(found)
    }
}
