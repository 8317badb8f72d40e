//! State transitions of a task record: a new order, the beginning and end of a step, the end of a
//! process. Pure, like the plan.

use task_proto::desired::{DesiredTask, Wanted};
use task_proto::manifest::{OnBoot, Restart, TaskKind};
use task_proto::report::{Failure, FailureCode, Phase};

use super::{MAX_RESTARTS_IN_A_ROW, Situation, Step, run_dir_name};
use crate::task::ledger::{
    ActiveRun, Collection, Condemned, End, GateAnswer, GateRecord, LostFiles, Preparation,
    ProcessRecord, RunRules, TaskRecord,
};
use crate::task::observed::Exit;

/// The result of a step that did not fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Done {
    /// The step is complete.
    Well,
    /// A process was started; holds its process id.
    Started(u32),
    /// The server told this robot to come back later. This counts neither as a failure nor as an
    /// attempt.
    ToldToWait {
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

/// The first wait of a backoff.
const BACKOFF_BASE_MS: u64 = 1000;
/// The longest wait before a step is tried again.
const MAX_STEP_BACKOFF_MS: u64 = 5 * 60 * 1000;
/// The most jitter that is added to a wait requested by the server.
const MAX_WAIT_JITTER_MS: u64 = 30 * 1000;
/// The longest wait before the robot's gate is asked again.
const MAX_GATE_BACKOFF_MS: u64 = 60 * 1000;
/// The longest wait before a process is started again.
const MAX_RESTART_BACKOFF_MS: u64 = 60 * 1000;

/// Exponential backoff with full jitter: the wait after the `attempt`th failure. `jitter` is
/// uniform from 0 to 1.
pub fn backoff_ms(attempt: u32, max_ms: u64, jitter: f64) -> u64 {
    let ceiling = BACKOFF_BASE_MS.saturating_mul(1 << attempt.clamp(1, 20)).min(max_ms);
    // Rounding a positive number below 2^32 loses nothing that matters.
    (ceiling as f64 * jitter.clamp(0.0, 1.0)) as u64
}

/// The record under a new order. A live run continues until the new version takes over.
pub fn adopted(record: &TaskRecord, order: &DesiredTask, now_ms: u64) -> TaskRecord {
    let mut record = record.clone();
    let is_down = record.active.as_ref().is_none_or(|active| active.process.is_none());
    if record.order.wanted == Wanted::Stopped && is_down {
        let fallback = record.fallback.clone();
        record.forget_stopped(order, now_ms);
        collect_if_left(&mut record, fallback, now_ms);
    }
    record.order = order.clone();
    record.preparation = Preparation::default();
    record.settle_phase(now_ms);
    record
}

/// The record that is written before `step` begins. `start` is the agent's start counter.
pub fn begun(
    record: &TaskRecord,
    step: &Step,
    boot_id: &str,
    start: u64,
    now_ms: u64,
) -> TaskRecord {
    let mut record = record.clone();
    let phase = match step {
        Step::CheckSigners(_)
        | Step::PullManifest(_)
        | Step::LookForRos(_)
        | Step::PullContent { .. } => Some(Phase::Fetching),
        Step::Build(_) => Some(Phase::Building),
        Step::Ask(_)
        | Step::Start(_)
        | Step::Stop(_)
        | Step::Collect(_)
        | Step::Prune { .. }
        | Step::Remove => None,
    };
    if let Some(phase) = phase {
        let again = record.preparation.phase == phase && record.preparation.failure.is_some();
        record.preparation.attempts =
            if again { record.preparation.attempts.saturating_add(1) } else { 1 };
        record.preparation.phase = phase;
    }
    if let Step::Start(run) = step {
        if !record.active.as_ref().is_some_and(|active| active.is_same(run)) {
            let runs = [record.active.clone(), record.fallback.clone()];
            record.retire_active(run);
            for left in runs {
                collect_if_left(
                    &mut record,
                    left.filter(|left| left.package != run.package),
                    now_ms,
                );
            }
        }
        record.gate = None;
        record.starts = record.starts.saturating_add(1);
        let mut run = ActiveRun::clone(run);
        run.admitted = true;
        run.process = Some(ProcessRecord {
            dir: run_dir_name(&run, start, record.starts),
            boot_id: boot_id.to_owned(),
            started_ms: now_ms,
            pid: None,
            ready: false,
            condemned: None,
        });
        if run.is_for(&record.order) && record.preparation.is_under_way() {
            (record.preparation.phase, record.preparation.failure) = (Phase::Staged, None);
        }
        record.active = Some(run);
    }
    if *step == Step::Remove {
        record.collections.clear();
    }
    if let Step::Ask(question) = step
        && record.gate.as_ref().is_none_or(|gate| gate.question != *question)
    {
        record.gate = Some(GateRecord {
            question: question.clone(),
            answer: None,
            refusals: 0,
            retry_at_ms: 0,
        });
    }
    record.settle_phase(now_ms);
    record
}

/// The record after `step` ended with `outcome`.
pub fn finished(s: &Situation<'_>, step: &Step, outcome: Result<Done, StepFailure>) -> TaskRecord {
    let mut record = s.record.clone();
    match (step, outcome) {
        (
            Step::CheckSigners(package)
            | Step::PullManifest(package)
            | Step::LookForRos(package)
            | Step::PullContent { package, .. }
            | Step::Build(package),
            outcome,
        ) => {
            // A step for an order that was replaced meanwhile says nothing about the new order.
            if record.order.package == *package {
                prepared(&mut record.preparation, s, outcome);
            }
        }
        (Step::Start(_), Ok(done)) => {
            if let Some(active) = &mut record.active {
                active.ever_started = true;
                if let Some(process) = &mut active.process {
                    process.started_ms = s.now_ms;
                    process.pid =
                        if let Done::Started(pid) = done { Some(pid) } else { process.pid };
                }
            }
        }
        (Step::Start(_), Err(StepFailure { failure, retry_after_ms })) => {
            prepare_changed(&mut record, &failure);
            // The process may have been started despite the failure. We act on the failure only
            // once no process is left.
            if let Some(process) = record.active.as_mut().and_then(|active| active.process.as_mut())
            {
                process.condemned = Some(Condemned { failure, again: retry_after_ms.is_some() });
            }
        }
        (Step::Stop(run), Ok(_)) => {
            let process = record.active.as_mut().and_then(|active| active.process.take());
            if let Some(condemned) = process.and_then(|process| process.condemned) {
                give_up_or_retry(&mut record, s, condemned.failure, condemned.again);
            } else if let Some(active) = &mut record.active
                && active.rules.kind == TaskKind::Job
                && active.end.is_none()
            {
                active.end = Some(interrupted("the job was stopped before it had ended"));
            }
            collect_if_over(&mut record, run, s.now_ms);
        }
        (Step::Stop(_), Err(_)) => {
            if let Some(active) = &mut record.active {
                active.retry_at_ms =
                    s.now_ms + backoff_ms(1, MAX_STEP_BACKOFF_MS, s.jitter).max(BACKOFF_BASE_MS);
            }
        }
        (Step::Ask(question), outcome) => {
            if let Some(gate) = record.gate.as_mut().filter(|gate| gate.question == *question) {
                answered(gate, s, outcome.err());
            }
        }
        (Step::Collect(files), Ok(_)) => record.collections.retain(|other| !other.is_same(files)),
        (Step::Collect(files), Err(StepFailure { failure, retry_after_ms })) => {
            match retry_after_ms {
                Some(least_ms) => {
                    for files in record.collections.iter_mut().filter(|other| other.is_same(files))
                    {
                        files.attempts = files.attempts.saturating_add(1);
                        let wait_ms =
                            backoff_ms(files.attempts, MAX_STEP_BACKOFF_MS, s.jitter).max(least_ms);
                        files.retry_at_ms = s.now_ms.saturating_add(wait_ms.max(BACKOFF_BASE_MS));
                        files.failure = Some(failure.clone());
                    }
                }
                None => lose_files(&mut record, files, Some(&failure)),
            }
        }
        (Step::Remove, Err(_)) => {
            record.preparation.attempts = record.preparation.attempts.saturating_add(1);
            let wait_ms = backoff_ms(record.preparation.attempts, MAX_STEP_BACKOFF_MS, s.jitter);
            record.preparation.retry_at_ms = s.now_ms + wait_ms.max(BACKOFF_BASE_MS);
        }
        (Step::Remove, Ok(_)) | (Step::Prune { .. }, _) => {}
    }
    record.settle_phase(s.now_ms);
    record
}

/// Prepares the ordered version again after its files on the disk were found to be changed.
fn prepare_changed(record: &mut TaskRecord, failure: &Failure) {
    let is_ordered = record.active.as_ref().is_some_and(|active| active.is_for(&record.order));
    if failure.code == FailureCode::TREE_CHANGED && is_ordered {
        let (kind, failure) = (record.preparation.kind, Some(failure.clone()));
        record.preparation =
            Preparation { phase: Phase::Fetching, failure, kind, ..Preparation::default() };
    }
}

fn answered(gate: &mut GateRecord, s: &Situation<'_>, refusal: Option<StepFailure>) {
    gate.answer = Some(match refusal {
        None => GateAnswer::Allowed,
        Some(StepFailure { failure, .. }) => {
            gate.refusals = gate.refusals.saturating_add(1);
            gate.retry_at_ms = s.now_ms
                + backoff_ms(gate.refusals, MAX_GATE_BACKOFF_MS, s.jitter).max(BACKOFF_BASE_MS);
            GateAnswer::Refused(failure)
        }
    });
}

fn prepared(preparation: &mut Preparation, s: &Situation<'_>, outcome: Result<Done, StepFailure>) {
    preparation.kind = s.prepared.manifest.as_ref().map(|manifest| manifest.run.kind);
    preparation.retry_at_ms = 0;
    match outcome {
        Ok(Done::ToldToWait { at_least_ms }) => {
            // Only the end of the order bounds the number of waits: the server knows when it has
            // capacity.
            preparation.failure = None;
            let wait_ms = at_least_ms.saturating_add(wait_jitter_ms(at_least_ms, s.jitter));
            preparation.retry_at_ms = s.now_ms.saturating_add(wait_ms);
        }
        Ok(_) => preparation.failure = None,
        Err(StepFailure { failure, retry_after_ms: None }) => {
            preparation.failure = Some(failure);
            preparation.phase = Phase::Failed;
        }
        Err(StepFailure { failure, retry_after_ms: Some(least_ms) }) => {
            preparation.failure = Some(failure);
            // Retries go on until the order ends: the server lets the order expire.
            let wait_ms =
                backoff_ms(preparation.attempts, MAX_STEP_BACKOFF_MS, s.jitter).max(least_ms);
            preparation.retry_at_ms = s.now_ms.saturating_add(wait_ms);
        }
    }
}

/// Jitter for a wait of `least_ms`, so that robots with the same wait do not all come back at once.
fn wait_jitter_ms(least_ms: u64, jitter: f64) -> u64 {
    let most_ms = (least_ms / 4).clamp(BACKOFF_BASE_MS, MAX_WAIT_JITTER_MS);
    (most_ms as f64 * jitter.clamp(0.0, 1.0)) as u64
}

/// The record with the preparation at `phase`.
pub(super) fn prepared_to(s: &Situation<'_>, phase: Phase, failure: Option<Failure>) -> TaskRecord {
    let mut record = s.record.clone();
    record.preparation.kind = s.prepared.manifest.as_ref().map(|manifest| manifest.run.kind);
    record.preparation.phase = phase;
    record.preparation.failure = failure;
    record.preparation.attempts = 0;
    record.settle_phase(s.now_ms);
    record
}

/// The record once all readiness conditions have held long enough.
pub(super) fn ready(s: &Situation<'_>) -> TaskRecord {
    let mut record = s.record.clone();
    // The new run has proved itself, so the replaced run is not needed any more.
    if let Some(before) = record.fallback.take() {
        collect_files(&mut record, &before, s.now_ms);
    }
    if let Some(active) = &mut record.active {
        active.ever_ready = true;
        if let Some(process) = &mut active.process {
            process.ready = true;
        }
    }
    record.settle_phase(s.now_ms);
    record
}

/// The record once the gate has no pending question.
pub(super) fn ungated(s: &Situation<'_>) -> TaskRecord {
    let mut record = s.record.clone();
    record.gate = None;
    record.settle_phase(s.now_ms);
    record
}

/// The record once the process is marked to be stopped because of a failure.
pub(super) fn condemned(s: &Situation<'_>, condemned: Condemned) -> TaskRecord {
    let mut record = s.record.clone();
    if let Some(process) = record.active.as_mut().and_then(|active| active.process.as_mut()) {
        process.condemned = Some(condemned);
    }
    record
}

/// The record once a restarted process has run calmly.
pub(super) fn calm(record: &TaskRecord) -> TaskRecord {
    let mut record = record.clone();
    if let Some(active) = &mut record.active {
        active.restarts_in_a_row = 0;
    }
    record
}

/// The record once the deleted files of the active run are known to be unrecoverable.
pub(super) fn not_restored(s: &Situation<'_>) -> TaskRecord {
    let mut record = s.record.clone();
    let failure = record.preparation.failure.clone();
    let unknown =
        || Failure::new(FailureCode::TREE_CHANGED, "what it is to run is not on the disk any more");
    give_up(&mut record, s, failure.unwrap_or_else(unknown));
    record.settle_phase(s.now_ms);
    record
}

/// The record once the process in the record turns out to have never been started. The start does
/// not count as an attempt, unless it is known to have failed.
pub(super) fn never_started(s: &Situation<'_>) -> TaskRecord {
    let mut record = s.record.clone();
    let process = record.active.as_mut().and_then(|active| active.process.take());
    if let Some(condemned) = process.and_then(|process| process.condemned) {
        let run = record.active.clone();
        // A job may be retried as well: none of it has run.
        give_up_or_retry(&mut record, s, condemned.failure, condemned.again);
        // Earlier processes of the run may have written files.
        if let Some(run) = run.filter(ActiveRun::has_started) {
            collect_if_over(&mut record, &run, s.now_ms);
        }
    }
    record.settle_phase(s.now_ms);
    record
}

/// The record after the active run's process has ended without a stop from the agent.
pub(super) fn ended(s: &Situation<'_>, exit: &Exit) -> TaskRecord {
    let mut record = s.record.clone();
    let Some(active) = &mut record.active else { return record };
    active.ever_started = true;
    let run = active.clone();
    let Some(process) = active.process.take() else { return record };
    let is_job = active.rules.kind == TaskKind::Job;
    if let Some(condemned) = process.condemned {
        give_up_or_retry(&mut record, s, condemned.failure, condemned.again && !is_job);
    } else if process.boot_id != s.boot_id && !(is_job && exit.is_success()) {
        // The process ended because the robot went down, whatever its exit status.
        after_reboot(&mut record, s.now_ms);
    } else if is_job {
        job_ended(active, exit);
    } else {
        let again = match active.rules.restart {
            Restart::Never => false,
            Restart::OnFailure => !exit.is_success(),
            Restart::Always => true,
        };
        give_up_or_retry(&mut record, s, exit.failure(), again);
    }
    collect_if_over(&mut record, &run, s.now_ms);
    record.settle_phase(s.now_ms);
    record
}

/// Queues the output files of `run`. The process is gone; files are not queued if the run continues
/// now or later with another process.
fn collect_if_over(record: &mut TaskRecord, run: &ActiveRun, now_ms: u64) {
    let goes_on =
        record.active.as_ref().is_some_and(|active| active.is_same(run) && active.end.is_none());
    let stopped = record.order.wanted == Wanted::Stopped;
    // A replaced run may come back; it is over once the new run is ready.
    if !goes_on || stopped {
        collect_files(record, run, now_ms);
    }
}

/// Queues the output files of a run that left the record without an end of its own. The run was
/// stopped for another run and will not come back.
fn collect_if_left(record: &mut TaskRecord, run: Option<ActiveRun>, now_ms: u64) {
    let Some(run) = run.filter(|run| run.end.is_none() && run.has_started()) else { return };
    if ![&record.active, &record.fallback].into_iter().flatten().any(|other| other.is_same(&run)) {
        collect_files(record, &run, now_ms);
    }
}

fn collect_files(record: &mut TaskRecord, run: &ActiveRun, now_ms: u64) {
    if run.rules.has_outputs {
        let files = Collection::of(run, now_ms);
        record.collections.retain(|other| !other.is_same(&files));
        record.collections.push(files);
    }
}

/// The record once the files of a run are given up.
pub(super) fn gave_up_files(s: &Situation<'_>, files: &Collection) -> TaskRecord {
    let mut record = s.record.clone();
    lose_files(&mut record, files, files.failure.as_ref());
    record.settle_phase(s.now_ms);
    record
}

fn lose_files(record: &mut TaskRecord, files: &Collection, why: Option<&Failure>) {
    record.collections.retain(|other| !other.is_same(files));
    let why = why.map_or_else(
        || "other runs ended before they could be sent".to_owned(),
        ToString::to_string,
    );
    let text = format!("files of run {} did not come back: {why}", files.run);
    let failure = Failure::new(FailureCode::OUTPUTS_LOST, text);
    record.lost = Some(LostFiles { deployment: files.deployment.clone(), run: files.run, failure });
}

impl Collection {
    fn is_same(&self, other: &Self) -> bool {
        self.deployment == other.deployment && self.run == other.run
    }
}

fn after_reboot(record: &mut TaskRecord, now_ms: u64) {
    let Some(active) = &mut record.active else { return };
    let job = active.rules.kind == TaskKind::Job;
    if job && !active.rules.idempotent {
        active.end = Some(interrupted("the robot was restarted while the job ran"));
    } else if active.rules.on_boot == OnBoot::Hold {
        active.end = Some(End { phase: Phase::Stopped, failure: None });
        came_back_in_vain(record, Phase::Stopped, "stays down after the reboot");
    } else {
        active.retry_at_ms = 0;
        active.first_start_ms = now_ms;
    }
}

fn job_ended(active: &mut ActiveRun, exit: &Exit) {
    active.end = match exit.status {
        Some(_) if exit.is_success() => Some(End { phase: Phase::Succeeded, failure: None }),
        Some(_) => Some(exited(exit)),
        None if active.rules.idempotent => None,
        None => Some(interrupted(
            "the job's process was gone, without an exit status, when it was looked for",
        )),
    };
}

/// Limits the restarts of a service. A service that was never ready has its readiness timeout to
/// become so; one that was ready has [`MAX_RESTARTS_IN_A_ROW`] restarts.
fn give_up_or_retry(record: &mut TaskRecord, s: &Situation<'_>, failure: Failure, again: bool) {
    let Some(active) = &mut record.active else { return };
    let tried_ms = s.now_ms.saturating_sub(active.first_start_ms);
    let too_late = !active.ever_ready && tried_ms >= u64::from(active.rules.ready_timeout_s) * 1000;
    if !again || too_late || active.restarts_in_a_row >= MAX_RESTARTS_IN_A_ROW {
        return give_up(record, s, failure);
    }
    active.restarts = active.restarts.saturating_add(1);
    active.restarts_in_a_row += 1;
    active.retry_at_ms =
        s.now_ms + backoff_ms(active.restarts_in_a_row, MAX_RESTART_BACKOFF_MS, s.jitter);
}

/// Ends the active run for good. The run that it replaced comes back, if the active run was never
/// ready.
fn give_up(record: &mut TaskRecord, s: &Situation<'_>, failure: Failure) {
    let Some(active) = &mut record.active else { return };
    let Some(mut before) = record.fallback.take() else {
        let text = failure.text.clone();
        active.end = Some(End { phase: Phase::Failed, failure: Some(failure) });
        return came_back_in_vain(record, Phase::Failed, &format!("failed: {text}"));
    };
    let (deployment, run) = (active.deployment.clone(), active.run);
    before.first_start_ms = s.now_ms;
    record.active = Some(before);
    record.finish(deployment, run, End { phase: Phase::RolledBack, failure: Some(failure) });
}

/// After a rollback, the state of the order follows the run that came back. Once that run is over
/// as well, the order is no longer `rolled_back`.
fn came_back_in_vain(record: &mut TaskRecord, phase: Phase, what: &str) {
    let Some(active) = record.active.as_ref().filter(|active| !active.is_for(&record.order)) else {
        return;
    };
    let Some(end) = record.end_of_order().filter(|end| end.phase == Phase::RolledBack) else {
        return;
    };
    let why = end.failure.clone().map(|failure| {
        let version = &active.package.version;
        Failure::new(
            failure.code,
            format!("{}\n{version}, which had come back, {what}", failure.text),
        )
    });
    let (deployment, run) = (record.order.deployment.clone(), record.order.run);
    record.finish(deployment, run, End { phase, failure: why });
}

fn exited(exit: &Exit) -> End {
    End { phase: Phase::Failed, failure: Some(exit.failure()) }
}

fn interrupted(text: &str) -> End {
    End { phase: Phase::Failed, failure: Some(Failure::new(FailureCode::INTERRUPTED, text)) }
}

impl ActiveRun {
    /// The run that `order` asks for, before its first start.
    pub fn of(order: &DesiredTask, rules: RunRules, now_ms: u64) -> Self {
        Self {
            deployment: order.deployment.clone(),
            run: order.run,
            package: order.package.clone(),
            rules,
            process: None,
            restarts: 0,
            restarts_in_a_row: 0,
            retry_at_ms: 0,
            first_start_ms: now_ms,
            ever_ready: false,
            admitted: false,
            ever_started: false,
            end: None,
        }
    }
}
