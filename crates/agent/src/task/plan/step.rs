//! The steps: the lane, the time limit, the purpose and the outcome of each. What a step changes in
//! the record is in the module of its subject. Pure.

use std::time::Duration;

use task_proto::desired::{DesiredTask, PackageRef, TargetState};
use task_proto::messages::report::Failure;
use task_proto::{DeploymentId, Digest, TaskName};

use crate::task::ledger::{GateQuestion, OutputUpload, TaskRecord};
use crate::task::run::ActiveRun;

/// Time limit of a step in which each part has a shorter limit of its own.
const STEP_DEADLINE_S: u64 = 120;
/// Time limit for reading a whole version: the largest permitted version on a slow card.
const VERIFY_DEADLINE_S: u64 = 900;
/// Time limit for deletion: many small files on a slow card.
const DELETE_DEADLINE_S: u64 = 600;

/// One unit of work on a task.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// Check that enough of the trusted publishers have signed the package.
    CheckSigners(PackageRef),
    /// Pull the package's manifest, which has the rules for its build and its runs.
    PullManifest(PackageRef),
    /// Inspect the installed ROS distributions, to decide whether the version can run here.
    ProbeRos(PackageRef),
    /// Fetch and unpack the content. Parts that the server pushes are gathered; the rest is pulled.
    PullContent {
        /// The package to fetch.
        package: PackageRef,
        /// Whether the server pushes the content.
        is_pushed: bool,
    },
    /// Build the unpacked package, whose tree never changes afterwards.
    Build {
        package: PackageRef,
        /// The deployment whose run needs the build.
        deployment: DeploymentId,
    },
    /// Ask the robot's gate.
    QueryGate(GateQuestion),
    /// Make this run the active run and start a process of the run.
    Start(Box<ActiveRun>),
    /// Stop the process of this run, which is the active run.
    Stop(Box<ActiveRun>),
    /// Upload the output files of an ended run to the server.
    UploadOutputs(Box<OutputUpload>),
    /// Delete the versions that are not in `kept`.
    Prune {
        /// The versions that stay.
        kept: Vec<Digest>,
    },
    /// Delete the task with all its files and its record.
    Remove,
}

/// The lane of a step. A lane has at most one step of a task under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Lane {
    /// Brings the ordered version to `staged`. May take long and may be interrupted at any point.
    Prepare,
    /// Starts and stops processes, deletes versions and tasks.
    Run,
    /// Asks the robot's gate. The live run is supervised meanwhile.
    Gate,
    /// Uploads the output files of ended runs to the server.
    Upload,
}

/// The result of a step that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Done {
    /// The step is complete.
    Complete,
    /// A process was started; holds its process id.
    Started(u32),
    /// The server told this robot to come back later. This counts neither as a failure nor as an
    /// attempt.
    RetryLater {
        /// The shortest wait in milliseconds.
        at_least_ms: u64,
    },
}

/// A step that did not succeed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StepFailure {
    pub failure: Failure,
    /// The shortest wait in milliseconds before a retry; `None`: a retry can never succeed.
    pub retry_after_ms: Option<u64>,
}

/// The end of a step.
pub type Outcome = Result<Done, StepFailure>;

impl Lane {
    /// All lanes, in planning order.
    pub const ALL: [Self; 4] = [Self::Run, Self::Prepare, Self::Gate, Self::Upload];
}

impl Step {
    /// The lane that this step runs in.
    pub fn lane(&self) -> Lane {
        match self {
            Self::CheckSigners(_)
            | Self::PullManifest(_)
            | Self::ProbeRos(_)
            | Self::PullContent { .. }
            | Self::Build { .. } => Lane::Prepare,
            Self::Start(_) | Self::Stop(_) | Self::Prune { .. } | Self::Remove => Lane::Run,
            Self::QueryGate(_) => Lane::Gate,
            Self::UploadOutputs(_) => Lane::Upload,
        }
    }

    /// The package that a step of [`Lane::Prepare`] prepares.
    pub fn prepares(&self) -> Option<&PackageRef> {
        match self {
            Self::CheckSigners(package)
            | Self::PullManifest(package)
            | Self::ProbeRos(package)
            | Self::PullContent { package, .. }
            | Self::Build { package, .. } => Some(package),
            _ => None,
        }
    }

    /// The time limit of the step. Transfers have none, because a large package on a bad link takes
    /// its time: they watch for stalls instead. Builds have limits of their own.
    pub fn deadline(&self) -> Option<Duration> {
        let seconds = match self {
            Self::PullContent { .. } | Self::Build { .. } | Self::UploadOutputs(_) => return None,
            Self::CheckSigners(_) | Self::PullManifest(_) | Self::ProbeRos(_) => STEP_DEADLINE_S,
            Self::Start(_) => STEP_DEADLINE_S + VERIFY_DEADLINE_S,
            // The gate's own, shorter limit is a setting.
            Self::QueryGate(_) => STEP_DEADLINE_S + crate::config::MAX_GATE_TIMEOUT_S,
            Self::Stop(run) => STEP_DEADLINE_S + 2 * u64::from(run.rules.stop_timeout_s),
            Self::Prune { .. } | Self::Remove => DELETE_DEADLINE_S,
        };
        Some(Duration::from_secs(seconds))
    }

    /// Whether the step deletes versions, so that no version may be prepared meanwhile.
    pub fn deletes(&self) -> bool {
        matches!(self, Self::Prune { .. } | Self::Remove)
    }

    /// Whether this step, already under way, still serves the desired state. If not, the step is
    /// interrupted. Steps of [`Lane::Run`] are short and always finish.
    pub fn is_wanted(&self, desired: Option<&DesiredTask>, record: Option<&TaskRecord>) -> bool {
        if let Some(package) = self.prepares() {
            let record = record.filter(|record| desired == Some(&record.order));
            let restored = record.and_then(TaskRecord::run_to_restore);
            return desired.is_some_and(|task| {
                let (wanted, pushes) = match restored {
                    Some((run, _)) => (&run.package, false),
                    None => (&task.package, task.delivery.is_pushed()),
                };
                let by_same_way = match self {
                    Self::PullContent { is_pushed, .. } => *is_pushed == pushes,
                    _ => true,
                };
                task.wanted == TargetState::Running && package == wanted && by_same_way
            });
        }
        match self {
            Self::QueryGate(question) => record
                .and_then(|record| record.gate.as_ref())
                .is_some_and(|gate| gate.question == *question),
            Self::UploadOutputs(_) => desired.is_some(),
            _ => true,
        }
    }
}

/// The log line that names a step.
pub fn describe(task: &TaskName, step: &Step) -> String {
    match step {
        Step::CheckSigners(package) => format!("check the signers of {task} {}", package.version),
        Step::PullManifest(package) => format!("pull the manifest of {task} {}", package.version),
        Step::ProbeRos(package) => {
            format!("find ROS for {task} {}", package.version)
        }
        Step::PullContent { package, is_pushed: false } => {
            format!("pull {task} {}", package.version)
        }
        Step::PullContent { package, is_pushed: true } => {
            format!("gather {task} {}", package.version)
        }
        Step::Build { package, .. } => format!("build {task} {}", package.version),
        Step::QueryGate(question) => format!("ask the gate about {task} {}", question.version),
        Step::Start(run) => format!("start {task} {} (run {})", run.package.version, run.run),
        Step::Stop(_) => format!("stop {task}"),
        Step::UploadOutputs(files) => {
            format!(
                "upload the output files of {task} {} (run {})",
                files.package.version, files.run
            )
        }
        Step::Prune { .. } => format!("delete old versions of {task}"),
        Step::Remove => format!("remove {task}"),
    }
}
