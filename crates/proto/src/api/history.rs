//! Bodies about what became of assignments, and when.

use serde::{Deserialize, Serialize};

use super::DeliveryDecision;
use crate::DeploymentId;
use crate::desired::{PackageRef, Wanted};
use crate::manifest::TaskKind;
use crate::report::{Failure, Phase, Progress};
use crate::vitals::Vitals;

/// The most entries of a timeline; the first and the newest are kept.
pub const MAX_TIMELINE: usize = 64;

/// When an assignment came into a phase, or tried it again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TimelineEntry {
    /// The phase.
    pub phase: Phase,
    /// When, by the server's clock.
    pub at_ms: u64,
    /// The try, from 1; 0 where tries are not counted.
    #[serde(default)]
    pub attempt: u32,
}

/// `GET /robots/{robot}/tasks` (read), optionally `?limit=` (1 to 200, absent: 50),
/// `?before=<deployment>` and `?task=`: everything that was ordered for a robot.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TaskHistory {
    /// The newest first.
    pub assignments: Vec<PastAssignment>,
    /// What `before` is for the older ones; absent: these were the last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<DeploymentId>,
}

/// A deployment's part for the robot that was asked about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PastAssignment {
    /// The deployment.
    pub deployment: DeploymentId,
    /// What it brought.
    pub package: PackageRef,
    /// Service or job.
    #[serde(default)]
    pub kind: TaskKind,
    /// Whether its batch has begun.
    pub released: bool,
    /// Whether it is what the robot should have now, running or stopped; absent: no more, or not
    /// yet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wanted: Option<Wanted>,
    /// Where it stands.
    pub phase: Phase,
    /// How far the phase has come.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<Failure>,
    /// Tries of the phase.
    pub attempts: u32,
    /// How its bytes travelled, and why.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delivery: Option<DeliveryDecision>,
    /// The phases it went through, the oldest first.
    pub timeline: Vec<TimelineEntry>,
    /// When it was ordered.
    pub created_at_ms: u64,
    /// When it last changed.
    pub updated_at_ms: u64,
    /// The newer deployment that took its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub superseded_by: Option<DeploymentId>,
}

/// `GET /robots/{robot}/vitals` (read): the last hour, about one a minute; gone when the server
/// restarts.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct VitalsView {
    /// The oldest first.
    pub samples: Vec<Vitals>,
}
