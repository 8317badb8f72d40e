//! Bodies of orders: deployments, their assignments, and orders about tasks.

mod delivery;
mod follow_up;
mod history;
mod unsettled;

use serde::{Deserialize, Serialize};

pub use self::delivery::{DeliveryChoice, DeliveryDecision, MAX_PRIORITY, MIN_PRIORITY};
pub use self::follow_up::{RetryDeployment, RolledBack};
pub use self::history::{MAX_TIMELINE, PastAssignment, TaskHistory, TimelineEntry};
pub use self::unsettled::{UnsettledRobots, join_names};
use crate::desired::PackageRef;
use crate::ids::selector::Selector;
use crate::messages::report::{Failure, Phase, Progress};
use crate::packages::manifest::TaskKind;
use crate::{DeploymentId, Digest, RobotId, RobotName, TaskName};

/// `POST /deployments` (operate), with an `Idempotency-Key` header.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CreateDeployment {
    /// The package's name, which is the name of its repository.
    pub package: TaskName,
    /// Digest of the package's manifest, which must be pushed already.
    pub manifest: Digest,
    /// The robots to deploy to; resolved once, at creation.
    pub selector: Selector,
    /// How the package's bytes should travel.
    #[serde(default)]
    pub delivery: DeliveryChoice,
    /// From -100 to 100: higher values come first, on the robot and in the queue for transfers.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(minimum = -100, maximum = 100))]
    pub priority: i32,
    /// Number of robots at a time; absent: all at once.
    #[serde(default)]
    pub batch: Option<u64>,
    /// Pause when more than this many robots have failed; absent: never.
    #[serde(default)]
    pub max_failures: Option<u64>,
    /// Seconds until unfinished assignments expire; absent: the server's setting.
    #[serde(default)]
    pub expires_in_s: Option<u64>,
    /// Restart a service also on robots that already run this package. Otherwise the service keeps
    /// running there, and those robots settle at once.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub restart: bool,
    /// Only list the robots that match. Stores nothing, needs no key.
    #[serde(default)]
    pub dry_run: bool,
}

impl CreateDeployment {
    /// A deployment request with defaults for all other fields.
    pub fn new(package: TaskName, manifest: Digest, selector: Selector) -> Self {
        Self {
            package,
            manifest,
            selector,
            delivery: DeliveryChoice::default(),
            priority: 0,
            batch: None,
            max_failures: None,
            expires_in_s: None,
            restart: false,
            dry_run: false,
        }
    }
}

/// Robots that a selector matched: the answer to a dry run and to an order on tasks.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MatchedRobots {
    /// Sorted by name.
    pub robots: Vec<MatchedRobot>,
}

/// A robot that a selector matched.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MatchedRobot {
    /// The robot's id.
    pub id: RobotId,
    /// The robot's name.
    pub name: RobotName,
    /// Whether the robot is connected now.
    pub online: bool,
}

/// `GET /deployments` (read): the newest first, without assignments; optionally `?limit=` (1 to
/// 1,000) with `?before=`, a deployment's id, for a page.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DeploymentList {
    /// The deployments.
    pub deployments: Vec<DeploymentView>,
    /// The value of `before` for the next page; absent on the last page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<DeploymentId>,
}

/// A deployment as operators see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DeploymentView {
    /// The deployment's id.
    pub id: DeploymentId,
    /// The package to deploy.
    pub package: PackageRef,
    /// Service or job.
    pub kind: TaskKind,
    /// The selector as ordered. Absent in lists and events if longer than 1,000 characters, and for
    /// users limited to some robots, because the selector may name other robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selector: Option<Selector>,
    /// The delivery method as ordered.
    pub delivery: DeliveryChoice,
    /// Priority: higher values come first.
    #[serde(default)]
    pub priority: i32,
    /// State of the deployment as a whole.
    pub state: DeploymentState,
    /// Number of robots at a time.
    pub batch: Option<u64>,
    /// Number of failed robots above which the deployment pauses.
    pub max_failures: Option<u64>,
    /// When the deployment was ordered.
    pub created_at_ms: u64,
    /// When unfinished assignments expire.
    pub expires_at_ms: u64,
    /// Number of assignments in each phase, in life-cycle order, without zeros.
    pub counts: Vec<PhaseCount>,
    /// Deployments that this one replaced on at least one robot; empty for users limited to some
    /// robots.
    pub supersedes: Vec<DeploymentId>,
    /// How far a large order has got; absent once every selected robot has its assignment. Until
    /// then the deployment is not settled, unless an operator cancelled it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub placing: Option<Placing>,
    /// Whether the deployment's version now names another package, after a forced push.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub outdated: bool,
    /// One per robot, sorted by name; only in `GET /deployments/{id}` and the answer to an order.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assignments: Option<Vec<AssignmentView>>,
}

/// The robots of an order that is placed in several steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Placing {
    /// Number of robots that the order selected.
    pub selected: u64,
    /// Number of those for which the order was placed so far. They have an assignment, unless they
    /// were removed in the meantime.
    pub placed: u64,
}

/// Number of assignments in a phase.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PhaseCount {
    /// The phase.
    pub phase: Phase,
    /// Number of assignments.
    pub count: u64,
}

/// State of a deployment as a whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum DeploymentState {
    /// Some assignments are not settled.
    Active,
    /// Too many robots failed; no further batch starts until the deployment is resumed.
    Paused,
    /// Every assignment is settled.
    Settled,
    /// An operator cancelled the deployment.
    Cancelled,
}

/// A deployment's assignment to one robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AssignmentView {
    /// The robot.
    pub robot: RobotId,
    /// The robot's name.
    pub name: RobotName,
    /// Whether the robot is connected now.
    pub online: bool,
    /// Whether the robot's batch has begun.
    pub released: bool,
    /// How the package's bytes travel, and the reason for that choice; absent until the robot's
    /// batch begins.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delivery: Option<DeliveryDecision>,
    /// The current phase.
    pub phase: Phase,
    /// Progress within the phase.
    pub progress: Option<Progress>,
    /// Why the assignment failed.
    pub failure: Option<Failure>,
    /// Attempts in the phase.
    pub attempts: u32,
    /// The newer deployment that replaced this one on the robot.
    pub superseded_by: Option<DeploymentId>,
    /// Time of the latest change.
    pub updated_at_ms: u64,
    /// Past phases, the oldest first; only with `?timeline=true`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeline: Option<Vec<TimelineEntry>>,
}

/// `POST /tasks/{task}/{start|stop|restart|remove|rollback}` (operate), with an `Idempotency-Key`
/// header.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OrderTask {
    /// The robots to order; robots without this task are left out.
    pub selector: Selector,
    /// Only list the robots that match.
    #[serde(default)]
    pub dry_run: bool,
}
