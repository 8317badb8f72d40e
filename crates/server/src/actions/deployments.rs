//! Orders about deployments: create, cancel, resume, and the server's own: expire.

use task_proto::DeploymentId;
use task_proto::api::{CreateDeployment, PackageView};

use super::{ActionError, Actions, IdempotencyKey};

impl Actions {
    /// Orders `package`, which the caller has looked up for `order`, on the robots that match now. The same key with the
    /// same order gives the same deployment.
    pub async fn create_deployment(
        &self,
        key: &IdempotencyKey,
        order: &CreateDeployment,
        package: &PackageView,
    ) -> Result<DeploymentId, ActionError> {
        todo!()
    }

    /// Takes a deployment back: what it replaced is desired again. Doing it twice is harmless.
    pub async fn cancel_deployment(&self, id: &DeploymentId) -> Result<(), ActionError> {
        todo!()
    }

    /// Lets a paused deployment go on; the failures so far are forgiven.
    pub async fn resume_deployment(&self, id: &DeploymentId) -> Result<(), ActionError> {
        todo!()
    }

    /// Ends what was not done in time and forgets old idempotency keys. To be called about once a minute.
    pub async fn expire(&self) -> Result<(), ActionError> {
        todo!()
    }
}
