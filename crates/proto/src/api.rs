//! Bodies of the HTTP API under `/api/v1`. Times are milliseconds since the Unix epoch by the
//! server's clock, sizes are bytes. Unknown fields are tolerated in answers; requests are checked
//! by the server.

mod awaited;
mod bulk;
mod conduct;
mod delivery;
mod enrolment;
mod feed;
mod history;
mod logs;
mod mqtt;
mod orders;
mod packages;
mod people;
mod server;
mod status;

use serde::{Deserialize, Deserializer, Serialize};

pub use self::awaited::{Awaited, names};
pub use self::bulk::{BulkLabels, BulkRemove};
pub use self::conduct::ConductTotals;
pub use self::delivery::{DeliveryChoice, DeliveryDecision, MAX_PRIORITY, MIN_PRIORITY};
pub use self::enrolment::{
    AWAITS_APPROVAL, CreateEnrollmentToken, EnrollmentToken, EnrollmentTokenList,
    EnrollmentTokenView, PendingRobot, PendingRobotList,
};
pub use self::feed::{FeedEntry, FeedKind, FeedPage, MAX_FEED_ENTRIES};
pub use self::history::{MAX_TIMELINE, PastAssignment, TaskHistory, TimelineEntry, VitalsView};
pub use self::logs::{LogEvent, LogsFrom, LogsQuery, LogsView};
pub use self::mqtt::{
    BrokerCheck, BrokerChecks, BrokerFiles, ExternalBroker, MqttEndpoint, MqttPlace, NatsFile,
};
pub use self::orders::{RetryDeployment, RolledBack};
pub use self::packages::{
    ChangedFile, PackageDiff, PackageFile, PackageFileKind, PackageFiles, PackageList, PackageUse,
    PackageVersions, PackageView,
};
pub use self::people::{
    AccessToken, AddUser, AuditPage, AuditQuery, ChangePassword, CreateToken, EditUser, LogIn, Me,
    ProviderView, SessionView, SetPassword, SignIn, TokenList, TokenOrigin, TokenView, UserList,
    UserView,
};
pub use self::server::{HttpTraffic, MqttConnection, MqttTraffic, ServerInfo, Traffic};
pub use self::status::{
    BrokerStatus, DatabaseStatus, DiskStatus, LimitView, ListenerView, MAX_SITES, ReportStatus,
    RobotCounts, RobotSession, RuleView, ServerRules, ServerStatus, SessionList, SiteStatus,
    Subscription, TransferStatus,
};
use crate::desired::{PackageRef, Wanted};
use crate::envelope::PublicKey;
use crate::id::Labels;
use crate::manifest::TaskKind;
use crate::output::OutputSet;
use crate::report::{ActiveVersion, Condition, Failure, HostFacts, LinkFacts, Phase, Progress};
use crate::selector::Selector;
use crate::settings::{EffectiveSettings, RobotSettings};
use crate::vitals::Vitals;
use crate::{DeploymentId, Digest, Generation, MacAddress, RobotId, RobotName, TaskName, Version};

/// Path prefix of every API route.
pub const BASE: &str = "/api/v1";
/// Request header with the agent's instance id, the same as in its reports.
pub const INSTANCE_HEADER: &str = "taskd-instance";
/// Request header with the digest of the place where the agent runs, the same as in its reports.
pub const PLACE_HEADER: &str = "taskd-place";
/// Request header that makes a deployment request safe to retry: the same key returns the same
/// deployment. 1 to 128 visible characters.
pub const IDEMPOTENCY_KEY: &str = "idempotency-key";

/// The body of every error response.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ErrorBody {
    /// The error.
    pub error: ApiError,
}

/// An error: a stable code for programs, a sentence for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ApiError {
    /// `not_found`, `invalid_request`, `unauthorized`, `forbidden`, `mac_known`, `no_robots_match`,
    /// …
    pub code: String,
    /// Description of the error for people, naming the key that the caller sent.
    pub message: String,
}

/// `POST /enroll` (enrollment token).
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollRequest {
    /// The robot's MAC address: its identity for people.
    pub mac: MacAddress,
    /// The robot's name; the server derives one from the MAC if absent.
    #[serde(default)]
    pub name: Option<RobotName>,
    /// The robot's labels.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// The public key that the robot can prove by a client certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_key: Option<PublicKey>,
}

/// Answer to an enrollment. The token is shown this once.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollResponse {
    /// The robot's new identity.
    pub robot_id: RobotId,
    /// The robot's name as registered.
    pub name: RobotName,
    /// The robot's bearer token and MQTT password.
    pub token: String,
    /// The MQTT endpoint to connect to.
    pub mqtt: MqttEndpoint,
    /// Whether the robot awaits approval: until approved, every request is refused with the code
    /// [`AWAITS_APPROVAL`].
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub awaits_approval: bool,
}

/// Answer to a robot's `POST /robots/{robot}/token`. The token is shown this once; its first use
/// revokes the previous token.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotToken {
    /// The robot's next bearer token and MQTT password.
    pub token: String,
}

/// `GET /robots` (read), optionally filtered by `?selector=`, and paged by `?limit=` (1 to 1,000)
/// with `?after=`, a robot's name.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotList {
    /// Sorted by name.
    pub robots: Vec<RobotView>,
    /// Names and ids in the selector that match none of the caller's robots, sorted: a deployment
    /// with this selector is refused.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unknown: Vec<RobotName>,
    /// The value of `after` for the next page; absent on the last page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<RobotName>,
    /// Number of robots on all pages; only in a paged answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub total: Option<u64>,
}

/// A robot as operators see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotView {
    /// The robot's id.
    pub id: RobotId,
    /// The robot's name.
    pub name: RobotName,
    /// The MAC address that the robot was registered by.
    pub mac: MacAddress,
    /// The robot's labels.
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Whether the robot is connected over MQTT or polls.
    pub online: bool,
    /// The robot's last peer address, `ip:port`.
    pub address: Option<String>,
    /// When the server last heard from the robot.
    pub last_seen_ms: Option<u64>,
    /// When the robot registered.
    pub enrolled_at_ms: u64,
    /// The generation that the robot should have.
    pub generation: Generation,
    /// The generation that the robot last reported.
    pub observed_generation: Generation,
    /// `diverged`, `duplicate_identity`, `instance_waits` and the conditions that the robot
    /// reported.
    pub conditions: Vec<Condition>,
    /// Facts that the agent reported about its machine.
    pub host: Option<HostFacts>,
    /// Measurements of the robot's connection to the server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkFacts>,
    /// The robot's tasks, sorted by name.
    pub tasks: Vec<RobotTask>,
    /// The robot's MQTT connection, if connected; only in `GET /robots/{robot}`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mqtt: Option<MqttConnection>,
    /// The machine's latest vitals; absent: none received since the server started.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vitals: Option<Vitals>,
    /// Settings of this robot on the server; absent: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub settings: Option<RobotSettings>,
    /// Settings in effect on the robot, as last reported; absent: the agent's defaults.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effective_settings: Option<EffectiveSettings>,
}

/// A task on a robot: its order and its state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotTask {
    /// The task's name.
    pub task: TaskName,
    /// The version that the deployment ordered.
    pub version: Version,
    /// The deployment that ordered the task.
    pub deployment: DeploymentId,
    /// Whether the task should run.
    pub wanted: Wanted,
    /// Number of times the task was asked to start.
    pub run: u64,
    /// How the package's bytes travel, and the reason for that choice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delivery: Option<DeliveryDecision>,
    /// The task's current phase.
    pub phase: Phase,
    /// Progress within the phase.
    pub progress: Option<Progress>,
    /// Why the task failed.
    pub failure: Option<Failure>,
    /// Why the running task is degraded.
    #[serde(default)]
    pub degraded: Option<Failure>,
    /// The version with a live process.
    pub active: Option<ActiveVersion>,
    /// Whether the ordered version now names another package, after a forced push.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub outdated: bool,
    /// Times the process was restarted in this run.
    pub restarts: u32,
}

/// `PATCH /robots/{robot}` (maintain): absent fields stay unchanged.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EditRobot {
    /// A new name.
    #[serde(default)]
    pub name: Option<RobotName>,
    /// The new labels; they replace all existing labels.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Option<Labels>,
    /// The new settings; they replace all existing settings. Null removes them.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "given")]
    pub settings: Option<Option<RobotSettings>>,
}

/// Tells an explicit null from an absent field.
fn given<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

/// Answer to a robot's `POST /robots/{robot}/report`. The report is stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReportReply {
    /// The generation the robot should have.
    pub generation: Generation,
    /// The robot's name on the server; the server's value wins over the robot's own.
    pub name: RobotName,
    /// The robot's labels on the server; the server's value wins over the robot's own.
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
}

/// `GET /outputs` (read), optionally `?robot=` (id or name) and `?task=`. The files are read from
/// `/v2/outputs/<robot id>/<task>/blobs/<digest>`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OutputList {
    /// The newest first, at most 1,000.
    pub outputs: Vec<OutputView>,
}

/// Files that one run uploaded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OutputView {
    /// The robot's name.
    pub robot_name: RobotName,
    /// Digest of the artifact's manifest.
    pub manifest: Digest,
    /// When the output was pushed.
    pub pushed_at_ms: u64,
    /// The run and its files.
    #[serde(flatten)]
    pub output: OutputSet,
}

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

/// The largest page of a list, in entries.
pub const MOST_ON_A_PAGE: u32 = 1_000;

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
    /// Whether the deployment's version now names another package, after a forced push.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub outdated: bool,
    /// One per robot, sorted by name; only in `GET /deployments/{id}` and the answer to an order.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assignments: Option<Vec<AssignmentView>>,
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

/// An event of the stream `GET /events` (read): each is the `data` of a server-sent event whose
/// `event` is the tag's value. A view replaces the client's earlier copy. After each connection,
/// fetch the lists once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Event {
    /// A robot is new or has changed.
    Robot {
        /// The robot's current view.
        robot: Box<RobotView>,
    },
    /// A robot was removed.
    RobotRemoved {
        /// The robot's id.
        id: RobotId,
    },
    /// A deployment is new or has changed; without assignments.
    Deployment {
        /// The deployment's current view.
        deployment: Box<DeploymentView>,
    },
    /// A package was pushed or deleted.
    Package {
        /// The package's name.
        name: TaskName,
    },
    /// The feed has a new entry.
    Feed {
        /// The new entry.
        entry: FeedEntry,
    },
    /// The client was too slow and missed events: fetch the lists again.
    Missed,
}
