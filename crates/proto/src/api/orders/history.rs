//! Bodies about the history of assignments.

use serde::{Deserialize, Serialize};

use super::DeliveryDecision;
use crate::DeploymentId;
use crate::desired::{PackageRef, TargetState};
use crate::messages::report::{Failure, Phase, Progress};
use crate::packages::manifest::TaskKind;

/// The most entries of a timeline; the first and the newest entries are kept.
pub const MAX_TIMELINE: usize = 64;

/// Time at which an assignment entered a phase, or retried it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TimelineEntry {
    /// The phase.
    pub phase: Phase,
    /// Time by the server's clock.
    pub at_ms: u64,
    /// The attempt, from 1; 0 if attempts are not counted.
    #[serde(default)]
    pub attempt: u32,
}

/// `GET /robots/{robot}/tasks` (read), optionally `?limit=` (1 to 200, absent: 50),
/// `?before=<deployment>` and `?task=`: all orders for a robot.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TaskHistory {
    /// The assignments, the newest first.
    pub assignments: Vec<PastAssignment>,
    /// The value of `before` for the next page; absent on the last page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<DeploymentId>,
}

/// A deployment's assignment to the requested robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PastAssignment {
    /// The deployment.
    pub deployment: DeploymentId,
    /// The package of the deployment.
    pub package: PackageRef,
    /// Service or job.
    #[serde(default)]
    pub kind: TaskKind,
    /// Whether the robot's batch has begun.
    pub released: bool,
    /// Whether the task should be running or stopped now, if the assignment is part of the robot's
    /// desired state; absent: no longer, or not yet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wanted: Option<TargetState>,
    /// The current or last phase.
    pub phase: Phase,
    /// Progress within the phase.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// Why the assignment failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<Failure>,
    /// Attempts in the phase.
    pub attempts: u32,
    /// How the package's bytes travelled, and the reason for that choice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delivery: Option<DeliveryDecision>,
    /// Past phases, the oldest first.
    pub timeline: Vec<TimelineEntry>,
    /// When the deployment was ordered.
    pub created_at_ms: u64,
    /// Time of the latest change.
    pub updated_at_ms: u64,
    /// The newer deployment that replaced this one on the robot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub superseded_by: Option<DeploymentId>,
}
