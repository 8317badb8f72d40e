//! The server's own order to robots that fell behind in a fan-out: pull.

use task_proto::{DeploymentId, RobotId};

use super::{ActionError, Actions};
use crate::domain::delivery::FELL_BEHIND;
use crate::orders::changes::Consequences;

impl Actions {
    /// Tells robots that still wait for the parts of a package to pull the package, `because`. The
    /// new decision is stored, and their state signed anew.
    pub async fn pull_instead(
        &self,
        parts: &[(DeploymentId, RobotId)],
        because: &str,
    ) -> Result<(), ActionError> {
        if parts.is_empty() {
            return Ok(());
        }
        let mut write = self.store.begin().await?;
        let changed = write.pull_instead(parts, FELL_BEHIND, because, self.clock.now_ms()).await?;
        write.commit().await?;
        let mut consequences = Consequences::default();
        for (deployment, robot) in changed {
            consequences.deployments.insert(deployment);
            consequences.rings.insert(robot);
        }
        self.changes.publish(consequences);
        Ok(())
    }
}
