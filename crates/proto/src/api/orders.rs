//! Bodies of orders that follow from earlier ones: the same once more where it failed, and back to
//! what was there before.

use serde::{Deserialize, Serialize};

use super::{DeploymentView, MatchedRobot};
use crate::report::FailureCode;
use crate::selector::Selector;

/// `POST /deployments/{deployment}/retry` (operate), with an `Idempotency-Key` header: a new
/// deployment of the same package in the same way, for the robots on which this one has ended badly
/// and that nothing else was ordered of since. The answer is a [`DeploymentView`], to a dry run
/// [`super::MatchedRobots`].
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RetryDeployment {
    /// Only these of them.
    #[serde(default)]
    pub selector: Option<Selector>,
    /// Only those that failed with this code.
    #[serde(default)]
    pub code: Option<FailureCode>,
    /// Only say which robots it would be. Stores nothing, needs no key.
    #[serde(default)]
    pub dry_run: bool,
}

/// Answer to `POST /tasks/{task}/rollback` (operate), which takes a [`super::OrderTask`].
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RolledBack {
    /// A new deployment for each package that some robot goes back to; none after a dry run.
    pub deployments: Vec<DeploymentView>,
    /// Who goes back, sorted by name.
    pub robots: Vec<MatchedRobot>,
    /// Who has the task, but never had another package of it that ran; sorted by name.
    pub without: Vec<MatchedRobot>,
}
