//! Reports of a robot: whole snapshots of its tasks, ordered by (start, seq), and its connection
//! status. Times are elapsed milliseconds, because a robot's clock may be wrong.

mod tidy;

use std::borrow::Cow;
use std::fmt;

use serde::{Deserialize, Serialize};

use self::tidy::{MAX_FAILURE_CHARS, clean};
use crate::desired::settings::{EffectiveSettings, default_if_unreadable};
use crate::desired::{DesiredTask, PackageRef, TargetState};
use crate::messages::part::PartRange;
use crate::packages::manifest::TaskKind;
use crate::{DeploymentId, Digest, Generation, InstanceId, MacAddress, RobotId, TaskName, Version};

/// The largest report, in bytes of JSON, over MQTT or HTTP.
pub const MAX_REPORT_BYTES: usize = 1024 * 1024;

/// A robot's whole state. A later report replaces an earlier one, in the order of (start, seq).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Report {
    /// The robot that sent the report.
    pub robot_id: RobotId,
    /// Number of times this robot's agent has started, from 1; kept in the agent's ledger.
    pub start: u64,
    /// Identity of this start of the agent. Two live instances mean a cloned identity.
    pub instance: InstanceId,
    /// Where this instance runs: one data directory, during one boot of one machine. Of two starts
    /// in the same place, the second began after the first had ended. Absent: an agent too old to
    /// report it.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "default_if_unreadable"
    )]
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
    /// All unusual conditions of the robot as a whole.
    #[serde(default)]
    pub conditions: Vec<Condition>,
    /// Measurements of the robot's connection to the server, once there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkFacts>,
    /// All tasks in the ledger, sorted by name.
    pub tasks: Vec<TaskReport>,
}

impl Report {
    /// The condition of a robot that received its accepted generation again with other content.
    pub const STATE_CONTRADICTED: &str = "state_contradicted";

    /// The generation that the robot has reached. Of two states with one generation, the accepted
    /// one counts as the later: the other comes from a server whose database was restored from an
    /// older copy.
    pub fn reached_generation(&self) -> Generation {
        let is_contradicted =
            self.conditions.iter().any(|condition| condition.code == Self::STATE_CONTRADICTED);
        Generation(self.observed_generation.0.saturating_add(u64::from(is_contradicted)))
    }
}

/// Measurements of a robot's connection to the server, from earlier transfers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct LinkFacts {
    /// Moving average over fetches; absent before the first fetch long enough to measure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub throughput_bytes_per_s: Option<u64>,
    /// Moving average of the time from a request to the first byte of its answer; absent before the
    /// first answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rtt_ms: Option<u32>,
    /// Sessions lost in the last hour.
    pub reconnects: u32,
    /// Transfers that broke off in the last hour.
    pub losses: u32,
}

/// Facts that the agent found out about its machine.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct HostFacts {
    /// The agent's version.
    pub agent_version: String,
    /// The kernel's host name.
    pub hostname: String,
    /// `x86_64`, `aarch64`, …
    pub arch: String,
    /// The MAC address that the robot was registered by.
    #[serde(default)]
    pub mac: Option<MacAddress>,
    /// ROS distributions found, for example `jazzy`.
    #[serde(default)]
    pub ros_distros: Vec<String>,
    /// Free bytes on the data directory's file system.
    #[serde(default)]
    pub disk_free_bytes: u64,
    /// ROS configuration of tasks; absent if no ROS was found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ros: Option<RosFacts>,
    /// The mechanism that enforces the tasks' resource limits.
    #[serde(default)]
    pub isolation: Isolation,
    /// The accounts that tasks run under; absent: an older agent that does not report them.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "default_if_unreadable"
    )]
    pub accounts: Option<TaskAccounts>,
    /// Battery charge in percent; absent without a readable battery.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub battery_percent: Option<u8>,
    /// Version of the publisher list that the robot requires signatures from; 0: the robot follows
    /// its own settings. Absent: the robot runs every package that its server orders.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub publishers: Option<u64>,
    /// Settings in effect on the robot; absent if all are the agent's defaults.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "default_if_unreadable"
    )]
    pub settings: Option<EffectiveSettings>,
}

/// ROS configuration of tasks on a robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RosFacts {
    /// The distribution that tasks use unless they require another, for example `jazzy`.
    pub distro: String,
    /// The middleware: `RMW_IMPLEMENTATION`, or the distribution's default. Absent with ROS 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rmw: Option<String>,
    /// `ROS_DOMAIN_ID`. Absent with ROS 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub domain_id: Option<u16>,
    /// Whether nodes are discovered only on the robot itself.
    #[serde(default)]
    pub localhost_only: bool,
}

/// The mechanism that enforces the tasks' resource limits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Isolation {
    /// A control group per task, with its controllers.
    Cgroup,
    /// No mechanism, or one unknown to this version.
    #[default]
    #[serde(other)]
    None,
}

/// The accounts that tasks run under.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum TaskAccounts {
    /// Each task has its own account; the unpacked and built files are read-only to the task and
    /// verified before each start.
    PerTask,
    /// All tasks share one account, which also may not change the unpacked and built files.
    Shared,
    /// All tasks run under the agent's account: a task can reach other tasks' files and processes,
    /// and change its own package.
    Agent,
}

/// A condition of the whole robot, with a stable code and a text for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Condition {
    /// For programs: `held`, `state_refused`, `step_failed`, …
    pub code: String,
    /// Description for people, with the cause and the place.
    pub text: String,
}

/// One task in a robot's ledger.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TaskReport {
    /// The task's name.
    pub task: TaskName,
    /// The deployment of this entry.
    pub deployment: DeploymentId,
    /// The package that the deployment ordered.
    pub package: PackageRef,
    /// Whether the task should run, by the latest desired state.
    pub wanted: TargetState,
    /// The run requested last.
    pub run: u64,
    /// Service or job; unknown until the task manifest has been fetched.
    #[serde(default)]
    pub kind: Option<TaskKind>,
    /// The current phase.
    pub phase: Phase,
    /// Milliseconds spent in this phase.
    pub phase_ms: u64,
    /// Progress within the phase, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// While the robot awaits the package's parts: the first ranges of missing parts, at most
    /// [`super::part::MAX_MISSING_RANGES`]. Empty: the robot listens and requests nothing yet.
    /// Absent: the robot does not listen.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub missing_parts: Option<Vec<PartRange>>,
    /// Attempts in the current phase, from 1.
    #[serde(default)]
    pub attempts: u32,
    /// Times the restart policy has restarted the process in this run.
    #[serde(default)]
    pub restarts: u32,
    /// Why the task failed, is unmet or is deferred.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<Failure>,
    /// Why the running task is degraded; this is a health of `running`, not a phase.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub degraded: Option<Failure>,
    /// The version with a live process, which may differ from the ordered one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub active: Option<ActiveVersion>,
}

impl TaskReport {
    /// The report of a desired task that has just entered a phase, with all other fields empty.
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
    /// The deployment that installed this version.
    pub deployment: DeploymentId,
    /// The version that runs.
    pub version: Version,
    /// Digest of the package manifest, because several packages may share one version. Older agents
    /// omit this field.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub manifest: Option<Digest>,
    /// The task's process id on the robot.
    pub pid: u32,
}

/// Progress within a phase.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Progress {
    /// Bytes done.
    pub done: u64,
    /// Bytes in all.
    pub total: u64,
}

/// State of an assignment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Ordered; the robot has not started.
    Assigned,
    /// The package's bytes are being pulled.
    Fetching,
    /// The package is being unpacked.
    Unpacking,
    /// The build tool is running.
    Building,
    /// The package is ready to start.
    Staged,
    /// The process has been started and is not ready yet.
    Starting,
    /// The process runs and is ready.
    Running,
    /// A job ran to its end with exit code 0.
    Succeeded,
    /// The process ended, or the task could not continue; see the failure.
    Failed,
    /// The task was stopped on request.
    Stopped,
    /// This robot can't run the task.
    Unmet,
    /// Put off for now; the robot will retry.
    Deferred,
    /// A newer deployment of the same task replaced this one.
    Superseded,
    /// An operator cancelled the deployment.
    Cancelled,
    /// The assignment was not done in time.
    Expired,
    /// The new version did not become ready; the old version runs again.
    RolledBack,
    /// A phase unknown to this version, written by a newer peer.
    #[serde(other)]
    Unknown,
}

impl Phase {
    /// Every phase that this version writes, in life-cycle order.
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

    /// Parses the text written by [`Phase::as_str`]; any other text becomes `Unknown`.
    pub fn from_text(text: &str) -> Self {
        Self::ALL.into_iter().find(|phase| phase.as_str() == text).unwrap_or(Self::Unknown)
    }

    /// Whether the phase is final: nothing more will happen without a new order.
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

    /// Whether a client may stop waiting for the order: the phase is final, or a service runs.
    pub fn is_settled(self, kind: TaskKind) -> bool {
        self.is_final() || (self == Self::Running && kind == TaskKind::Service)
    }

    /// Whether a settled order succeeded.
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

/// Why something failed: a stable code for programs and a text for people with the cause and the
/// place.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Failure {
    /// Stable code, for programs.
    pub code: FailureCode,
    /// Description, for people.
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

/// A failure's stable code. Codes of newer versions pass through unchanged; invalid text is reduced
/// to the characters and length that a code may have.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(
    feature = "openapi",
    derive(utoipa::ToSchema),
    schema(value_type = String, example = "process_exited")
)]
#[serde(from = "String")]
pub struct FailureCode(Cow<'static, str>);

/// The longest code that we accept, in bytes.
const MAX_CODE_BYTES: usize = 64;

/// Declares the failure codes that this version emits.
macro_rules! failure_codes {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {
        impl FailureCode {
            $($(#[$doc])* pub const $name: Self = Self(Cow::Borrowed($text));)*
        }
    };
}

failure_codes! {
    /// Too little disk space for blob, tree, build and reserve.
    DISK_FULL = "disk_full";
    /// The bytes do not hash to the ordered digest.
    DIGEST_MISMATCH = "digest_mismatch";
    /// The package can't be fetched from the server: deleted, or access refused.
    PACKAGE_UNAVAILABLE = "package_unavailable";
    /// The server can't be reached or is overloaded, or another program answers in its place.
    SERVER_UNREACHABLE = "server_unreachable";
    /// The server does not accept the robot's token.
    UNAUTHORIZED = "unauthorized";
    /// The task manifest does not parse or contradicts the order.
    MANIFEST_INVALID = "manifest_invalid";
    /// An archive entry is not allowed, or the archive exceeds the limits.
    ARCHIVE_REFUSED = "archive_refused";
    /// The build tool failed or took too long.
    BUILD_FAILED = "build_failed";
    /// The robot does not meet the package's requirements.
    REQUIREMENTS_UNMET = "requirements_unmet";
    /// The process could not be started.
    START_FAILED = "start_failed";
    /// The process ended with a code or by a signal.
    PROCESS_EXITED = "process_exited";
    /// The task was not ready within its time limit.
    NOT_READY = "not_ready";
    /// A node or service of that name was on the graph before the task started.
    NODE_NAME_TAKEN = "node_name_taken";
    /// A node does not accept a parameter of the package.
    PARAMETER_REJECTED = "parameter_rejected";
    /// A lifecycle node refused a transition or failed in it.
    LIFECYCLE_FAILED = "lifecycle_failed";
    /// A node that was ready left the graph.
    NODE_VANISHED = "node_vanished";
    /// A lifecycle node that was active is no longer active.
    NODE_INACTIVE = "node_inactive";
    /// A topic lost its publisher, or carries fewer messages than it should.
    TOPIC_SILENT = "topic_silent";
    /// A service that was ready no longer answers.
    SERVICE_LOST = "service_lost";
    /// The robot's ROS graph can't be watched.
    GRAPH_UNAVAILABLE = "graph_unavailable";
    /// The task used more memory than its limit.
    OUT_OF_MEMORY = "out_of_memory";
    /// The robot has no user to run tasks as.
    NO_TASK_USER = "no_task_user";
    /// The package's files on disk differ from the unpacked and built files, so the task was not
    /// started.
    TREE_CHANGED = "tree_changed";
    /// The robot's gate refused the action for now.
    GATE_REFUSED = "gate_refused";
    /// The robot's gate hung, crashed or could not be run.
    GATE_FAILED = "gate_failed";
    /// Output files of the task were not uploaded.
    OUTPUTS_LOST = "outputs_lost";
    /// A job's process was gone after a restart of the robot or the agent.
    INTERRUPTED = "interrupted";
    /// A step did not end within its deadline.
    DEADLINE_EXCEEDED = "deadline_exceeded";
    /// The robot's disk or system refused an operation.
    IO_ERROR = "io_error";
    /// A person at the robot has set a hold.
    HELD = "held";
    /// Too few publishers that the robot trusts have signed the package, or the package was
    /// withdrawn.
    UNTRUSTED_PACKAGE = "untrusted_package";
    /// The robot's list of publishers has expired, or the robot has none and must have one.
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
    /// Counts this instance's connections from 1; a status with a lower count is out of date.
    pub connection: u64,
    /// Where the agent runs, as in [`Report::place`].
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "default_if_unreadable"
    )]
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
    fn failure_code_is_reduced_to_valid_characters() {
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
