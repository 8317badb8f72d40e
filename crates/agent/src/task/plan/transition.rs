//! The changes of a record by a new order, and by the beginning and the end of a step. Pure, like
//! the plan.

use task_proto::desired::{DesiredTask, TargetState};
use task_proto::packages::manifest::TaskKind;

use super::{MAX_STEP_BACKOFF_MS, Outcome, Step, gate, preparation, process, upload};
use crate::task::ledger::{Preparation, TaskRecord};
use crate::task::timing::Moment;

/// Puts the record under a new order. A live run continues until the new version takes over.
pub(super) fn adopt_order(record: &mut TaskRecord, order: &DesiredTask, now_ms: u64) {
    let is_down = record.active.as_ref().is_none_or(|active| active.process().is_none());
    if record.order.wanted == TargetState::Stopped && is_down {
        let fallback = record.fallback.clone();
        record.discard_stopped_run(order, now_ms);
        upload::queue_if_replaced(record, fallback, now_ms);
    }
    record.order = order.clone();
    (record.preparation, record.restoring) = (Preparation::default(), None);
}

/// The record that is written before `step` begins. `start` is the agent's start counter.
pub fn begin_step(record: &TaskRecord, step: &Step, start: u64, at: &Moment<'_>) -> TaskRecord {
    record.changed(at.now_ms, |record| match step {
        Step::CheckSigners(_)
        | Step::PullManifest(_)
        | Step::ProbeRos(_)
        | Step::PullContent { .. }
        | Step::Build { .. } => preparation::begin(record.preparation_mut(), step),
        Step::QueryGate(question) => gate::begin(&mut record.gate, question),
        Step::Start(run) => process::begin_start(record, run, start, at),
        Step::Remove => record.collections.clear(),
        Step::Stop(_) | Step::UploadOutputs(_) | Step::Prune { .. } => {}
    })
}

/// The record after `step` ended with `outcome`. `kind` is that of the prepared package, if its
/// manifest was known when the step began.
pub fn finish_step(
    record: &TaskRecord,
    step: &Step,
    outcome: Outcome,
    kind: Option<TaskKind>,
    at: &Moment<'_>,
) -> TaskRecord {
    record.changed(at.now_ms, |record| match step {
        Step::CheckSigners(package)
        | Step::PullManifest(package)
        | Step::ProbeRos(package)
        | Step::PullContent { package, .. }
        | Step::Build { package, .. } => {
            // A step for an order that was replaced meanwhile says nothing about the new order.
            if record.to_prepare().0 == package {
                preparation::finish(record.preparation_mut(), outcome, kind, at);
            }
        }
        Step::QueryGate(question) => gate::finish(record.gate.as_mut(), question, outcome, at),
        Step::Start(_) => process::finish_start(record, outcome, at),
        Step::Stop(run) => process::finish_stop(record, run, outcome, at),
        Step::UploadOutputs(files) => upload::finish(record, files, outcome, at),
        Step::Remove if outcome.is_err() => {
            let preparation = &mut record.preparation;
            preparation.attempts = preparation.attempts.saturating_add(1);
            preparation.retry_at_ms = at.retry_at(preparation.attempts, MAX_STEP_BACKOFF_MS);
        }
        Step::Remove | Step::Prune { .. } => {}
    })
}
