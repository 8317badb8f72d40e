//! The effects of a process's start, stop and end on the task's record: the run continues,
//! is over, or gives way to the run that it replaced. Pure, like the plan.

use task_proto::messages::report::{Failure, FailureCode, Phase};
use task_proto::packages::manifest::{OnBoot, Restart, TaskKind};

use super::{Done, MAX_STEP_BACKOFF_MS, Outcome, StepFailure, preparation, run_dir_name, upload};
use crate::task::ledger::TaskRecord;
use crate::task::observed::Exit;
use crate::task::run::{ActiveRun, End, PendingStop, ProcessRecord};
use crate::task::timing::Moment;

/// Makes `run` the active run, with a process that is about to be started. `start` is the agent's
/// start counter.
pub(super) fn begin_start(record: &mut TaskRecord, run: &ActiveRun, start: u64, at: &Moment<'_>) {
    if !record.active.as_ref().is_some_and(|active| active.is_same(run)) {
        let runs = [record.active.clone(), record.fallback.clone()];
        record.retire_active(run);
        for left in runs {
            let replaced = left.filter(|left| left.package != run.package);
            upload::queue_if_replaced(record, replaced, at.now_ms);
        }
    }
    (record.gate, record.restoring) = (None, None);
    record.starts = record.starts.saturating_add(1);
    if run.is_for(&record.order) && record.preparation.is_under_way() {
        (record.preparation.phase, record.preparation.failure) = (Phase::Staged, None);
    }
    let process = ProcessRecord {
        dir: run_dir_name(run, start, record.starts),
        boot_id: at.boot_id.to_owned(),
        started_ms: at.now_ms,
        pid: None,
    };
    record.active = Some(run.clone().begin(process));
}

/// Records the outcome of a start.
pub(super) fn finish_start(record: &mut TaskRecord, outcome: Outcome, at: &Moment<'_>) {
    match outcome {
        Ok(done) => {
            let pid = if let Done::Started(pid) = done { Some(pid) } else { None };
            record.change_active(|active| active.started(pid, at.now_ms));
        }
        Err(StepFailure { failure, retry_after_ms }) => {
            preparation::restart(record, &failure);
            // The process may have been started despite the failure. We act on the failure only
            // once no process is left.
            let pending_stop = PendingStop { failure, again: retry_after_ms.is_some() };
            record.change_active(|active| active.fail(pending_stop));
        }
    }
}

/// Records the outcome of the stop of `run`.
pub(super) fn finish_stop(
    record: &mut TaskRecord,
    run: &ActiveRun,
    outcome: Outcome,
    at: &Moment<'_>,
) {
    if outcome.is_err() {
        let retry_at_ms = at.retry_at(1, MAX_STEP_BACKOFF_MS);
        return record.change_active(|active| active.postpone(retry_at_ms));
    }
    if let Some(PendingStop { failure, again }) = lose_process(record) {
        restart_or_give_up(record, at, failure, again);
    } else {
        record.change_active(|active| match active.rules.kind {
            TaskKind::Job if active.is_waiting() => {
                active.finish(interrupted("the job was stopped before it ended"))
            }
            _ => active,
        });
    }
    upload::queue_if_over(record, run, at.now_ms);
}

/// The process in the record turns out to have never been started. The start does not count as an
/// attempt, unless it is known to have failed.
pub(super) fn never_started(record: &mut TaskRecord, at: &Moment<'_>) {
    let Some(PendingStop { failure, again }) = lose_process(record) else { return };
    let run = record.active.clone();
    // A job may be retried as well: none of it has run.
    restart_or_give_up(record, at, failure, again);
    // Earlier processes of the run may have written files.
    if let Some(run) = run.filter(ActiveRun::has_started) {
        upload::queue_if_over(record, &run, at.now_ms);
    }
}

/// The active run's process has ended without a stop from the agent.
pub(super) fn ended(record: &mut TaskRecord, exit: &Exit, at: &Moment<'_>) {
    let Some(run) = record.active.take().map(ActiveRun::known_started) else { return };
    record.active = Some(run.clone());
    let Some(process) = run.process() else { return };
    let is_job = run.rules.kind == TaskKind::Job;
    if let Some(PendingStop { failure, again }) = lose_process(record) {
        restart_or_give_up(record, at, failure, again && !is_job);
    } else if process.boot_id != at.boot_id && !(is_job && exit.is_success()) {
        // The process ended because the robot went down, whatever its exit status.
        after_reboot(record, at.now_ms);
    } else if is_job {
        record.change_active(|active| match job_end(&active, exit) {
            Some(end) => active.finish(end),
            None => active,
        });
    } else {
        let again = match run.rules.restart {
            Restart::Never => false,
            Restart::OnFailure => !exit.is_success(),
            Restart::Always => true,
        };
        restart_or_give_up(record, at, exit.failure(), again);
    }
    upload::queue_if_over(record, &run, at.now_ms);
}

/// The deleted files of the active run are known to be unrecoverable.
pub(super) fn give_up_unrestored(record: &mut TaskRecord, now_ms: u64) {
    let failure = record.to_prepare().1.failure.clone().unwrap_or_else(|| {
        Failure::new(FailureCode::TREE_CHANGED, "its files are no longer on the disk")
    });
    give_up(record, now_ms, failure);
}

/// Leaves the active run without a process. Returns why the process was to be stopped, if it was.
fn lose_process(record: &mut TaskRecord) -> Option<PendingStop> {
    let pending_stop = record.active.as_ref()?.pending_stop().cloned();
    record.change_active(ActiveRun::lose_process);
    pending_stop
}

fn after_reboot(record: &mut TaskRecord, now_ms: u64) {
    let Some(rules) = record.active.as_ref().map(|active| active.rules) else { return };
    if rules.kind == TaskKind::Job && !rules.idempotent {
        let end = interrupted("the robot was restarted while the job ran");
        record.change_active(|active| active.finish(end));
    } else if rules.on_boot == OnBoot::Hold {
        record.change_active(|active| active.finish(End::without_failure(Phase::Stopped)));
        end_after_rollback(record, Phase::Stopped, "stays down after the reboot");
    } else {
        record.change_active(|active| active.resume_after_reboot(now_ms));
    }
}

/// The end of a job whose process has ended, unless the job is to run again.
fn job_end(job: &ActiveRun, exit: &Exit) -> Option<End> {
    match exit.status {
        Some(_) if exit.is_success() => Some(End::without_failure(Phase::Succeeded)),
        Some(_) => Some(End::failed(exit.failure())),
        None if job.rules.idempotent => None,
        None => Some(interrupted("the job's process disappeared without an exit status")),
    }
}

fn restart_or_give_up(record: &mut TaskRecord, at: &Moment<'_>, failure: Failure, again: bool) {
    let Some(active) = &record.active else { return };
    if again && active.has_restarts_left(at.now_ms) {
        record.change_active(|active| active.restart(at));
    } else {
        give_up(record, at.now_ms, failure);
    }
}

/// Ends the active run for good. The run that it replaced comes back, if the active run was never
/// ready.
fn give_up(record: &mut TaskRecord, now_ms: u64, failure: Failure) {
    let Some(active) = record.active.take() else { return };
    record.restoring = None;
    if let Some(replaced) = record.fallback.take() {
        record.active = Some(replaced.come_back(now_ms));
        let end = End { phase: Phase::RolledBack, failure: Some(failure) };
        return record.finish(active.deployment, active.run, end);
    }
    let text = format!("failed: {}", failure.text);
    record.active = Some(active.finish(End::failed(failure)));
    end_after_rollback(record, Phase::Failed, &text);
}

/// After a rollback, the state of the order follows the run that came back. Once that run is over
/// as well, the order is no longer `rolled_back`.
fn end_after_rollback(record: &mut TaskRecord, phase: Phase, what: &str) {
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
            format!("{}\n{version}, which had been restored, {what}", failure.text),
        )
    });
    let (deployment, run) = (record.order.deployment.clone(), record.order.run);
    record.finish(deployment, run, End { phase, failure: why });
}

fn interrupted(text: &str) -> End {
    End::failed(Failure::new(FailureCode::INTERRUPTED, text))
}
