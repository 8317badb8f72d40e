//! What a robot says: whole snapshots of its tasks, ordered by (start, seq), and its connection
//! status. Times are elapsed milliseconds, because a robot's clock may lie.

mod tidy;

use std::borrow::Cow;
use std::fmt;

use serde::{Deserialize, Serialize};

use self::tidy::{MAX_FAILURE_CHARS, clean};
use crate::desired::{DesiredTask, PackageRef, Wanted};
use crate::manifest::TaskKind;
use crate::part::PartRange;
use crate::settings::{EffectiveSettings, tolerant};
use crate::{DeploymentId, Digest, Generation, InstanceId, MacAddress, RobotId, TaskName, Version};

/// The largest report, in bytes of JSON, by whatever way it comes.
pub const MAX_REPORT_BYTES: usize = 1024 * 1024;

/// A robot's whole state. A later one replaces an earlier one; (start, seq) says which is later.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Report {
    /// Who speaks.
    pub robot_id: RobotId,
    /// How many times this robot's agent has been started, from 1; kept in its ledger.
    pub start: u64,
    /// This start of the agent. Two instances alive at once are a cloned identity.
    pub instance: InstanceId,
    /// Where this start runs: one data directory, during one boot of one machine. Of two starts in
    /// the same place the second has begun after the first had ended. Absent: an agent that is too
    /// old to say.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "tolerant")]
    pub place: Option<Digest>,
    /// The kernel's boot id.
    pub boot_id: String,
    /// Counts this instance's reports from 1.
    pub seq: u64,
    /// The last generation the robot accepted.
    pub observed_generation: Generation,
    /// Milliseconds since this instance started.
    pub uptime_ms: u64,
    /// Facts about the machine.
    pub host: HostFacts,
    /// Everything out of the ordinary that concerns the robot as a whole.
    #[serde(default)]
    pub conditions: Vec<Condition>,
    /// The robot's way to the server, once something was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkFacts>,
    /// All tasks in the ledger, sorted by name.
    pub tasks: Vec<TaskReport>,
}

impl Report {
    /// The condition of a robot that was sent the generation it obeys with other content.
    pub const STATE_CONTRADICTED: &str = "state_contradicted";

    /// How far the robot has come. Of two states with one generation the one that it obeys counts
    /// as the later: the other is by a server whose database was put back to an older copy.
    pub fn reached_generation(&self) -> Generation {
        let is_contradicted =
            self.conditions.iter().any(|condition| condition.code == Self::STATE_CONTRADICTED);
        Generation(self.observed_generation.0.saturating_add(u64::from(is_contradicted)))
    }
}

/// What earlier transfers have shown of a robot's way to the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct LinkFacts {
    /// Moving average of fetches; absent before the first that was long enough to measure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub throughput_bytes_per_s: Option<u64>,
    /// Moving average of the time from a request to the first byte of its answer; absent before the
    /// first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rtt_ms: Option<u32>,
    /// Sessions that were lost in the last hour.
    pub reconnects: u32,
    /// Transfers that broke off in the last hour.
    pub losses: u32,
}

/// What the agent found out about its machine.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct HostFacts {
    /// The agent's version.
    pub agent_version: String,
    /// The kernel's host name.
    pub hostname: String,
    /// `x86_64`, `aarch64`, …
    pub arch: String,
    /// The MAC the robot was registered by.
    #[serde(default)]
    pub mac: Option<MacAddress>,
    /// ROS distributions found, for example `jazzy`.
    #[serde(default)]
    pub ros_distros: Vec<String>,
    /// Free bytes on the data directory's file system.
    #[serde(default)]
    pub disk_free_bytes: u64,
    /// How tasks meet ROS; absent where no ROS was found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ros: Option<RosFacts>,
    /// What keeps tasks from using more than their limits.
    #[serde(default)]
    pub isolation: Isolation,
    /// Under which accounts tasks run; absent: an agent that does not say.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "tolerant")]
    pub accounts: Option<TaskAccounts>,
    /// What is left of its battery; absent where it has none that can be read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub battery_percent: Option<u8>,
    /// The version of the list of publishers whose signatures it asks for; 0: it goes by its own
    /// settings. Absent: it runs whatever its server orders.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub publishers: Option<u64>,
    /// What holds of all that can be set for it; absent where everything is the agent's default.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "tolerant")]
    pub settings: Option<EffectiveSettings>,
}

/// How tasks on a robot meet ROS.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RosFacts {
    /// The distribution tasks use unless they require another, for example `jazzy`.
    pub distro: String,
    /// The middleware: `RMW_IMPLEMENTATION`, or the distribution's default. Absent with ROS 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rmw: Option<String>,
    /// `ROS_DOMAIN_ID`. Absent with ROS 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub domain_id: Option<u16>,
    /// Whether nodes are only found on the robot itself.
    #[serde(default)]
    pub localhost_only: bool,
}

/// What keeps tasks from using more than their limits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Isolation {
    /// A control group per task, with its controllers.
    Cgroup,
    /// Nothing, or something this version does not know.
    #[default]
    #[serde(other)]
    None,
}

/// Under which accounts tasks run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum TaskAccounts {
    /// Each task under its own; what was unpacked and built is read-only to it and verified before
    /// each start.
    PerTask,
    /// All under one, which may not change what was unpacked and built either.
    Shared,
    /// All under the agent's: nothing keeps a task from other tasks' files and processes, or from
    /// changing its own package.
    Agent,
}

/// A condition of the whole robot, with a stable code and a text for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Condition {
    /// For programs: `held`, `state_refused`, `step_failed`, …
    pub code: String,
    /// For people: what and where.
    pub text: String,
}

/// One task in a robot's ledger.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TaskReport {
    /// The task's name.
    pub task: TaskName,
    /// The order this entry is about.
    pub deployment: DeploymentId,
    /// The package it ordered.
    pub package: PackageRef,
    /// What the desired state last asked for.
    pub wanted: Wanted,
    /// The run last asked for.
    pub run: u64,
    /// Service or job; unknown until the task manifest is there.
    #[serde(default)]
    pub kind: Option<TaskKind>,
    /// Where it stands.
    pub phase: Phase,
    /// Milliseconds it has stood there.
    pub phase_ms: u64,
    /// How far the phase has come, where that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// While the package's parts are awaited: the first runs of those it lacks, at most
    /// [`crate::part::MAX_MISSING_RANGES`]. Empty: it listens and asks for nothing yet. Absent: it
    /// does not listen.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub missing_parts: Option<Vec<PartRange>>,
    /// Tries of the current phase, from 1.
    #[serde(default)]
    pub attempts: u32,
    /// Times the restart policy has started the process again in this run.
    #[serde(default)]
    pub restarts: u32,
    /// Why it failed, is unmet or deferred.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<Failure>,
    /// Why it runs, yet not as it should; it is a health of `running`, not a phase.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub degraded: Option<Failure>,
    /// The version whose process lives, which need not be the one ordered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub active: Option<ActiveVersion>,
}

impl TaskReport {
    /// Of a desired task that has just come into a phase and has nothing else to say.
    pub fn of(task: &DesiredTask, phase: Phase) -> Self {
        Self {
            task: task.task.clone(),
            deployment: task.deployment.clone(),
            package: task.package.clone(),
            wanted: task.wanted,
            run: task.run,
            kind: None,
            phase,
            phase_ms: 0,
            progress: None,
            missing_parts: None,
            attempts: 1,
            restarts: 0,
            failure: None,
            degraded: None,
            active: None,
        }
    }
}

/// The version of a task that is running.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ActiveVersion {
    /// The order that brought it.
    pub deployment: DeploymentId,
    /// Its version.
    pub version: Version,
    /// The digest of its manifest, as several may have one version. Older agents don't say it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub manifest: Option<Digest>,
    /// The task's process id on the robot.
    pub pid: u32,
}

/// How far a phase has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Progress {
    /// Bytes done.
    pub done: u64,
    /// Bytes in all.
    pub total: u64,
}

/// Where an assignment stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Ordered; the robot has not begun.
    Assigned,
    /// The package's bytes are being pulled.
    Fetching,
    /// They are being unpacked.
    Unpacking,
    /// The build tool runs.
    Building,
    /// Ready to start.
    Staged,
    /// The process has been started and is not ready yet.
    Starting,
    /// It runs and is ready.
    Running,
    /// A job ran to its end with exit code 0.
    Succeeded,
    /// It ended, or could not go on; see the failure.
    Failed,
    /// It was asked to stop, and has.
    Stopped,
    /// This robot can't run it.
    Unmet,
    /// Not now; it is tried again.
    Deferred,
    /// A newer deployment of the same task took its place.
    Superseded,
    /// The operator took it back.
    Cancelled,
    /// It was not done in time.
    Expired,
    /// The new version did not get ready, the old one runs again.
    RolledBack,
    /// Written by a newer version of the other side.
    #[serde(other)]
    Unknown,
}

impl Phase {
    /// Every phase that this version writes, in the order of a life.
    pub const ALL: [Self; 16] = [
        Self::Assigned,
        Self::Fetching,
        Self::Unpacking,
        Self::Building,
        Self::Staged,
        Self::Starting,
        Self::Running,
        Self::Succeeded,
        Self::Failed,
        Self::Stopped,
        Self::Unmet,
        Self::Deferred,
        Self::Superseded,
        Self::Cancelled,
        Self::Expired,
        Self::RolledBack,
    ];

    /// The phase as it is written on the wire and in the database.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Assigned => "assigned",
            Self::Fetching => "fetching",
            Self::Unpacking => "unpacking",
            Self::Building => "building",
            Self::Staged => "staged",
            Self::Starting => "starting",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Stopped => "stopped",
            Self::Unmet => "unmet",
            Self::Deferred => "deferred",
            Self::Superseded => "superseded",
            Self::Cancelled => "cancelled",
            Self::Expired => "expired",
            Self::RolledBack => "rolled_back",
            Self::Unknown => "unknown",
        }
    }

    /// Reads what [`Phase::as_str`] wrote; anything else is `Unknown`.
    pub fn from_text(text: &str) -> Self {
        Self::ALL.into_iter().find(|phase| phase.as_str() == text).unwrap_or(Self::Unknown)
    }

    /// Whether nothing more will happen without a new order.
    pub fn is_final(self) -> bool {
        matches!(
            self,
            Self::Succeeded
                | Self::Failed
                | Self::Stopped
                | Self::Unmet
                | Self::Superseded
                | Self::Cancelled
                | Self::Expired
                | Self::RolledBack
        )
    }

    /// Whether someone who waits for the order may go: it is final, or a service runs.
    pub fn is_settled(self, kind: TaskKind) -> bool {
        self.is_final() || (self == Self::Running && kind == TaskKind::Service)
    }

    /// Whether a settled order did what it was meant to.
    pub fn is_success(self, kind: TaskKind) -> bool {
        match kind {
            TaskKind::Service => self == Self::Running,
            TaskKind::Job => self == Self::Succeeded,
        }
    }
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

/// Why something failed: a stable code for programs and a text that says what and where.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Failure {
    /// For programs.
    pub code: FailureCode,
    /// For people.
    pub text: String,
}

impl Failure {
    /// A failure with `code` and `text`; control characters, which a package could smuggle in,
    /// become spaces.
    pub fn new(code: FailureCode, text: impl Into<String>) -> Self {
        Self { code, text: clean(&text.into(), MAX_FAILURE_CHARS) }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.code.0, self.text)
    }
}

/// A failure's stable code. Codes of newer versions pass through unchanged; of what is none, only
/// what could be one is kept.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(value_type = String, example = "process_exited"))]
#[serde(from = "String")]
pub struct FailureCode(Cow<'static, str>);

/// The longest code that is read.
const MAX_CODE_BYTES: usize = 64;

/// Declares the failure codes this version gives.
macro_rules! failure_codes {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {
        impl FailureCode {
            $($(#[$doc])* pub const $name: Self = Self(Cow::Borrowed($text));)*
        }
    };
}

failure_codes! {
    /// Too little disk for blob, tree, build and reserve.
    DISK_FULL = "disk_full";
    /// The bytes do not hash to the digest that was ordered.
    DIGEST_MISMATCH = "digest_mismatch";
    /// The package can't be had from the server: deleted, or access refused.
    PACKAGE_UNAVAILABLE = "package_unavailable";
    /// The server can't be reached, is overloaded, or something else answers in its place.
    SERVER_UNREACHABLE = "server_unreachable";
    /// The server does not accept the robot's token.
    UNAUTHORIZED = "unauthorized";
    /// The task manifest does not parse or contradicts the order.
    MANIFEST_INVALID = "manifest_invalid";
    /// An archive entry that is not allowed, or more of them than the limits.
    ARCHIVE_REFUSED = "archive_refused";
    /// The build tool failed or took too long.
    BUILD_FAILED = "build_failed";
    /// The robot lacks what the package requires.
    REQUIREMENTS_UNMET = "requirements_unmet";
    /// The process could not be started.
    START_FAILED = "start_failed";
    /// The process ended with a code or by a signal.
    PROCESS_EXITED = "process_exited";
    /// It was not ready within its time.
    NOT_READY = "not_ready";
    /// A node or service of that name was on the graph before the task was started.
    NODE_NAME_TAKEN = "node_name_taken";
    /// A node does not accept a parameter of the package.
    PARAMETER_REJECTED = "parameter_rejected";
    /// A lifecycle node refused a transition or failed in it.
    LIFECYCLE_FAILED = "lifecycle_failed";
    /// A node that was ready left the graph.
    NODE_VANISHED = "node_vanished";
    /// A lifecycle node that was active is so no more.
    NODE_INACTIVE = "node_inactive";
    /// A topic lost its publisher, or carries less than it should.
    TOPIC_SILENT = "topic_silent";
    /// A service that was ready does not answer any more.
    SERVICE_LOST = "service_lost";
    /// The robot's ROS graph can't be watched.
    GRAPH_UNAVAILABLE = "graph_unavailable";
    /// The task used more memory than its limit.
    OUT_OF_MEMORY = "out_of_memory";
    /// The robot has no user to run tasks as.
    NO_TASK_USER = "no_task_user";
    /// What is on the robot's disk of a package is not what was unpacked and built: it was not
    /// started.
    TREE_CHANGED = "tree_changed";
    /// The robot's gate said not now.
    GATE_REFUSED = "gate_refused";
    /// The robot's gate hung, crashed or could not be run.
    GATE_FAILED = "gate_failed";
    /// Files that were to come back did not.
    OUTPUTS_LOST = "outputs_lost";
    /// A job's process was gone after a restart of robot or agent.
    INTERRUPTED = "interrupted";
    /// A step did not end within its deadline.
    DEADLINE_EXCEEDED = "deadline_exceeded";
    /// The robot's disk or system refused an operation.
    IO_ERROR = "io_error";
    /// A person at the robot said `hold`.
    HELD = "held";
    /// Too few of the publishers that the robot trusts have signed the package, or it was
    /// withdrawn.
    UNTRUSTED_PACKAGE = "untrusted_package";
    /// The robot's list of publishers is past its lifetime, or it has none and must have one.
    PUBLISHERS_EXPIRED = "publishers_expired";
}

impl FailureCode {
    /// The code as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl From<String> for FailureCode {
    fn from(text: String) -> Self {
        let fits = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        if text.len() <= MAX_CODE_BYTES && text.chars().all(fits) {
            return Self(Cow::Owned(text));
        }
        Self(Cow::Owned(text.chars().filter(|c| fits(*c)).take(MAX_CODE_BYTES).collect()))
    }
}

/// A robot's connection state, published by the robot and, with `online` false, by its last will.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Whether the robot is connected.
    pub online: bool,
    /// The agent's start counter, as in [`Report::start`].
    pub start: u64,
    /// The agent's instance.
    pub instance: InstanceId,
    /// Counts this instance's connections from 1; a status with a lower one is out of date.
    pub connection: u64,
    /// Where it runs, as in [`Report::place`].
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "tolerant")]
    pub place: Option<Digest>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phases_are_the_same_text_everywhere() {
        for phase in Phase::ALL {
            assert_eq!(serde_json::to_value(phase).expect("json"), phase.as_str());
            assert_eq!(Phase::from_text(phase.as_str()), phase);
        }
        assert_eq!(
            serde_json::from_str::<Phase>("\"levitating\"").expect("tolerated"),
            Phase::Unknown
        );
    }

    #[test]
    fn a_code_is_a_word_whatever_comes() {
        let read =
            |text: &str| serde_json::from_value::<FailureCode>(text.into()).expect("tolerated");
        assert_eq!(read("disk_full"), FailureCode::DISK_FULL);
        assert_eq!(read("untrusted_package_2").as_str(), "untrusted_package_2");
        assert_eq!(read("\u{1b}[31mDisk\nfull <b>").as_str(), "31miskfullb");
        assert_eq!(read(&"x".repeat(1 << 20)).as_str().len(), MAX_CODE_BYTES);
        assert_eq!(serde_json::to_value(read("disk_full")).expect("json"), "disk_full");
    }

    #[test]
    fn running_settles_a_service_but_not_a_job() {
        assert!(Phase::Running.is_settled(TaskKind::Service));
        assert!(!Phase::Running.is_settled(TaskKind::Job));
        assert!(Phase::Succeeded.is_success(TaskKind::Job));
        assert!(!Phase::Succeeded.is_success(TaskKind::Service));
    }
}
