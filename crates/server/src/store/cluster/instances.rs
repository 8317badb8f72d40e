//! The agents of each robot that displaced each other, as any server has seen them. The column is
//! written without the lock of orders, which never read it.

use task_proto::RobotId;

use crate::domain::instance_history::InstanceHistory;
use crate::store::repositories::RobotSessions;
use crate::store::rows::{from_optional_json, json};
use crate::store::{Store, StoreError};

impl RobotSessions<&Store> {
    /// Changes the robot's history. `change` returns whether it did, and is called again if another
    /// server was faster. Returns the history as stored.
    pub async fn change_instances(
        self,
        robot: &RobotId,
        change: impl Fn(&mut InstanceHistory) -> bool,
    ) -> Result<InstanceHistory, StoreError> {
        loop {
            let found: Option<Option<String>> =
                sqlx::query_scalar("SELECT instances FROM robots WHERE id = $1")
                    .bind(robot.as_str())
                    .fetch_optional(&self.0.cluster_writes)
                    .await?;
            let Some(stored) = found else { return Ok(InstanceHistory::default()) };
            let mut history: InstanceHistory =
                from_optional_json("robots.instances", stored.clone())?.unwrap_or_default();
            if !change(&mut history) {
                return Ok(history);
            }
            let updated = sqlx::query(
                "UPDATE robots SET instances = $2
                 WHERE id = $1 AND COALESCE(instances, '') = $3",
            )
            .bind(robot.as_str())
            .bind(json(&history))
            .bind(stored.as_deref().unwrap_or(""))
            .execute(&self.0.cluster_writes)
            .await?;
            if updated.rows_affected() == 1 {
                return Ok(history);
            }
        }
    }
}
