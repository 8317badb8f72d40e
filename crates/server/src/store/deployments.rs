//! Deployments: the operators' orders, and how far they have come.

use task_proto::DeploymentId;
use task_proto::api::DeploymentView;
use task_proto::desired::PackageRef;

use super::{Store, StoreError};

impl Store {
    /// The newest deployments, newest first, without assignments.
    pub async fn deployments(&self) -> Result<Vec<DeploymentView>, StoreError> {
        todo!()
    }

    /// One deployment without its assignments.
    pub async fn deployment_summary(&self, id: &DeploymentId) -> Result<Option<DeploymentView>, StoreError> {
        todo!()
    }

    /// One deployment with its assignments, sorted by robot name; their `online` is left false.
    pub async fn deployment(&self, id: &DeploymentId) -> Result<Option<DeploymentView>, StoreError> {
        todo!()
    }

    /// The packages some robot should have, or may get back: what must not be collected.
    pub async fn packages_in_use(&self) -> Result<Vec<PackageRef>, StoreError> {
        todo!()
    }
}
