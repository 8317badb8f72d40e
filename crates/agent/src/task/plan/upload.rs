//! Decides about the output files of ended runs. Pure, like the plan.
//!
//! The ledger records the end of a run before its files are uploaded, so a job never runs again for
//! the sake of its files. A job's end is reported once its files are uploaded or given up.

use task_proto::desired::TargetState;
use task_proto::messages::report::{Failure, FailureCode};
use task_proto::packages::manifest::TaskKind;

use super::{MAX_STEP_BACKOFF_MS, Next, Outcome, PlanInput, Step, StepFailure, change};
use crate::task::ledger::{LostFiles, OutputUpload, TaskRecord};
use crate::task::run::ActiveRun;
use crate::task::timing::{BACKOFF_BASE_MS, Moment, backoff_ms};

/// How long the upload is attempted, within one boot of the robot.
const GIVE_UP_MS: u64 = 24 * 60 * 60 * 1000;
/// The maximum number of ended runs that wait for their upload; beyond this the oldest is given up.
const MAX_WAITING: usize = 4;

/// The next step of the upload of ended runs' files.
pub fn upload(s: &PlanInput<'_>) -> Next {
    let Some(collection) =
        s.record.collections.first().filter(|_| s.desired.is_some() && !s.is_deleting())
    else {
        return Next::Rest { until_ms: None };
    };
    let give_up_ms = collection.since_ms + GIVE_UP_MS;
    if s.at.now_ms >= give_up_ms || s.record.collections.len() > MAX_WAITING {
        return change(s, |record| lose(record, collection, collection.failure.as_ref()));
    }
    if s.at.now_ms < collection.retry_at_ms {
        return Next::Rest { until_ms: Some(collection.retry_at_ms.min(give_up_ms)) };
    }
    Next::Act(Step::UploadOutputs(Box::new(collection.clone())))
}

/// Whether a job's files still lie where a process of `run` would write. A service does not wait
/// for its last files.
pub(super) fn blocks_start(record: &TaskRecord, run: &ActiveRun) -> bool {
    let is_in_the_way =
        |files: &OutputUpload| files.package == run.package && files.kind == TaskKind::Job;
    record.collections.iter().any(is_in_the_way)
}

/// Queues the output files of `run`. The process is gone; files are not queued if the run continues
/// now or later with another process.
pub(super) fn queue_if_over(record: &mut TaskRecord, run: &ActiveRun, now_ms: u64) {
    let goes_on =
        record.active.as_ref().is_some_and(|active| active.is_same(run) && active.end().is_none());
    let stopped = record.order.wanted == TargetState::Stopped;
    // A replaced run may come back; it is over once the new run is ready.
    if !goes_on || stopped {
        queue(record, run, now_ms);
    }
}

/// Queues the output files of a run that left the record without an end of its own. The run was
/// stopped for another run and will not come back.
pub(super) fn queue_if_replaced(record: &mut TaskRecord, run: Option<ActiveRun>, now_ms: u64) {
    let Some(run) = run.filter(|run| run.end().is_none() && run.has_started()) else { return };
    if ![&record.active, &record.fallback].into_iter().flatten().any(|other| other.is_same(&run)) {
        queue(record, &run, now_ms);
    }
}

/// Queues the output files of `run`, if it may have some.
pub(super) fn queue(record: &mut TaskRecord, run: &ActiveRun, now_ms: u64) {
    if run.rules.has_outputs {
        let files = OutputUpload::of(run, now_ms);
        record.collections.retain(|other| !other.is_same(&files));
        record.collections.push(files);
    }
}

/// Records the outcome of the upload of `files`.
pub(super) fn finish(
    record: &mut TaskRecord,
    files: &OutputUpload,
    outcome: Outcome,
    at: &Moment<'_>,
) {
    match outcome {
        Ok(_) => record.collections.retain(|other| !other.is_same(files)),
        Err(StepFailure { failure, retry_after_ms: None }) => lose(record, files, Some(&failure)),
        Err(StepFailure { failure, retry_after_ms: Some(least_ms) }) => {
            for files in record.collections.iter_mut().filter(|other| other.is_same(files)) {
                files.attempts = files.attempts.saturating_add(1);
                let wait_ms =
                    backoff_ms(files.attempts, MAX_STEP_BACKOFF_MS, at.jitter).max(least_ms);
                files.retry_at_ms = at.now_ms.saturating_add(wait_ms.max(BACKOFF_BASE_MS));
                files.failure = Some(failure.clone());
            }
        }
    }
}

/// Gives up the files of a run.
fn lose(record: &mut TaskRecord, files: &OutputUpload, why: Option<&Failure>) {
    record.collections.retain(|other| !other.is_same(files));
    let why = why.map_or_else(
        || "later runs ended before the upload succeeded".to_owned(),
        ToString::to_string,
    );
    let text = format!("output files of run {} were not uploaded: {why}", files.run);
    let failure = Failure::new(FailureCode::OUTPUTS_LOST, text);
    record.lost = Some(LostFiles { deployment: files.deployment.clone(), run: files.run, failure });
}
