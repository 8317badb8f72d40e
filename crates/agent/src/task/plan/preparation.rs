//! Prepares the ordered version: checked, fetched, unpacked, built, staged. Once the order is over,
//! prepares the version of another run whose files were changed. Pure, like the plan.

use task_proto::desired::TargetState;
use task_proto::messages::report::{Failure, FailureCode, Phase};
use task_proto::packages::manifest::TaskKind;

use super::{
    Done, MAX_STEP_BACKOFF_MS, Next, Outcome, PlanInput, Step, StepFailure, change, lacks_files,
};
use crate::task::ledger::{Preparation, TaskRecord};
use crate::task::observed::{RobotFacts, SignatureVerdict};
use crate::task::timing::{BACKOFF_BASE_MS, Moment, backoff_ms};

/// The most jitter that is added to a wait requested by the server.
const MAX_WAIT_JITTER_MS: u64 = 30 * 1000;

/// The next step towards `staged` for the version to prepare.
pub fn prepare(s: &PlanInput<'_>) -> Next {
    const NOTHING: Next = Next::Rest { until_ms: None };
    let order = &s.record.order;
    let restores = s.record.run_to_restore().is_some();
    let (package, preparation) = s.record.to_prepare();
    if s.desired != Some(order)
        || order.wanted == TargetState::Stopped
        || !(restores || order_needs_files(s))
        || preparation.phase.is_final()
        || !s.permissions.may_begin
        || s.is_deleting()
    {
        return NOTHING;
    }
    if s.at.now_ms < preparation.retry_at_ms {
        return Next::Rest { until_ms: Some(preparation.retry_at_ms) };
    }
    // Checked before any of the package is fetched, and again whenever the signatures turn out to
    // be no longer sufficient.
    if s.prepared.signatures != SignatureVerdict::Sufficient {
        return Next::Act(Step::CheckSigners(package.clone()));
    }
    let Some(manifest) = &s.prepared.manifest else {
        return Next::Act(Step::PullManifest(package.clone()));
    };
    if s.robot.labels.is_none() && !manifest.requires.labels.is_empty() {
        return NOTHING;
    }
    if let Some(text) = &s.robot.no_task_user {
        let failure = Failure::new(FailureCode::NO_TASK_USER, text);
        return enter_phase(s, Phase::Unmet, Some(failure));
    }
    if s.robot.installations.is_none() && RobotFacts::needs_ros_facts(manifest) {
        return Next::Act(Step::ProbeRos(package.clone()));
    }
    let lacks = s.robot.lacks(manifest);
    if !lacks.is_empty() {
        let text = format!(
            "this robot does not meet the requirements of {} {}: {}",
            order.task,
            package.version,
            lacks.join(", ")
        );
        let failure = Failure::new(FailureCode::REQUIREMENTS_UNMET, text);
        return enter_phase(s, Phase::Unmet, Some(failure));
    }
    if !s.prepared.content {
        // The server pushes only ordered packages.
        let is_pushed = order.delivery.is_pushed() && !restores;
        return Next::Act(Step::PullContent { package: package.clone(), is_pushed });
    }
    if !s.prepared.built {
        let restored = s.record.run_to_restore().map(|(run, _)| &run.deployment);
        let deployment = restored.unwrap_or(&order.deployment).clone();
        return Next::Act(Step::Build { package: package.clone(), deployment });
    }
    if restores {
        return change(s, |record| record.restoring = None);
    }
    let (phase, failure) = if s.permissions.held {
        let text = "it is staged and starts once a person at the robot releases it";
        (Phase::Deferred, Some(Failure::new(FailureCode::HELD, text)))
    } else {
        (Phase::Staged, None)
    };
    if preparation.phase == phase { NOTHING } else { enter_phase(s, phase, failure) }
}

/// Whether the ordered run has not ended, and its files have yet to be prepared.
fn order_needs_files(s: &PlanInput<'_>) -> bool {
    let active = s.record.active.as_ref().filter(|active| active.is_for(&s.record.order));
    s.record.end_of_order().is_none() && active.is_none_or(|active| lacks_files(s, active))
}

/// The preparation at `phase`.
fn enter_phase(s: &PlanInput<'_>, phase: Phase, failure: Option<Failure>) -> Next {
    change(s, |record| {
        let kind = s.prepared.kind();
        let preparation = record.preparation_mut();
        *preparation =
            Preparation { phase, failure, kind, attempts: 0, retry_at_ms: preparation.retry_at_ms };
    })
}

/// Counts the attempt that `step` is.
pub(super) fn begin(preparation: &mut Preparation, step: &Step) {
    let phase = match step {
        Step::Build { .. } => Phase::Building,
        _ => Phase::Fetching,
    };
    let is_repeated = preparation.phase == phase && preparation.failure.is_some();
    preparation.attempts = if is_repeated { preparation.attempts.saturating_add(1) } else { 1 };
    preparation.phase = phase;
}

/// Records the outcome of a step for a package of this kind, if its manifest is known.
pub(super) fn finish(
    preparation: &mut Preparation,
    outcome: Outcome,
    kind: Option<TaskKind>,
    at: &Moment<'_>,
) {
    preparation.kind = kind;
    preparation.retry_at_ms = 0;
    match outcome {
        Ok(Done::RetryLater { at_least_ms }) => {
            // Only the end of the order bounds the number of waits: the server knows when it has
            // capacity.
            preparation.failure = None;
            let wait_ms = at_least_ms.saturating_add(wait_jitter_ms(at_least_ms, at.jitter));
            preparation.retry_at_ms = at.now_ms.saturating_add(wait_ms);
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
                backoff_ms(preparation.attempts, MAX_STEP_BACKOFF_MS, at.jitter).max(least_ms);
            preparation.retry_at_ms = at.now_ms.saturating_add(wait_ms);
        }
    }
}

/// Prepares the active run's version again after its files on the disk were found to be changed.
pub(super) fn restart(record: &mut TaskRecord, failure: &Failure) {
    let Some(active) = &record.active else { return };
    if failure.code != FailureCode::TREE_CHANGED {
        return;
    }
    let (phase, failure) = (Phase::Fetching, Some(failure.clone()));
    let kind = Some(active.rules.kind);
    let anew = Preparation { phase, failure, kind, ..Preparation::default() };
    match active.is_for(&record.order) {
        true => record.preparation = anew,
        false => record.restoring = Some(anew),
    }
}

/// Jitter for a wait of `least_ms`, so that robots with the same wait do not all come back at once.
fn wait_jitter_ms(least_ms: u64, jitter: f64) -> u64 {
    let most_ms = (least_ms / 4).clamp(BACKOFF_BASE_MS, MAX_WAIT_JITTER_MS);
    (most_ms as f64 * jitter.clamp(0.0, 1.0)) as u64
}
