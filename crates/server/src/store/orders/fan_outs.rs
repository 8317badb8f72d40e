//! Direct-push: the robots that still wait for a package inside MQTT messages, and those that are
//! to pull the package instead.

use sqlx::AssertSqlSafe;
use task_proto::desired::{Delivery, PackageRef};
use task_proto::{DeploymentId, Digest, RobotId};

use crate::store::repositories::FanOuts;
use crate::store::rows::{deployment_robot_pairs, from_json, groups, id, stored, values};
use crate::store::{Store, StoreError, Transaction};

/// Assignments of robots that receive the package in parts and still miss some. Diverged robots
/// are left alone.
const AWAITING: &str = "assignments.mechanism = 'direct-push' AND assignments.desired = 1
    AND assignments.released = 1 AND assignments.ended = 0 AND assignments.phase IN ('assigned', 'fetching')
    AND EXISTS (SELECT 1 FROM robots r WHERE r.id = assignments.robot_id AND r.removed_at_ms IS NULL
                    AND r.observed_generation <= r.generation)";

impl FanOuts<&Store> {
    /// The deployments with robots that wait for parts, the most urgent first.
    pub async fn list(self) -> Result<Vec<(DeploymentId, PackageRef)>, StoreError> {
        let rows: Vec<(String, String)> = sqlx::query_as(AssertSqlSafe(format!(
            "SELECT d.id, d.package FROM deployments d
             WHERE d.id IN (SELECT assignments.deployment_id FROM assignments WHERE {AWAITING})
             ORDER BY d.priority DESC, d.number"
        )))
        .fetch_all(&self.0.reads)
        .await?;
        let read = |(deployment, package): &(String, String)| {
            Ok((id("deployments.id", deployment)?, from_json("deployments.package", package)?))
        };
        rows.iter().map(read).collect()
    }

    /// The robots that wait for parts of `content`, with their deployments.
    pub async fn awaiting_parts(
        self,
        content: &Digest,
    ) -> Result<Vec<(DeploymentId, RobotId)>, StoreError> {
        let mut awaiting = Vec::new();
        for (deployment, package) in self.list().await? {
            if package.content.digest != *content {
                continue;
            }
            let robots: Vec<String> = sqlx::query_scalar(AssertSqlSafe(format!(
                "SELECT robot_id FROM assignments WHERE deployment_id = $1 AND {AWAITING} ORDER BY place"
            )))
            .bind(deployment.as_str())
            .fetch_all(&self.0.reads)
            .await?;
            for robot in robots {
                awaiting.push((deployment.clone(), id("assignments.robot_id", &robot)?));
            }
        }
        Ok(awaiting)
    }
}

impl FanOuts<&mut Transaction> {
    /// Changes the delivery decision for those of `parts` that still wait for parts: they pull, by
    /// `rule`, `because`. Returns the robots with a new desired state.
    pub async fn pull_instead(
        &mut self,
        parts: &[(DeploymentId, RobotId)],
        rule: &str,
        because: &str,
        now_ms: u64,
    ) -> Result<Vec<(DeploymentId, RobotId)>, StoreError> {
        let mut changed: Vec<(DeploymentId, RobotId)> = Vec::new();
        for group in groups(parts) {
            let sql = format!(
                "WITH v (deployment_id, robot_id) AS ({})
                 UPDATE assignments SET mechanism = $1, rule = $2, because = $3, updated_at_ms = $4
                 FROM v WHERE assignments.deployment_id = v.deployment_id AND assignments.robot_id = v.robot_id
                     AND {AWAITING}
                 RETURNING assignments.deployment_id, assignments.robot_id",
                values(5, group.len(), &["TEXT", "TEXT"])
            );
            let mut query = sqlx::query_as(AssertSqlSafe(sql))
                .bind(Delivery::PushPull.as_str())
                .bind(rule)
                .bind(because)
                .bind(stored(now_ms));
            for (deployment, robot) in group {
                query = query.bind(deployment.as_str()).bind(robot.as_str());
            }
            changed.extend(deployment_robot_pairs(query.fetch_all(self.0.connection()).await?)?);
        }
        let robots: Vec<RobotId> = changed.iter().map(|(_, robot)| robot.clone()).collect();
        self.0.robots().raise_generations(&robots).await?;
        Ok(changed)
    }
}
