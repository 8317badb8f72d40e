//! Bodies of orders that follow from earlier ones: retries of failures, and rollbacks.

use serde::{Deserialize, Serialize};

use super::{DeploymentView, MatchedRobot};
use crate::ids::selector::Selector;
use crate::messages::report::FailureCode;

/// `POST /deployments/{deployment}/retry` (operate), with an `Idempotency-Key` header: a new
/// deployment of the same package with the same options, for the robots on which this deployment
/// ended badly and that have received no other order since. The answer is a [`DeploymentView`]; for
/// a dry run, `MatchedRobots`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RetryDeployment {
    /// Only those of the robots that match this selector.
    #[serde(default)]
    pub selector: Option<Selector>,
    /// Only the robots that failed with this code.
    #[serde(default)]
    pub code: Option<FailureCode>,
    /// Only list the robots that match. Stores nothing, needs no key.
    #[serde(default)]
    pub dry_run: bool,
}

/// Answer to `POST /tasks/{task}/rollback` (operate), which takes a `OrderTask`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RolledBack {
    /// A new deployment for each package that robots go back to; empty after a dry run.
    pub deployments: Vec<DeploymentView>,
    /// Robots that go back, sorted by name.
    pub robots: Vec<MatchedRobot>,
    /// Robots that have the task, but never ran another package of it; sorted by name.
    pub without: Vec<MatchedRobot>,
}
