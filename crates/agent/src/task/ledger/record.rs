//! The ledger's record of one task: its order, its runs, and its pending work. Answers questions
//! about the record and makes room in it; it never decides on a step, which the plan does.

use serde::{Deserialize, Serialize};
use task_proto::desired::{Delivery, DesiredTask, PackageRef, TargetState};
use task_proto::messages::report::{Failure, FailureCode, Phase};
use task_proto::packages::manifest::TaskKind;
use task_proto::{DeploymentId, Digest, TaskName};

use super::gate::{GateAnswer, GateQuestion, GateRecord, GateStep};
use crate::task::run::{ActiveRun, End};

mod stored;

/// The maximum number of finished runs remembered per task.
const MAX_FINISHED: usize = 32;

/// The state of one task. [`TaskRecord::changed`] makes each next record out of the last one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "stored::StoredTask", into = "stored::StoredTask")]
pub struct TaskRecord {
    /// The task as last requested by the desired state.
    pub order: DesiredTask,
    /// The progress of the ordered version up to its start.
    pub preparation: Preparation,
    /// The run that is kept alive: of the ordered version or, until that is staged, of the previous
    /// version.
    pub active: Option<ActiveRun>,
    /// The run that comes back if the active run, which replaced it, does not become ready.
    pub fallback: Option<ActiveRun>,
    /// The progress of the active run's version, if that is not the ordered run and its files were
    /// found to be changed.
    pub restoring: Option<Preparation>,
    /// The version that was active before.
    pub previous: Option<PackageRef>,
    /// Runs that have ended for good, the oldest first. They keep an order that comes back from
    /// running twice.
    pub finished: Vec<FinishedRun>,
    /// Ended runs with output files to upload, the oldest first.
    pub collections: Vec<OutputUpload>,
    /// The last run with lost output files.
    pub lost: Option<LostFiles>,
    /// The current question to the robot's gate about this task, and its answer.
    pub gate: Option<GateRecord>,
    /// The number of process starts of this task.
    pub starts: u64,
    /// The time at which the task entered its phase.
    pub phase_since_ms: u64,
}

/// The progress of a version on its way to be started.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Preparation {
    /// `assigned` to `staged`, `deferred`, or one of the ends `failed` and `unmet`.
    pub phase: Phase,
    /// The number of attempts in that phase.
    pub attempts: u32,
    /// No attempt before this time.
    pub retry_at_ms: u64,
    /// Why the preparation failed, is unmet or waits.
    pub failure: Option<Failure>,
    /// Service or job; known once the manifest is there.
    pub kind: Option<TaskKind>,
}

/// A run that is over.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FinishedRun {
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// The outcome of the run.
    pub end: End,
}

/// An ended run with output files to upload.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OutputUpload {
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// The package that ran.
    pub package: PackageRef,
    pub kind: TaskKind,
    /// When the run ended, or when this boot began.
    pub since_ms: u64,
    /// The number of failed attempts.
    pub attempts: u32,
    /// No attempt before this time.
    pub retry_at_ms: u64,
    /// Why the last attempt failed.
    pub failure: Option<Failure>,
}

/// A run with lost output files.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostFiles {
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// Why the files were lost.
    pub failure: Failure,
}

impl Preparation {
    /// Whether the version is still being prepared. A version that has run before may be prepared
    /// anew.
    pub fn is_under_way(&self) -> bool {
        matches!(self.phase, Phase::Fetching | Phase::Building)
    }
}

impl TaskRecord {
    /// The record of a new order.
    pub fn new(order: DesiredTask, now_ms: u64) -> Self {
        Self {
            order,
            preparation: Preparation::default(),
            active: None,
            fallback: None,
            restoring: None,
            previous: None,
            finished: Vec::new(),
            collections: Vec::new(),
            lost: None,
            gate: None,
            starts: 0,
            phase_since_ms: now_ms,
        }
    }

    /// The record of a run that was found after the ledger was lost. The run counts as ordered
    /// until the server has sent the desired state.
    pub fn of_survivor(task: TaskName, run: ActiveRun, now_ms: u64) -> Self {
        let order = DesiredTask {
            task,
            deployment: run.deployment.clone(),
            package: run.package.clone(),
            wanted: TargetState::Running,
            run: run.run,
            delivery: Delivery::default(),
            priority: 0,
        };
        Self { active: Some(run.known_started()), ..Self::new(order, now_ms) }
    }

    /// The record after `change`. The time of the phase follows the phase.
    pub fn changed(&self, now_ms: u64, change: impl FnOnce(&mut Self)) -> Self {
        let mut record = self.clone();
        change(&mut record);
        if record.phase() != self.phase() {
            record.phase_since_ms = now_ms;
        }
        record
    }

    /// Takes the active run, if there is one, to another state.
    pub fn change_active(&mut self, transition: impl FnOnce(ActiveRun) -> ActiveRun) {
        self.active = self.active.take().map(transition);
    }

    /// The run whose files are to be prepared anew: not the ordered run, but one that stayed or came
    /// back when the ordered version failed. Until then, the ordered version comes first.
    pub fn run_to_restore(&self) -> Option<(&ActiveRun, &Preparation)> {
        let active = self.active.as_ref().filter(|active| !active.is_for(&self.order))?;
        let order_is_over = self.end_of_order().is_some() || self.preparation.phase.is_final();
        let restoring = self.restoring.as_ref()?;
        (active.is_waiting() && order_is_over).then_some((active, restoring))
    }

    /// The version that is to be on the disk, and its progress: the ordered one, unless the files
    /// of another run are prepared anew.
    pub fn to_prepare(&self) -> (&PackageRef, &Preparation) {
        match self.run_to_restore() {
            Some((run, restoring)) => (&run.package, restoring),
            None => (&self.order.package, &self.preparation),
        }
    }

    /// The progress in [`Self::to_prepare`], to be changed.
    pub fn preparation_mut(&mut self) -> &mut Preparation {
        let restores = self.run_to_restore().is_some();
        self.restoring.as_mut().filter(|_| restores).unwrap_or(&mut self.preparation)
    }

    /// How the ordered run ended, if it has ended: either now, or before the order came back.
    pub fn end_of_order(&self) -> Option<&End> {
        if let Some(active) = self.active.as_ref().filter(|active| active.is_for(&self.order)) {
            return active.end();
        }
        let same = |run: &&FinishedRun| {
            run.deployment == self.order.deployment && run.run == self.order.run
        };
        self.finished.iter().rev().find(same).map(|run| &run.end)
    }

    /// The phase of the order.
    pub fn phase(&self) -> Phase {
        self.order_phase().0
    }

    /// The phase of the order, and the failure behind it.
    pub fn order_phase(&self) -> (Phase, Option<&Failure>) {
        let active = self.active.as_ref().filter(|active| active.is_for(&self.order));
        if self.order.wanted == TargetState::Stopped
            && self.active.as_ref().is_none_or(|active| active.process().is_none())
        {
            return (Phase::Stopped, None);
        }
        if let Some((_, refusal)) =
            self.refusal().filter(|(question, _)| self.concerns_order(question))
        {
            return (Phase::Deferred, Some(refusal));
        }
        if self
            .collections
            .iter()
            .any(|files| files.kind == TaskKind::Job && files.is_for(&self.order))
        {
            return (Phase::Running, None);
        }
        if let Some(end) = self.end_of_order() {
            return (end.phase, end.failure.as_ref());
        }
        match active {
            Some(active) if active.is_ready() => (Phase::Running, None),
            Some(active) if active.process().is_none() && self.preparation.is_under_way() => {
                (self.preparation.phase, self.preparation.failure.as_ref())
            }
            Some(_) => (Phase::Starting, None),
            None => (self.preparation.phase, self.preparation.failure.as_ref()),
        }
    }

    /// The question that the robot's gate refused, and the reason.
    pub fn refusal(&self) -> Option<(&GateQuestion, &Failure)> {
        match &self.gate {
            Some(GateRecord { question, answer: Some(GateAnswer::Refused(failure)), .. }) => {
                Some((question, failure))
            }
            _ => None,
        }
    }

    /// Whether the gate's answer to `question` affects the phase of the order, and not only the
    /// restart of an older run.
    pub fn concerns_order(&self, question: &GateQuestion) -> bool {
        let same = question.deployment == self.order.deployment && question.run == self.order.run;
        question.step == GateStep::Stop || same
    }

    /// Makes room for `successor`. Remembers the active run's end and version and, if the run was
    /// good and does not come back anyway, the run itself.
    pub fn retire_active(&mut self, successor: &ActiveRun) {
        if let Some(good) = self.active.clone().filter(ActiveRun::is_good) {
            self.fallback = Some(good.set_aside());
        }
        self.archive_active(&successor.package);
        // A failed job stays failed: starting another version cannot undo its effects.
        let is_job = successor.rules.kind == TaskKind::Job;
        self.fallback.take_if(|fallback| is_job || fallback.package == successor.package);
        if let Some(fallback) = &self.fallback {
            self.previous = Some(fallback.package.clone());
        }
    }

    /// A run that the operator had stopped neither starts nor comes back in place of the new order.
    pub fn discard_stopped_run(&mut self, next: &DesiredTask, now_ms: u64) {
        self.fallback = None;
        if self.active.as_ref().is_some_and(|active| active.is_for(next)) {
            self.change_active(|active| active.order_again(now_ms));
        } else {
            self.archive_active(&next.package);
        }
    }

    /// Removes the active run and remembers its end. Its version is remembered as well, unless
    /// `next` is the same version.
    fn archive_active(&mut self, next: &PackageRef) {
        let Some(active) = self.active.take() else { return };
        if let Some(end) = active.end() {
            self.finish(active.deployment.clone(), active.run, end.clone());
        }
        if active.package != *next {
            self.previous = Some(active.package);
        }
    }

    /// Remembers the outcome of a run.
    pub fn finish(&mut self, deployment: DeploymentId, run: u64, end: End) {
        self.finished.retain(|other| other.deployment != deployment || other.run != run);
        self.finished.push(FinishedRun { deployment, run, end });
        let surplus = self.finished.len().saturating_sub(MAX_FINISHED);
        self.finished.drain(..surplus);
    }

    /// The versions that must stay on disk: the ordered, the active and the fallback version. The
    /// previous version stays only while there is room for the one to prepare: it merely spares a
    /// later rollback the fetch.
    pub fn kept_versions(&self) -> Vec<Digest> {
        let lacks_room = self
            .to_prepare()
            .1
            .failure
            .as_ref()
            .is_some_and(|failure| failure.code == FailureCode::DISK_FULL);
        let previous = self.previous.iter().filter(|_| !lacks_room);
        let runs = [&self.active, &self.fallback].into_iter().flatten().map(|run| &run.package);
        let files = self.collections.iter().map(|files| &files.package);
        let mut kept: Vec<Digest> =
            runs.chain(files).chain([&self.order.package]).chain(previous).map(digest_of).collect();
        kept.sort();
        kept.dedup();
        kept
    }
}

fn digest_of(package: &PackageRef) -> Digest {
    package.manifest.digest
}

impl OutputUpload {
    /// The output files of `run`, which is over.
    pub fn of(run: &ActiveRun, now_ms: u64) -> Self {
        Self {
            deployment: run.deployment.clone(),
            run: run.run,
            package: run.package.clone(),
            kind: run.rules.kind,
            since_ms: now_ms,
            attempts: 0,
            retry_at_ms: 0,
            failure: None,
        }
    }

    /// Whether these are the files of the same run.
    pub fn is_same(&self, other: &Self) -> bool {
        self.deployment == other.deployment && self.run == other.run
    }

    /// Whether these are files of the run that `order` asks for.
    pub fn is_for(&self, order: &DesiredTask) -> bool {
        self.deployment == order.deployment && self.run == order.run
    }
}

impl Default for Preparation {
    fn default() -> Self {
        Self { phase: Phase::Assigned, attempts: 0, retry_at_ms: 0, failure: None, kind: None }
    }
}
