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

/// Where the API begins.
pub const BASE: &str = "/api/v1";
/// The header by which an agent names its instance, as in its reports.
pub const INSTANCE_HEADER: &str = "taskd-instance";
/// The header by which an agent says where it runs, as in its reports.
pub const PLACE_HEADER: &str = "taskd-place";
/// Request header that makes an order safe to retry: the same key gives the same deployment. 1 to
/// 128 visible characters.
pub const IDEMPOTENCY_KEY: &str = "idempotency-key";

/// Every error's body.
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
    /// What went wrong, naming the caller's own key.
    pub message: String,
}

/// `POST /enroll` (enrolment token).
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollRequest {
    /// The robot's MAC: its identity towards people.
    pub mac: MacAddress,
    /// Its name; the server makes one from the MAC if absent.
    #[serde(default)]
    pub name: Option<RobotName>,
    /// Its labels.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// The key that it can show by a client certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_key: Option<PublicKey>,
}

/// Answer to an enrolment. The token is shown this once.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollResponse {
    /// The robot's new identity.
    pub robot_id: RobotId,
    /// The name it got.
    pub name: RobotName,
    /// Its bearer token and MQTT password.
    pub token: String,
    /// How to reach MQTT.
    pub mqtt: MqttEndpoint,
    /// Whether it waits to be approved: until then it is refused everything with the code
    /// [`AWAITS_APPROVAL`].
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub awaits_approval: bool,
}

/// Answer to a robot's `POST /robots/{robot}/token`. The token is shown this once; its first use
/// ends the one before.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotToken {
    /// The robot's next bearer token and MQTT password.
    pub token: String,
}

/// `GET /robots` (read), optionally `?selector=`, and `?limit=` (1 to 1,000) with `?after=`, a
/// robot's name, for a page.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotList {
    /// Sorted by name.
    pub robots: Vec<RobotView>,
    /// Names and ids in the selector that none of one's robots has, sorted: an order with this
    /// selector is refused.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unknown: Vec<RobotName>,
    /// On a page that is not the last: what `after` has to be for the next one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<RobotName>,
    /// On a page: how many robots all pages have.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub total: Option<u64>,
}

/// A robot as the operator sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotView {
    /// Its identity.
    pub id: RobotId,
    /// Its name.
    pub name: RobotName,
    /// The MAC it was registered by.
    pub mac: MacAddress,
    /// Its labels.
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Whether it is connected over MQTT or polls.
    pub online: bool,
    /// Its last peer address, `ip:port`.
    pub address: Option<String>,
    /// When it was last heard.
    pub last_seen_ms: Option<u64>,
    /// When it registered.
    pub enrolled_at_ms: u64,
    /// The generation it should have.
    pub generation: Generation,
    /// The generation it last reported.
    pub observed_generation: Generation,
    /// `diverged`, `duplicate_identity`, `instance_waits` and what the robot reported.
    pub conditions: Vec<Condition>,
    /// What it said of its machine.
    pub host: Option<HostFacts>,
    /// What it measured of its way to the server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkFacts>,
    /// Its tasks, sorted by name.
    pub tasks: Vec<RobotTask>,
    /// Its MQTT connection, if it has one; only in `GET /robots/{robot}`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mqtt: Option<MqttConnection>,
    /// How its machine did last; absent: not said since the server started.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vitals: Option<Vitals>,
    /// What was set for it here; absent: nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub settings: Option<RobotSettings>,
    /// What holds there, as it last said; absent: the agent's defaults.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effective_settings: Option<EffectiveSettings>,
}

/// A task on a robot: what is ordered, and where it stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotTask {
    /// The task's name.
    pub task: TaskName,
    /// The version ordered.
    pub version: Version,
    /// The order.
    pub deployment: DeploymentId,
    /// Whether it should run.
    pub wanted: Wanted,
    /// How often it was asked to start.
    pub run: u64,
    /// How its bytes travel, and why.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delivery: Option<DeliveryDecision>,
    /// Where it stands.
    pub phase: Phase,
    /// How far the phase has come.
    pub progress: Option<Progress>,
    /// Why it failed.
    pub failure: Option<Failure>,
    /// Why it runs, yet not as it should.
    #[serde(default)]
    pub degraded: Option<Failure>,
    /// The version whose process lives.
    pub active: Option<ActiveVersion>,
    /// Whether the ordered version means another package by now: a forced push took it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub outdated: bool,
    /// Times the process was started again in this run.
    pub restarts: u32,
}

/// `PATCH /robots/{robot}` (maintain): absent fields stay.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EditRobot {
    /// A new name.
    #[serde(default)]
    pub name: Option<RobotName>,
    /// The new labels, all of them.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Option<Labels>,
    /// The new settings, all of them; null: none.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "given")]
    pub settings: Option<Option<RobotSettings>>,
}

/// Null is something that was given.
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
    /// The name and labels the server holds; the server's win over the robot's own.
    pub name: RobotName,
    /// Likewise.
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

/// What one run brought back.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OutputView {
    /// The robot's name.
    pub robot_name: RobotName,
    /// The artifact's manifest.
    pub manifest: Digest,
    /// When it came.
    pub pushed_at_ms: u64,
    /// Which run, and its files.
    #[serde(flatten)]
    pub output: OutputSet,
}

/// `POST /deployments` (operate), with an `Idempotency-Key` header.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CreateDeployment {
    /// The package's name: its repository.
    pub package: TaskName,
    /// Its manifest, pushed before.
    pub manifest: Digest,
    /// Which robots; resolved once, now.
    pub selector: Selector,
    /// How the bytes should travel.
    #[serde(default)]
    pub delivery: DeliveryChoice,
    /// From -100 to 100: the higher comes first, on the robot and where transfers have to wait.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(minimum = -100, maximum = 100))]
    pub priority: i32,
    /// How many robots at a time; absent: all at once.
    #[serde(default)]
    pub batch: Option<u64>,
    /// Pause when more than this many robots have failed; absent: never.
    #[serde(default)]
    pub max_failures: Option<u64>,
    /// Seconds until what is not done expires; absent: the server's setting.
    #[serde(default)]
    pub expires_in_s: Option<u64>,
    /// Run a service anew also on robots that run this package already. Otherwise it goes on there,
    /// and those robots have settled at once.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub restart: bool,
    /// Only say which robots it would be. Stores nothing, needs no key.
    #[serde(default)]
    pub dry_run: bool,
}

impl CreateDeployment {
    /// An order that leaves everything else to the server.
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

/// Answer to a dry run, and to an order on tasks: the robots meant.
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
    /// Its identity.
    pub id: RobotId,
    /// Its name.
    pub name: RobotName,
    /// Whether it is connected now.
    pub online: bool,
}

/// The most that one page of a list holds.
pub const MOST_ON_A_PAGE: u32 = 1_000;

/// `GET /deployments` (read): the newest first, without assignments; optionally `?limit=` (1 to
/// 1,000) with `?before=`, a deployment's id, for a page.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DeploymentList {
    /// The deployments.
    pub deployments: Vec<DeploymentView>,
    /// On a page that is not the last: what `before` has to be for the next one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<DeploymentId>,
}

/// A deployment as the operator sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DeploymentView {
    /// Its identity.
    pub id: DeploymentId,
    /// What it brings.
    pub package: PackageRef,
    /// Service or job.
    pub kind: TaskKind,
    /// The selector as it was given. Absent in lists and events where it is longer than 1,000
    /// characters, and for who is limited to some robots: it may name others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selector: Option<Selector>,
    /// How the bytes travel, as it was ordered.
    pub delivery: DeliveryChoice,
    /// The higher comes first.
    #[serde(default)]
    pub priority: i32,
    /// Where it stands as a whole.
    pub state: DeploymentState,
    /// Robots at a time.
    pub batch: Option<u64>,
    /// Failures it bears.
    pub max_failures: Option<u64>,
    /// When it was ordered.
    pub created_at_ms: u64,
    /// When what is left expires.
    pub expires_at_ms: u64,
    /// How many assignments stand in each phase, zeros left out, in the order of a life.
    pub counts: Vec<PhaseCount>,
    /// Deployments it took the place of on some robot; none for who is limited to some robots.
    pub supersedes: Vec<DeploymentId>,
    /// Whether its version means another package by now: a forced push took it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub outdated: bool,
    /// One per robot, sorted by name; only in `GET /deployments/{id}` and the answer to an order.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assignments: Option<Vec<AssignmentView>>,
}

/// How many assignments stand in a phase.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PhaseCount {
    /// The phase.
    pub phase: Phase,
    /// How many.
    pub count: u64,
}

/// Where a deployment stands as a whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum DeploymentState {
    /// Some assignment is not settled.
    Active,
    /// Too many robots failed; no further batch is begun until it is resumed.
    Paused,
    /// Every assignment is settled.
    Settled,
    /// The operator took it back.
    Cancelled,
}

/// A deployment's part for one robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AssignmentView {
    /// The robot.
    pub robot: RobotId,
    /// Its name.
    pub name: RobotName,
    /// Whether it is connected now.
    pub online: bool,
    /// Whether its batch has begun.
    pub released: bool,
    /// How its bytes travel, and why; absent until its batch begins.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delivery: Option<DeliveryDecision>,
    /// Where it stands.
    pub phase: Phase,
    /// How far the phase has come.
    pub progress: Option<Progress>,
    /// Why it failed.
    pub failure: Option<Failure>,
    /// Tries of the phase.
    pub attempts: u32,
    /// The newer deployment that took its place.
    pub superseded_by: Option<DeploymentId>,
    /// When it last changed.
    pub updated_at_ms: u64,
    /// The phases it went through, the oldest first; only with `?timeline=true`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeline: Option<Vec<TimelineEntry>>,
}

/// `POST /tasks/{task}/{start|stop|restart|remove|rollback}` (operate), with an `Idempotency-Key`
/// header.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OrderTask {
    /// Which robots; those that have no such task are left out.
    pub selector: Selector,
    /// Only say which robots it would be.
    #[serde(default)]
    pub dry_run: bool,
}

/// What `GET /events` (read) streams: each is the `data` of a server-sent event whose `event` is
/// the tag's value. A view replaces what was known before. After (re)connecting, fetch the lists
/// once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Event {
    /// A robot is new or has changed.
    Robot {
        /// As it is now.
        robot: Box<RobotView>,
    },
    /// A robot was removed.
    RobotRemoved {
        /// Which.
        id: RobotId,
    },
    /// A deployment is new or has changed; without assignments.
    Deployment {
        /// As it is now.
        deployment: Box<DeploymentView>,
    },
    /// A package was pushed or deleted.
    Package {
        /// Which.
        name: TaskName,
    },
    /// Something happened that is worth a look.
    Feed {
        /// What.
        entry: FeedEntry,
    },
    /// The listener was too slow and missed events: fetch the lists again.
    Missed,
}
