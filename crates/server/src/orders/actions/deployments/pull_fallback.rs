//! The server's own order to robots that fell behind in a fan-out: pull.

use task_proto::api::DeliveryDecision;
use task_proto::{DeploymentId, RobotId};

use super::{DeploymentActions, DeploymentError};
use crate::orders::changes::PendingNotifications;

impl DeploymentActions {
    /// Tells robots that still wait for the parts of a package to pull the package, `because`. The
    /// new decision is stored, and their state signed anew.
    pub async fn switch_to_pull(
        &self,
        parts: &[(DeploymentId, RobotId)],
        because: &str,
    ) -> Result<(), DeploymentError> {
        if parts.is_empty() {
            return Ok(());
        }
        let mut write = self.store.begin().await?;
        let changed = write
            .fan_outs()
            .pull_instead(parts, DeliveryDecision::FELL_BEHIND, because, self.clock.now_ms())
            .await?;
        write.commit().await?;
        let mut notifications = PendingNotifications::default();
        for (deployment, robot) in changed {
            notifications.deployments.insert(deployment);
            notifications.to_notify.insert(robot);
        }
        self.changes.publish(notifications);
        Ok(())
    }
}
