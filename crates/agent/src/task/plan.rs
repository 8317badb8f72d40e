//! The plan decides the next step for one task. The plan is pure: desired state, ledger record and
//! observation go in, the next step comes out. Time and randomness are arguments. The plan never
//! touches disk, network or processes.
//!
//! Two state machines run side by side. The first prepares an ordered version while the previous
//! version keeps running:
//!
//! ```text
//! assigned ─► fetching ─► unpacking ─► building ─► staged ──► (handed to the active run)
//!     │           └──────────┴────────────┴──► failed           ▲ deferred: a person holds the robot,
//!     └► unmet    a retry waits in its phase                      or its gate says not now
//! ```
//!
//! The second keeps one run of one version alive:
//!
//! ```text
//! starting ─► running ─► succeeded | failed | stopped
//!     ▲ │         │
//!     │ │         └─ degraded for too long: stopped, and as if it had ended
//!     │ └─ not ready in time, refused: stopped, then failed or, with a good run before it, rolled_back
//!     └── restart policy, reboot: after a backoff
//! ```
//!
//! A staged version takes over in three steps: the old process is stopped, `current` is swapped,
//! the new process is started. The old run stays in the record until the new run is ready. If the
//! new run never becomes ready, the old run becomes the active run again and the order ends as
//! `rolled_back`. Each state machine has at most one step under way ([`Lane`]). Only the second one
//! starts processes, so a task never has two.

use std::time::Duration;

use task_proto::desired::{DesiredTask, PackageRef, Wanted};
use task_proto::report::{Failure, FailureCode, Phase};
use task_proto::{Digest, TaskName};

use crate::task::ledger::MAX_RESTARTS_IN_A_ROW;
use crate::task::ledger::{
    ActiveRun, Collection, GateQuestion, ProcessRecord, RunRules, TaskRecord,
};
use crate::task::observed::{Health, Prepared, ProcessState, RobotFacts, Vouched};
use gate::Verdict;

mod alive;
mod collect;
mod gate;
#[cfg(test)]
mod tests;
mod transition;

pub use collect::collect;
pub use gate::consult;
pub use transition::{Done, StepFailure, adopted, backoff_ms, begun, finished};

/// All inputs of the decision about the next step.
#[derive(Debug, Clone, Copy)]
pub struct Situation<'a> {
    /// The task in the accepted desired state; `None`: the task should be absent.
    pub desired: Option<&'a DesiredTask>,
    /// The task's record in the ledger.
    pub record: &'a TaskRecord,
    /// The files of the ordered version on the disk.
    pub prepared: &'a Prepared,
    /// The observed state of the active run's process.
    pub process: &'a ProcessState,
    /// The health of the active run on the ROS graph while its process lives.
    pub health: &'a Health,
    /// Whether a step of [`Lane::Prepare`] is under way.
    pub preparing: bool,
    /// Whether a step of [`Lane::Run`] is under way.
    pub acting: bool,
    /// Whether a step of [`Lane::Collect`] is under way.
    pub collecting: bool,
    /// Whether a step that deletes versions is under way.
    pub deleting: bool,
    /// Facts about the robot that packages may require.
    pub robot: &'a RobotFacts,
    /// Whether new work may begin: the desired state is in force and the server knows the robot.
    pub may_begin: bool,
    /// A person at the robot said `hold`.
    pub held: bool,
    /// Whether the robot has a gate to ask.
    pub gated: bool,
    /// The kernel's boot id.
    pub boot_id: &'a str,
    /// Milliseconds since boot.
    pub now_ms: u64,
    /// Uniform from 0 to 1; spreads the retries.
    pub jitter: f64,
}

/// The decision of the plan.
#[derive(Debug, Clone, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "it is taken apart where it is made")]
pub enum Next {
    /// Do nothing before this time, or before something changes.
    Rest {
        /// Milliseconds since boot.
        until_ms: Option<u64>,
    },
    /// Write this record, then plan again.
    Record(Box<TaskRecord>),
    /// Write [`begun`], do this step, write [`finished`], then plan again.
    Act(Step),
}

/// One unit of work on a task.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// Check that enough of the trusted publishers have signed the package.
    CheckSigners(PackageRef),
    /// Pull the manifest.
    PullManifest(PackageRef),
    /// Inspect the installed ROS distributions, to decide whether the version can run here.
    LookForRos(PackageRef),
    /// Fetch and unpack the content. Parts that the server pushes are gathered; the rest is pulled.
    PullContent {
        /// The package to fetch.
        package: PackageRef,
        /// Whether the server pushes the content.
        is_pushed: bool,
    },
    /// Build the package.
    Build(PackageRef),
    /// Ask the robot's gate.
    Ask(GateQuestion),
    /// Make this run the active run and start a process of the run.
    Start(Box<ActiveRun>),
    /// Stop the process of this run, which is the active run.
    Stop(Box<ActiveRun>),
    /// Upload the output files of an ended run to the server.
    Collect(Box<Collection>),
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
    Collect,
}

impl Lane {
    /// All lanes, in planning order.
    pub const ALL: [Self; 4] = [Self::Run, Self::Prepare, Self::Gate, Self::Collect];
}

impl Step {
    /// The lane that this step runs in.
    pub fn lane(&self) -> Lane {
        match self {
            Self::CheckSigners(_)
            | Self::PullManifest(_)
            | Self::LookForRos(_)
            | Self::PullContent { .. }
            | Self::Build(_) => Lane::Prepare,
            Self::Start(_) | Self::Stop(_) | Self::Prune { .. } | Self::Remove => Lane::Run,
            Self::Ask(_) => Lane::Gate,
            Self::Collect(_) => Lane::Collect,
        }
    }

    /// The time limit of the step. Transfers have none, because a large package on a bad link takes
    /// its time: they watch for stalls instead. Builds have limits of their own.
    pub fn deadline(&self) -> Option<Duration> {
        let seconds = match self {
            Self::PullContent { .. } | Self::Build(_) | Self::Collect(_) => return None,
            Self::CheckSigners(_) | Self::PullManifest(_) | Self::LookForRos(_) => STEP_DEADLINE_S,
            Self::Start(_) => STEP_DEADLINE_S + VERIFY_DEADLINE_S,
            // The gate's own, shorter limit is a setting.
            Self::Ask(_) => STEP_DEADLINE_S + crate::config::MAX_GATE_TIMEOUT_S,
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
        match self {
            Self::Ask(question) => record
                .and_then(|record| record.gate.as_ref())
                .is_some_and(|gate| gate.question == *question),
            Self::CheckSigners(package)
            | Self::PullManifest(package)
            | Self::LookForRos(package)
            | Self::Build(package) => desired
                .is_some_and(|task| task.wanted == Wanted::Running && task.package == *package),
            Self::PullContent { package, is_pushed } => desired.is_some_and(|task| {
                let is_same = task.package == *package && task.delivery.is_pushed() == *is_pushed;
                task.wanted == Wanted::Running && is_same
            }),
            Self::Collect(_) => desired.is_some(),
            Self::Start(_) | Self::Stop(_) | Self::Prune { .. } | Self::Remove => true,
        }
    }
}

/// Time limit of a step in which each part has a shorter limit of its own.
const STEP_DEADLINE_S: u64 = 120;
/// Time limit for reading a whole version: the largest permitted version on a slow card.
const VERIFY_DEADLINE_S: u64 = 900;
/// Time limit for deletion: many small files on a slow card.
const DELETE_DEADLINE_S: u64 = 600;
/// After this time without an end, a run is calm and its restart count is reset.
pub const CALM_MS: u64 = 10 * 60 * 1000;

/// Interval between observations of a process while its state cannot be determined.
pub const LOOK_AGAIN_MS: u64 = 5000;

/// Orders the tasks for scarce resources: by descending priority, then by name.
pub fn in_turn(mut tasks: Vec<(TaskName, i32)>) -> Vec<TaskName> {
    tasks.sort_by(|(name, priority), (other, other_priority)| {
        other_priority.cmp(priority).then(name.cmp(other))
    });
    tasks.dedup_by(|(name, _), (other, _)| name == other);
    tasks.into_iter().map(|(name, _)| name).collect()
}

/// The next step for the active run: start, restart, stop, replace, remove.
pub fn supervise(s: &Situation<'_>) -> Next {
    if let Some(order) = s.desired
        && *order != s.record.order
    {
        return record(adopted(s.record, order, s.now_ms));
    }
    let Some(active) = &s.record.active else { return without_process(s, None) };
    let Some(process) = &active.process else { return without_process(s, Some(active)) };
    match s.process {
        ProcessState::Alive { .. } => with_process(s, active, process),
        // This process may still live, so we must not start another.
        ProcessState::Unknown => Next::Rest { until_ms: Some(s.now_ms + LOOK_AGAIN_MS) },
        ProcessState::Ended(exit) => record(transition::ended(s, exit)),
        ProcessState::NeverStarted | ProcessState::None => record(transition::never_started(s)),
    }
}

/// The next step towards `staged` for the ordered version.
pub fn prepare(s: &Situation<'_>) -> Next {
    const NOTHING: Next = Next::Rest { until_ms: None };
    let order = &s.record.order;
    let preparation = &s.record.preparation;
    if s.desired != Some(order)
        || order.wanted == Wanted::Stopped
        || s.record.end_of_order().is_some()
        || s.record
            .active
            .as_ref()
            .is_some_and(|active| active.is_for(order) && !is_lost(s, active))
        || preparation.phase.is_final()
        || !s.may_begin
        || s.deleting
    {
        return NOTHING;
    }
    if s.now_ms < preparation.retry_at_ms {
        return Next::Rest { until_ms: Some(preparation.retry_at_ms) };
    }
    // Checked before any of the package is fetched, and again whenever the signatures turn out to
    // be no longer sufficient.
    if s.prepared.vouched != Vouched::Yes {
        return Next::Act(Step::CheckSigners(order.package.clone()));
    }
    let Some(manifest) = &s.prepared.manifest else {
        return Next::Act(Step::PullManifest(order.package.clone()));
    };
    if s.robot.labels.is_none() && !manifest.requires.labels.is_empty() {
        return NOTHING;
    }
    if let Some(text) = &s.robot.no_task_user {
        let failure = Failure::new(FailureCode::NO_TASK_USER, text);
        return record(transition::prepared_to(s, Phase::Unmet, Some(failure)));
    }
    if s.robot.installations.is_none() && RobotFacts::must_know_ros(manifest) {
        return Next::Act(Step::LookForRos(order.package.clone()));
    }
    let lacks = s.robot.lacks(manifest);
    if !lacks.is_empty() {
        let text = format!(
            "this robot lacks what {} {} requires: {}",
            order.task,
            order.package.version,
            lacks.join(", ")
        );
        let failure = Failure::new(FailureCode::REQUIREMENTS_UNMET, text);
        return record(transition::prepared_to(s, Phase::Unmet, Some(failure)));
    }
    if !s.prepared.content {
        let is_pushed = order.delivery.is_pushed();
        return Next::Act(Step::PullContent { package: order.package.clone(), is_pushed });
    }
    if !s.prepared.built {
        return Next::Act(Step::Build(order.package.clone()));
    }
    let (phase, failure) = if s.held {
        let text = "a person at the robot said hold: it is staged and starts after release";
        (Phase::Deferred, Some(Failure::new(FailureCode::HELD, text)))
    } else {
        (Phase::Staged, None)
    };
    if preparation.phase == phase {
        NOTHING
    } else {
        record(transition::prepared_to(s, phase, failure))
    }
}

/// Whether the ordered version may take over now.
fn takes_over(s: &Situation<'_>) -> bool {
    s.desired == Some(&s.record.order)
        && s.record.order.wanted == Wanted::Running
        && s.record.preparation.phase == Phase::Staged
        && s.prepared.content
        && s.prepared.built
        && s.prepared.vouched == Vouched::Yes
        && s.record.end_of_order().is_none()
        && !s.held
        && s.may_begin
}

fn with_process(s: &Situation<'_>, active: &ActiveRun, process: &ProcessRecord) -> Next {
    let replaced = !active.is_for(&s.record.order) && takes_over(s);
    let wanted = s.desired.is_some_and(|task| task.wanted == Wanted::Running);
    let stops =
        (!wanted || replaced) && process.condemned.is_none() && gate::verdict(s) == Verdict::Go;
    if stops { alive::stop(s, active) } else { alive::next(s, active, process) }
}

fn without_process(s: &Situation<'_>, active: Option<&ActiveRun>) -> Next {
    let order = &s.record.order;
    if s.desired.is_none() {
        let retry_at_ms = s.record.preparation.retry_at_ms;
        return match s.preparing || s.collecting {
            true => Next::Rest { until_ms: None },
            false if s.now_ms < retry_at_ms => Next::Rest { until_ms: Some(retry_at_ms) },
            false => Next::Act(Step::Remove),
        };
    }
    if order.wanted == Wanted::Stopped {
        return tidy(s, None);
    }
    let verdict = gate::verdict(s);
    if verdict == Verdict::Asked {
        return Next::Rest { until_ms: None };
    }
    if takes_over(s)
        && verdict == Verdict::Go
        && active.is_none_or(|active| !active.is_for(order))
        && let Some(manifest) = &s.prepared.manifest
    {
        // A run that was replaced and is ordered again continues with its previous record.
        let before = s.record.fallback.as_ref().filter(|run| run.is_for(order)).cloned();
        let run =
            before.unwrap_or_else(|| ActiveRun::of(order, RunRules::from(manifest), s.now_ms));
        return start(s, &run);
    }
    let Some(active) = active.filter(|active| active.end.is_none()) else { return tidy(s, None) };
    if s.held || (verdict == Verdict::NotNow && !active.admitted) {
        return tidy(s, None);
    }
    if s.now_ms < active.retry_at_ms {
        return Next::Rest { until_ms: Some(active.retry_at_ms) };
    }
    if is_lost(s, active) {
        return match s.record.preparation.phase.is_final() {
            true => record(transition::not_restored(s)),
            false => Next::Rest { until_ms: None },
        };
    }
    start(s, active)
}

/// Whether the files that `active` needs are no longer on the disk: they had been changed, so they
/// were deleted and are prepared anew.
fn is_lost(s: &Situation<'_>, active: &ActiveRun) -> bool {
    let is_whole = s.prepared.content && s.prepared.built;
    active.is_for(&s.record.order) && active.process.is_none() && active.end.is_none() && !is_whole
}

/// Starts a process of `run`, unless the process would overwrite output files that are not yet
/// uploaded.
fn start(s: &Situation<'_>, run: &ActiveRun) -> Next {
    if collect::occupies(s.record, run) {
        return Next::Rest { until_ms: None };
    }
    Next::Act(Step::Start(Box::new(run.clone())))
}

/// Deletes unneeded versions once no other work is left.
fn tidy(s: &Situation<'_>, until_ms: Option<u64>) -> Next {
    let kept = s.record.kept_versions();
    let surplus = s.prepared.versions.iter().any(|version| !kept.contains(version));
    if surplus && !s.preparing { Next::Act(Step::Prune { kept }) } else { Next::Rest { until_ms } }
}

fn record(record: TaskRecord) -> Next {
    Next::Record(Box::new(record))
}

/// The name of a run's directory. Each start has its own directory, and a name is never used twice.
/// `start` counts the agent's starts, `starts` the task's.
pub fn run_dir_name(run: &ActiveRun, start: u64, starts: u64) -> String {
    format!("{}.{}.{start}.{starts}", run.deployment, run.run)
}

/// The log line that names a step.
pub fn describe(task: &TaskName, step: &Step) -> String {
    match step {
        Step::CheckSigners(package) => format!("look who has signed {task} {}", package.version),
        Step::PullManifest(package) => format!("pull the manifest of {task} {}", package.version),
        Step::LookForRos(package) => {
            format!("look for the ROS that {task} {} needs", package.version)
        }
        Step::PullContent { package, is_pushed: false } => {
            format!("pull {task} {}", package.version)
        }
        Step::PullContent { package, is_pushed: true } => {
            format!("gather {task} {}", package.version)
        }
        Step::Build(package) => format!("build {task} {}", package.version),
        Step::Ask(question) => format!("ask the gate about {task} {}", question.version),
        Step::Start(run) => format!("start {task} {} (run {})", run.package.version, run.run),
        Step::Stop(_) => format!("stop {task}"),
        Step::Collect(files) => {
            format!("bring back the files of {task} {} (run {})", files.package.version, files.run)
        }
        Step::Prune { .. } => format!("delete old versions of {task}"),
        Step::Remove => format!("remove {task}"),
    }
}
