//! The packages that robots need: those that they should have, and those that they go back to if
//! these fail. Decides which blobs a robot may fetch, never when.

use std::collections::HashMap;
use std::sync::Arc;

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::desired::PackageRef;
use task_proto::ids::Labels;
use task_proto::{Digest, RobotId};

use crate::store::repositories::Robots;
use crate::store::rows::{from_json, groups, id, number, priority, values};
use crate::store::{Store, StoreError};

/// The order for which a robot fetches a blob.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FetchGrant {
    pub priority: i32,
    /// The deployment's number: a later deployment has a higher one.
    pub number: u64,
    pub labels: Labels,
}

/// The start of a statement about the needed assignments of some robots, whose ids are the first
/// parameters.
fn with_needed(robots: usize) -> String {
    with_needed_where(&format!("desired = 1 AND robot_id IN ({})", values(1, robots, &["TEXT"])))
}

/// The start of a statement about needed assignments: those that meet the condition and, for each
/// that has not run, those that it has replaced, down to one that ran. The robot goes back to that
/// one if none of the later ones gets ready.
pub(in crate::store) fn with_needed_where(condition: &str) -> String {
    format!(
        "WITH RECURSIVE needed (robot_id, deployment_id, previous, ran) AS (
             SELECT robot_id, deployment_id, previous, ran FROM assignments
             WHERE {condition}
             UNION
             SELECT older.robot_id, older.deployment_id, older.previous, older.ran
             FROM needed newer
             JOIN assignments older ON older.deployment_id = newer.previous AND older.robot_id = newer.robot_id
             WHERE newer.ran = 0)"
    )
}

impl Robots<&Store> {
    /// The order by which `robot` may fetch the blob: the first one if there are several. `None` if
    /// the robot needs no package with the blob. An order adopted from a robot's report, which has
    /// no time limit, only counts if its package is here. Once a package runs, the one before it is
    /// granted for some seconds more: reports do not clear the cache.
    pub async fn fetch_grant(
        self,
        robot: &RobotId,
        digest: &Digest,
    ) -> Result<Option<Arc<FetchGrant>>, StoreError> {
        if let Some(order) = self.0.auth_cache.fetch_grant(robot, digest) {
            return Ok(Some(order));
        }
        let epoch = self.0.auth_cache.epoch();
        let sql = format!(
            "{} SELECT d.package, d.priority, d.number, r.labels
             FROM needed JOIN deployments d ON d.id = needed.deployment_id JOIN robots r ON r.id = needed.robot_id
             WHERE d.expires_at_ms > d.created_at_ms
                OR EXISTS (SELECT 1 FROM packages p WHERE p.name = d.task AND p.package = d.package)
             ORDER BY d.priority DESC, d.number",
            with_needed(1)
        );
        let query = sqlx::query(AssertSqlSafe(sql)).bind(robot.as_str());
        for row in query.fetch_all(&self.0.reads).await? {
            let package: PackageRef = from_json("deployments.package", row.try_get("package")?)?;
            if [package.manifest, package.config, package.content]
                .iter()
                .any(|blob| blob.digest == *digest)
            {
                let labels = from_json("robots.labels", row.try_get("labels")?)?;
                let (priority, number) = (priority(&row)?, number(row.try_get("number")?));
                let order = FetchGrant { priority, number, labels };
                return Ok(Some(self.0.auth_cache.cache_fetch_grant(epoch, robot, digest, order)));
            }
        }
        Ok(None)
    }

    /// The manifests of the needed packages that have run on `robots`.
    pub(in crate::store) async fn proven_packages(
        self,
        robots: &[RobotId],
    ) -> Result<HashMap<RobotId, Vec<Digest>>, StoreError> {
        let mut proven: HashMap<RobotId, Vec<Digest>> = HashMap::new();
        for group in groups(robots) {
            let sql = format!(
                "{} SELECT needed.robot_id, d.package
                 FROM needed JOIN deployments d ON d.id = needed.deployment_id
                 WHERE needed.ran = 1 ORDER BY d.number",
                with_needed(group.len())
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            for row in query.fetch_all(&self.0.reads).await? {
                let robot = id("assignments.robot_id", row.try_get("robot_id")?)?;
                let package: PackageRef =
                    from_json("deployments.package", row.try_get("package")?)?;
                proven.entry(robot).or_default().push(package.manifest.digest);
            }
        }
        Ok(proven)
    }
}
