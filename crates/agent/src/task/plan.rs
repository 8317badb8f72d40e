//! The plan: what to do next about one task. Pure: desired state, ledger record and observation in,
//! next step out; time and randomness are arguments. It never touches disk, network or processes.
//!
//! Two things go on side by side. A version that was ordered is prepared while the one before it
//! keeps running:
//!
//! ```text
//! assigned ─► fetching ─► unpacking ─► building ─► staged ──► (handed to the active run)
//!     │           └──────────┴────────────┴──► failed           ▲ deferred: a person holds the robot,
//!     └► unmet    a retry waits in its phase                      or its gate says not now
//! ```
//!
//! and one run of one version is kept alive:
//!
//! ```text
//! starting ─► running ─► succeeded | failed | stopped
//!     ▲ │         │
//!     │ │         └─ degraded for too long: stopped, and as if it had ended
//!     │ └─ not ready in time, refused: stopped, then failed or, with a good run before it, rolled_back
//!     └── restart policy, reboot: after a backoff
//! ```
//!
//! A staged version takes over: the old process is stopped, `current` is swapped, the new one is
//! started. The old run stays in the record until the new one is ready; if that never comes, the
//! old one becomes the active run again and the order has ended as `rolled_back`. Each half has at
//! most one step under way ([`Lane`]); a process is only ever started by the second, so there are
//! never two of a task.

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

/// All that the next step depends on.
#[derive(Debug, Clone, Copy)]
pub struct Situation<'a> {
    /// What the accepted desired state says of this task; `None`: it should be absent.
    pub desired: Option<&'a DesiredTask>,
    /// What the ledger says.
    pub record: &'a TaskRecord,
    /// What is on the disk of the ordered version.
    pub prepared: &'a Prepared,
    /// What became of the active run's process.
    pub process: &'a ProcessState,
    /// What ROS says of it while it lives.
    pub health: &'a Health,
    /// Whether a step of [`Lane::Prepare`] is under way.
    pub preparing: bool,
    /// Whether a step of [`Lane::Run`] is under way.
    pub acting: bool,
    /// Whether a step of [`Lane::Collect`] is under way.
    pub collecting: bool,
    /// Whether a step that deletes versions is under way.
    pub deleting: bool,
    /// What packages may require.
    pub robot: &'a RobotFacts,
    /// Whether new work may be begun: the desired state is in force and the server knows the robot.
    pub may_begin: bool,
    /// A person at the robot said `hold`.
    pub held: bool,
    /// The robot has a gate that is to be asked.
    pub gated: bool,
    /// The kernel's boot id.
    pub boot_id: &'a str,
    /// Milliseconds since boot.
    pub now_ms: u64,
    /// Evenly from 0 to 1: spreads the retries.
    pub jitter: f64,
}

/// What to do next.
#[derive(Debug, Clone, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "it is taken apart where it is made")]
pub enum Next {
    /// Nothing before this time, or before something changes.
    Rest {
        /// Milliseconds since boot.
        until_ms: Option<u64>,
    },
    /// Write this record, then ask again.
    Record(Box<TaskRecord>),
    /// Write [`begun`], do this, write [`finished`], then ask again.
    Act(Step),
}

/// One thing to be done about a task.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// Find out whether enough of the trusted publishers have signed it.
    CheckSigners(PackageRef),
    /// Pull the manifest.
    PullManifest(PackageRef),
    /// Look at what ROS there is, to tell whether the version can run here.
    LookForRos(PackageRef),
    /// Get and unpack the content: as parts that the server pushes, and what does not come so by a
    /// pull.
    PullContent {
        /// Of which package.
        package: PackageRef,
        /// Whether the server pushes it.
        is_pushed: bool,
    },
    /// Build it.
    Build(PackageRef),
    /// Ask the robot's gate.
    Ask(GateQuestion),
    /// Make this run the active one and start a process of it.
    Start(Box<ActiveRun>),
    /// Stop this run's process; it is the active one.
    Stop(Box<ActiveRun>),
    /// Bring the files of an ended run to the server.
    Collect(Box<Collection>),
    /// Delete the versions that are not in `kept`.
    Prune {
        /// The versions that stay.
        kept: Vec<Digest>,
    },
    /// Delete the task with all that belongs to it, its record too.
    Remove,
}

/// Which half of the plan a step belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Lane {
    /// Brings the ordered version to `staged`. May take long, may be interrupted at any point.
    Prepare,
    /// Starts, stops, removes.
    Run,
    /// Asks the robot's gate. Meanwhile the run that lives is looked after.
    Gate,
    /// Brings the files of ended runs to the server.
    Collect,
}

impl Lane {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Run, Self::Prepare, Self::Gate, Self::Collect];
}

impl Step {
    /// The lane it runs in.
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

    /// How long it may take. What moves many bytes watches over their flow instead, since a large
    /// package on a bad link takes its time, and a build over its own limits.
    pub fn deadline(&self) -> Option<Duration> {
        let seconds = match self {
            Self::PullContent { .. } | Self::Build(_) | Self::Collect(_) => return None,
            Self::CheckSigners(_) | Self::PullManifest(_) | Self::LookForRos(_) => STEP_DEADLINE_S,
            Self::Start(_) => STEP_DEADLINE_S + VERIFY_DEADLINE_S,
            // Its own, shorter limit is a setting.
            Self::Ask(_) => STEP_DEADLINE_S + crate::config::MAX_GATE_TIMEOUT_S,
            Self::Stop(run) => STEP_DEADLINE_S + 2 * u64::from(run.rules.stop_timeout_s),
            Self::Prune { .. } | Self::Remove => DELETE_DEADLINE_S,
        };
        Some(Duration::from_secs(seconds))
    }

    /// Whether it deletes versions, so that none may be prepared meanwhile.
    pub fn deletes(&self) -> bool {
        matches!(self, Self::Prune { .. } | Self::Remove)
    }

    /// Whether this step, already under way, still serves what is desired. If not it is
    /// interrupted; steps of [`Lane::Run`] are short and are finished.
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

/// How long a step may take whose parts all have shorter limits of their own.
const STEP_DEADLINE_S: u64 = 120;
/// How long it may take to read all of a version: the largest there may be, on a slow card.
const VERIFY_DEADLINE_S: u64 = 900;
/// How long deleting may take: many small files on a slow card.
const DELETE_DEADLINE_S: u64 = 600;
/// A run that went on this long without ending is calm: its restarts are forgiven.
pub const CALM_MS: u64 = 10 * 60 * 1000;

/// When to look again at a process of which nothing could be told.
pub const LOOK_AGAIN_MS: u64 = 5000;

/// Tasks in the order in which they get what not all can have at once: those of higher priority
/// first, then by name.
pub fn in_turn(mut tasks: Vec<(TaskName, i32)>) -> Vec<TaskName> {
    tasks.sort_by(|(name, priority), (other, other_priority)| {
        other_priority.cmp(priority).then(name.cmp(other))
    });
    tasks.dedup_by(|(name, _), (other, _)| name == other);
    tasks.into_iter().map(|(name, _)| name).collect()
}

/// The next step about the active run: start, restart, stop, replace, remove.
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
        // Another process must not be started while this one may live.
        ProcessState::Unknown => Next::Rest { until_ms: Some(s.now_ms + LOOK_AGAIN_MS) },
        ProcessState::Ended(exit) => record(transition::ended(s, exit)),
        ProcessState::NeverStarted | ProcessState::None => record(transition::never_started(s)),
    }
}

/// The next step towards the ordered version being staged.
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
    // Before anything of it is fetched, and again whenever it turns out that the signatures are not
    // enough any more.
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
        // A run that was replaced and is ordered again goes on as the good one it was.
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

/// Whether what `active` is to run is not on the disk any more: it was deleted because it had been
/// changed, and is prepared anew.
fn is_lost(s: &Situation<'_>, active: &ActiveRun) -> bool {
    let is_whole = s.prepared.content && s.prepared.built;
    active.is_for(&s.record.order) && active.process.is_none() && active.end.is_none() && !is_whole
}

/// Starts a process of `run`, unless it would write over files that are still to be brought back.
fn start(s: &Situation<'_>, run: &ActiveRun) -> Next {
    if collect::occupies(s.record, run) {
        return Next::Rest { until_ms: None };
    }
    Next::Act(Step::Start(Box::new(run.clone())))
}

/// Deletes versions that nothing needs any more, once nothing else is to be done.
fn tidy(s: &Situation<'_>, until_ms: Option<u64>) -> Next {
    let kept = s.record.kept_versions();
    let surplus = s.prepared.versions.iter().any(|version| !kept.contains(version));
    if surplus && !s.preparing { Next::Act(Step::Prune { kept }) } else { Next::Rest { until_ms } }
}

fn record(record: TaskRecord) -> Next {
    Next::Record(Box::new(record))
}

/// The name of a run's directory: one for each start, never used twice. `start` counts the agent's
/// starts, `starts` the task's.
pub fn run_dir_name(run: &ActiveRun, start: u64, starts: u64) -> String {
    format!("{}.{}.{start}.{starts}", run.deployment, run.run)
}

/// The line that names a step in the log.
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
