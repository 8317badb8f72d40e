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
//! The second keeps one run of one version alive; [`crate::task::run`] has its states.
//!
//! A staged version takes over in three steps: the old process is stopped, `current` is swapped,
//! the new process is started. The old run stays in the record until the new run is ready. If the
//! new run never becomes ready, the old run becomes the active run again and the order ends as
//! `rolled_back`. Each state machine has at most one step under way ([`Lane`]). Only the second one
//! starts processes, so a task never has two.
//!
//! A run whose files were changed on the disk waits while the first state machine prepares them
//! anew. The ordered version goes first: another run waits until the order is over.

use task_proto::TaskName;
use task_proto::desired::{DesiredTask, TargetState};
use task_proto::messages::report::Phase;

use crate::task::ledger::TaskRecord;
use crate::task::observed::{Health, Prepared, ProcessState, RobotFacts, SignatureVerdict};
use crate::task::run::{ActiveRun, ProcessRecord, RunRules};
use crate::task::timing::Moment;
use gate::GateDecision;

mod gate;
mod preparation;
mod process;
mod step;
mod supervision;
#[cfg(test)]
mod tests;
mod transition;
mod upload;

pub use gate::check_gate;
pub use preparation::prepare;
pub use step::{Done, Lane, Outcome, Step, StepFailure, describe};
pub use transition::{begin_step, finish_step};
pub use upload::upload;

/// The longest wait before a step is tried again.
const MAX_STEP_BACKOFF_MS: u64 = 5 * 60 * 1000;
/// Interval between observations of a process while its state cannot be determined.
pub const OBSERVE_AGAIN_MS: u64 = 5000;

/// All inputs of the decision about the next step.
#[derive(Debug, Clone, Copy)]
pub struct PlanInput<'a> {
    /// The task in the accepted desired state; `None`: the task should be absent.
    pub desired: Option<&'a DesiredTask>,
    /// The task's record in the ledger.
    pub record: &'a TaskRecord,
    /// The files on the disk of the version to prepare, see [`TaskRecord::to_prepare`].
    pub prepared: &'a Prepared,
    /// The observed state of the active run's process.
    pub process: &'a ProcessState,
    /// The health of the active run on the ROS graph while its process lives.
    pub health: &'a Health,
    /// The steps of the task that are under way.
    pub under_way: &'a [&'a Step],
    /// Facts about the robot that packages may require.
    pub robot: &'a RobotFacts,
    /// What the robot permits.
    pub permissions: Permissions,
    /// The time of the decision.
    pub at: Moment<'a>,
}

/// What the robot permits. Each of the three holds whatever the others say.
#[derive(Debug, Clone, Copy)]
pub struct Permissions {
    /// Whether new work may begin: the desired state is in force and the server knows the robot.
    pub may_begin: bool,
    /// A person at the robot said `hold`.
    pub held: bool,
    /// Whether the robot has a gate to ask.
    pub gated: bool,
}

impl PlanInput<'_> {
    /// Whether a step of this lane is under way.
    fn is_busy(&self, lane: Lane) -> bool {
        self.under_way.iter().any(|step| step.lane() == lane)
    }

    /// Whether a step that deletes versions is under way.
    fn is_deleting(&self) -> bool {
        self.under_way.iter().any(|step| step.deletes())
    }
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
    /// Write [`begin_step`], do this step, write [`finish_step`], then plan again.
    Act(Step),
}

/// Orders the tasks for scarce resources: by descending priority, then by name.
pub fn by_priority(mut tasks: Vec<(TaskName, i32)>) -> Vec<TaskName> {
    tasks.sort_by(|(name, priority), (other, other_priority)| {
        other_priority.cmp(priority).then(name.cmp(other))
    });
    tasks.dedup_by(|(name, _), (other, _)| name == other);
    tasks.into_iter().map(|(name, _)| name).collect()
}

/// The next step for the active run: start, restart, stop, replace, remove.
pub fn supervise(s: &PlanInput<'_>) -> Next {
    if let Some(order) = s.desired
        && *order != s.record.order
    {
        return change(s, |record| transition::adopt_order(record, order, s.at.now_ms));
    }
    let Some(active) = &s.record.active else { return without_process(s, None) };
    let Some(process) = active.process() else { return without_process(s, Some(active)) };
    match s.process {
        ProcessState::Alive { .. } => with_process(s, active, process),
        // This process may still live, so we must not start another.
        ProcessState::Unknown => Next::Rest { until_ms: Some(s.at.now_ms + OBSERVE_AGAIN_MS) },
        ProcessState::Ended(exit) => change(s, |record| process::ended(record, exit, &s.at)),
        ProcessState::NeverStarted | ProcessState::None => {
            change(s, |record| process::never_started(record, &s.at))
        }
    }
}

/// Whether the ordered version may take over now.
fn takes_over(s: &PlanInput<'_>) -> bool {
    s.desired == Some(&s.record.order)
        && s.record.order.wanted == TargetState::Running
        && s.record.preparation.phase == Phase::Staged
        && s.prepared.content
        && s.prepared.built
        && s.prepared.signatures == SignatureVerdict::Sufficient
        && s.record.end_of_order().is_none()
        && !s.permissions.held
        && s.permissions.may_begin
}

fn with_process(s: &PlanInput<'_>, active: &ActiveRun, process: &ProcessRecord) -> Next {
    let replaced = !active.is_for(&s.record.order) && takes_over(s);
    let wanted = s.desired.is_some_and(|task| task.wanted == TargetState::Running);
    let stops = (!wanted || replaced)
        && active.pending_stop().is_none()
        && gate::decision(s) == GateDecision::Proceed;
    if stops { supervision::stop(s, active) } else { supervision::next(s, active, process) }
}

fn without_process(s: &PlanInput<'_>, active: Option<&ActiveRun>) -> Next {
    let order = &s.record.order;
    if s.desired.is_none() {
        let retry_at_ms = s.record.preparation.retry_at_ms;
        return match s.is_busy(Lane::Prepare) || s.is_busy(Lane::Upload) {
            true => Next::Rest { until_ms: None },
            false if s.at.now_ms < retry_at_ms => Next::Rest { until_ms: Some(retry_at_ms) },
            false => Next::Act(Step::Remove),
        };
    }
    if order.wanted == TargetState::Stopped {
        return prune_surplus(s, None);
    }
    let decision = gate::decision(s);
    if decision == GateDecision::Pending {
        return Next::Rest { until_ms: None };
    }
    if takes_over(s)
        && decision == GateDecision::Proceed
        && active.is_none_or(|active| !active.is_for(order))
        && let Some(manifest) = &s.prepared.manifest
    {
        // A run that was replaced and is ordered again continues with its previous record.
        let before = s.record.fallback.as_ref().filter(|run| run.is_for(order)).cloned();
        let run =
            before.unwrap_or_else(|| ActiveRun::of(order, RunRules::from(manifest), s.at.now_ms));
        return start(s, &run);
    }
    let Some(active) = active.filter(|active| active.is_waiting()) else {
        return prune_surplus(s, None);
    };
    if s.permissions.held || (decision == GateDecision::Refused && !active.is_admitted()) {
        return prune_surplus(s, None);
    }
    if s.at.now_ms < active.retry_at_ms() {
        return Next::Rest { until_ms: Some(active.retry_at_ms()) };
    }
    if lacks_files(s, active) {
        return match s.record.to_prepare().1.phase.is_final() {
            true => change(s, |record| process::give_up_unrestored(record, s.at.now_ms)),
            false => Next::Rest { until_ms: None },
        };
    }
    start(s, active)
}

/// Whether the files that `active` needs are no longer on the disk: they had been changed, so they
/// were deleted and are prepared anew.
fn lacks_files(s: &PlanInput<'_>, active: &ActiveRun) -> bool {
    let is_whole = match active.is_for(&s.record.order) {
        true => s.prepared.content && s.prepared.built,
        false => s.record.restoring.is_none(),
    };
    active.is_waiting() && !is_whole
}

/// Starts a process of `run`, unless the process would overwrite output files that are not yet
/// uploaded.
fn start(s: &PlanInput<'_>, run: &ActiveRun) -> Next {
    if upload::blocks_start(s.record, run) {
        return Next::Rest { until_ms: None };
    }
    Next::Act(Step::Start(Box::new(run.clone())))
}

/// Deletes unneeded versions once no other work is left.
fn prune_surplus(s: &PlanInput<'_>, until_ms: Option<u64>) -> Next {
    let kept = s.record.kept_versions();
    let surplus = s.prepared.versions.iter().any(|version| !kept.contains(version));
    if surplus && !s.is_busy(Lane::Prepare) {
        Next::Act(Step::Prune { kept })
    } else {
        Next::Rest { until_ms }
    }
}

/// The record after `change`.
fn change(s: &PlanInput<'_>, change: impl FnOnce(&mut TaskRecord)) -> Next {
    Next::Record(Box::new(s.record.changed(s.at.now_ms, change)))
}

/// The name of a run's directory. Each start has its own directory, and a name is never used twice.
/// `start` counts the agent's starts, `starts` the task's.
pub fn run_dir_name(run: &ActiveRun, start: u64, starts: u64) -> String {
    format!("{}.{}.{start}.{starts}", run.deployment, run.run)
}
