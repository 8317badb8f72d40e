//! Robots: who they are, and how the operator sees them.

use task_proto::api::RobotView;
use task_proto::{Digest, RobotId};

use super::{Store, StoreError};

impl Store {
    /// All robots, sorted by name. `online` and `address` are left empty: only presence knows them.
    pub async fn robots(&self) -> Result<Vec<RobotView>, StoreError> {
        todo!()
    }

    /// One robot; `None` if there is none or it was removed.
    pub async fn robot(&self, robot: &RobotId) -> Result<Option<RobotView>, StoreError> {
        todo!()
    }

    /// The robot with this id or name.
    pub async fn find_robot(&self, id_or_name: &str) -> Result<Option<RobotId>, StoreError> {
        todo!()
    }

    /// Whether `digest` belongs to a package that `robot` should have.
    pub async fn may_fetch(&self, robot: &RobotId, digest: &Digest) -> Result<bool, StoreError> {
        todo!()
    }
}
