//! Bodies of the HTTP API under `/api/v1`. Times are milliseconds since the Unix epoch by the server's clock, sizes are
//! bytes. Unknown fields are tolerated in answers; requests are checked by the server.

mod conduct;
mod delivery;
mod enrolment;
mod logs;
mod mqtt;
mod people;

use serde::{Deserialize, Serialize};

pub use self::conduct::ConductTotals;
pub use self::delivery::{DeliveryChoice, DeliveryDecision, MAX_PRIORITY, MIN_PRIORITY};
pub use self::enrolment::{AWAITS_APPROVAL, EnrollmentTokenList, EnrollmentTokenView, PendingRobot, PendingRobotList};
pub use self::logs::{LogEvent, LogsFrom, LogsQuery, LogsView};
pub use self::mqtt::{BrokerFiles, ExternalBroker, MqttEndpoint};
pub use self::people::{
    AccessToken, AddUser, AuditPage, AuditQuery, ChangePassword, CreateToken, EditUser, LogIn, Me, ProviderView,
    SessionView, SetPassword, SignIn, TokenList, TokenOrigin, TokenView, UserList, UserView,
};
use crate::desired::{PackageRef, Wanted};
use crate::envelope::PublicKey;
use crate::id::Labels;
use crate::manifest::{TaskKind, TaskManifest};
use crate::output::OutputSet;
use crate::report::{ActiveVersion, Condition, Failure, HostFacts, LinkFacts, Phase, Progress};
use crate::selector::Selector;
use crate::{CaPin, DeploymentId, Digest, Generation, MacAddress, RobotId, RobotName, TaskName, Version};

/// Where the API begins.
pub const BASE: &str = "/api/v1";
/// Request header that makes an order safe to retry: the same key gives the same deployment. 1 to 128 visible characters.
pub const IDEMPOTENCY_KEY: &str = "idempotency-key";

/// Every error's body.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ErrorBody {
    /// The error.
    pub error: ApiError,
}

/// An error: a stable code for programs, a sentence for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ApiError {
    /// `not_found`, `invalid_request`, `unauthorized`, `forbidden`, `mac_known`, `no_robots_match`, …
    pub code: String,
    /// What went wrong, naming the caller's own key.
    pub message: String,
}

/// `GET /server` (read).
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ServerInfo {
    /// The server's version.
    pub version: String,
    /// The key that signs desired states.
    pub key: PublicKey,
    /// The pin of the authority that made its certificate, if that is its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_pin: Option<CaPin>,
    /// Where MQTT is: the listener's address, `host:port`, as bound, or the external broker's.
    pub mqtt: String,
    /// The server's clock.
    pub now_ms: u64,
    /// What went over MQTT since the server started.
    #[serde(default)]
    pub traffic: MqttTraffic,
    /// What went over HTTP since then.
    #[serde(default)]
    pub http: HttpTraffic,
    /// What was done about robots that misbehaved since then.
    #[serde(default)]
    pub conduct: ConductTotals,
}

/// What went over HTTP, all connections together, counted at the sockets. In is towards the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct HttpTraffic {
    /// Connections that were taken.
    pub connections: u64,
    /// Requests whose head was read.
    pub requests: u64,
    /// Bytes, heads and bodies.
    pub bytes_in: u64,
    /// Likewise.
    pub bytes_out: u64,
}

/// What went over MQTT, all connections together, the server's own watchdog excepted. With an external broker only the
/// server's own connection to it is known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct MqttTraffic {
    /// Robots that are connected now.
    pub robots_connected: u64,
    /// Clients that were let in.
    pub connections_accepted: u64,
    /// Clients that were turned away: too many, too slow, a wrong password, no MQTT.
    pub connections_refused: u64,
    /// Messages that were sent where their sender may not, or could not be stored.
    pub messages_refused: u64,
    /// Messages that a listener would have got, had it kept up.
    pub messages_dropped: u64,
    /// The connections' own figures, added up.
    pub all: Traffic,
}

/// What went over an MQTT connection since it began. In is towards the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Traffic {
    /// Bytes, with those that were refused.
    pub bytes_in: u64,
    /// Likewise.
    pub bytes_out: u64,
    /// MQTT control packets, CONNECT included.
    pub packets_in: u64,
    /// MQTT control packets, CONNACK included.
    pub packets_out: u64,
    /// PUBLISH.
    pub messages_in: u64,
    /// PUBLISH.
    pub messages_out: u64,
    /// PUBACK.
    pub acks_in: u64,
    /// PUBACK.
    pub acks_out: u64,
}

/// `POST /enroll` (enrolment token).
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct EnrollRequest {
    /// The robot's MAC: its identity towards people.
    pub mac: MacAddress,
    /// Its name; the server makes one from the MAC if absent.
    #[serde(default)]
    pub name: Option<RobotName>,
    /// Its labels.
    #[serde(default)]
    pub labels: Labels,
    /// The key that it can show by a client certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_key: Option<PublicKey>,
}

/// Answer to an enrolment. The token is shown this once.
#[derive(Clone, Serialize, Deserialize)]
pub struct EnrollResponse {
    /// The robot's new identity.
    pub robot_id: RobotId,
    /// The name it got.
    pub name: RobotName,
    /// Its bearer token and MQTT password.
    pub token: String,
    /// How to reach MQTT.
    pub mqtt: MqttEndpoint,
    /// Whether it waits to be approved: until then it is refused everything with the code [`AWAITS_APPROVAL`].
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub awaits_approval: bool,
}

/// Answer to a robot's `POST /robots/{robot}/token`. The token is shown this once; its first use ends the one before.
#[derive(Clone, Serialize, Deserialize)]
pub struct RobotToken {
    /// The robot's next bearer token and MQTT password.
    pub token: String,
}

/// `POST /enrollment-tokens` (administer).
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct CreateEnrollmentToken {
    /// Only for this robot, by id or name, which may register again with it.
    #[serde(default)]
    pub robot: Option<String>,
    /// How many enrolments it is good for; absent: any number.
    #[serde(default)]
    pub uses: Option<u64>,
    /// Lifetime in seconds; the server's default is a day.
    #[serde(default)]
    pub ttl_s: Option<u64>,
    /// Labels each robot that uses it gets.
    #[serde(default)]
    pub labels: Labels,
    /// Whether a robot that comes by it waits to be approved, also where the server does not ask that of all.
    #[serde(default)]
    pub approval: bool,
}

/// A new enrolment token. The secret is shown this once.
#[derive(Clone, Serialize, Deserialize)]
pub struct EnrollmentToken {
    /// The public part of it.
    pub id: String,
    /// The whole token.
    pub token: String,
    /// When it ends.
    pub expires_at_ms: u64,
}

/// `GET /robots` (read), optionally `?selector=`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct RobotList {
    /// Sorted by name.
    pub robots: Vec<RobotView>,
}

/// A robot as the operator sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RobotView {
    /// Its identity.
    pub id: RobotId,
    /// Its name.
    pub name: RobotName,
    /// The MAC it was registered by.
    pub mac: MacAddress,
    /// Its labels.
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
    /// `diverged`, `duplicate_identity` and what the robot reported.
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
}

/// A robot's MQTT connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct MqttConnection {
    /// When it began.
    pub since_ms: u64,
    /// What went over it.
    pub traffic: Traffic,
}

/// A task on a robot: what is ordered, and where it stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
    /// Times the process was started again in this run.
    pub restarts: u32,
}

/// `PATCH /robots/{robot}` (maintain): absent fields stay.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct EditRobot {
    /// A new name.
    #[serde(default)]
    pub name: Option<RobotName>,
    /// The new labels, all of them.
    #[serde(default)]
    pub labels: Option<Labels>,
}

/// Answer to a robot's `POST /robots/{robot}/report`. The report is stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReportReply {
    /// The generation the robot should have.
    pub generation: Generation,
    /// The name and labels the server holds; the server's win over the robot's own.
    pub name: RobotName,
    /// Likewise.
    pub labels: Labels,
}

/// `GET /packages` (read).
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct PackageList {
    /// Sorted by name, then newest first.
    pub packages: Vec<PackageView>,
}

/// One package version.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PackageView {
    /// The pinned package.
    pub package: PackageRef,
    /// When it was pushed.
    pub pushed_at_ms: u64,
    /// Its manifest.
    pub manifest: TaskManifest,
}

/// `GET /outputs` (read), optionally `?robot=` (id or name) and `?task=`. The files are read from
/// `/v2/outputs/<robot id>/<task>/blobs/<digest>`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct OutputList {
    /// The newest first, at most 1,000.
    pub outputs: Vec<OutputView>,
}

/// What one run brought back.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
            dry_run: false,
        }
    }
}

/// Answer to a dry run, and to an order on tasks: the robots meant.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct MatchedRobots {
    /// Sorted by name.
    pub robots: Vec<MatchedRobot>,
}

/// A robot that a selector matched.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MatchedRobot {
    /// Its identity.
    pub id: RobotId,
    /// Its name.
    pub name: RobotName,
    /// Whether it is connected now.
    pub online: bool,
}

/// `GET /deployments` (read): the newest first, without assignments.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct DeploymentList {
    /// The deployments.
    pub deployments: Vec<DeploymentView>,
}

/// A deployment as the operator sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeploymentView {
    /// Its identity.
    pub id: DeploymentId,
    /// What it brings.
    pub package: PackageRef,
    /// Service or job.
    pub kind: TaskKind,
    /// The selector as it was given.
    pub selector: Selector,
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
    /// Deployments it took the place of on some robot.
    pub supersedes: Vec<DeploymentId>,
    /// One per robot, sorted by name; only in `GET /deployments/{id}` and the answer to an order.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assignments: Option<Vec<AssignmentView>>,
}

/// How many assignments stand in a phase.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct PhaseCount {
    /// The phase.
    pub phase: Phase,
    /// How many.
    pub count: u64,
}

/// Where a deployment stands as a whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
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
}

/// `POST /tasks/{task}/{start|stop|remove}` (operate), with an `Idempotency-Key` header.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct OrderTask {
    /// Which robots; those that have no such task are left out.
    pub selector: Selector,
    /// Only say which robots it would be.
    #[serde(default)]
    pub dry_run: bool,
}

/// What `GET /events` (read) streams: each is the `data` of a server-sent event whose `event` is the tag's value.
/// A view replaces what was known before. After (re)connecting, fetch the lists once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
    /// The listener was too slow and missed events: fetch the lists again.
    Missed,
}
