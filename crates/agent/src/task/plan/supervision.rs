//! Supervision of a live, wanted process: readiness, degradation and the deadline. Pure, like the
//! plan.

use task_proto::messages::report::{Failure, FailureCode};
use task_proto::packages::manifest::TaskKind;

use super::{Next, PlanInput, Step, change, prune_surplus, upload};
use crate::task::observed::Health;
use crate::task::run::{ActiveRun, PendingStop, ProcessRecord};

/// After this time without an end, a run is calm and its restart count is reset.
const CALM_MS: u64 = 10 * 60 * 1000;

/// The next step for `process`, which no order stops.
pub(super) fn next(s: &PlanInput<'_>, active: &ActiveRun, process: &ProcessRecord) -> Next {
    if active.pending_stop().is_some() {
        return stop(s, active);
    }
    if let Some(pending_stop) = exceeded_deadline(s, active, process) {
        return fail(s, pending_stop);
    }
    if active.is_ready() {
        check_ready_run(s, active, process)
    } else {
        await_readiness(s, active, process)
    }
}

/// The process has failed and is to be stopped.
fn fail(s: &PlanInput<'_>, pending_stop: PendingStop) -> Next {
    change(s, |record| record.change_active(|active| active.fail(pending_stop)))
}

/// All readiness conditions have held long enough. The new run has proved itself, so the replaced
/// run is not needed any more.
fn become_ready(s: &PlanInput<'_>) -> Next {
    change(s, |record| {
        if let Some(replaced) = record.fallback.take() {
            upload::queue(record, &replaced, s.at.now_ms);
        }
        record.change_active(ActiveRun::become_ready);
    })
}

/// Stops the run's process, unless a stop has just failed.
pub(super) fn stop(s: &PlanInput<'_>, active: &ActiveRun) -> Next {
    if s.at.now_ms < active.retry_at_ms() {
        return Next::Rest { until_ms: Some(active.retry_at_ms()) };
    }
    Next::Act(Step::Stop(Box::new(active.clone())))
}

fn deadline_ms(active: &ActiveRun, process: &ProcessRecord) -> Option<u64> {
    let deadline_s = active.rules.deadline_s.filter(|_| active.rules.kind == TaskKind::Job)?;
    Some(process.started_ms + u64::from(deadline_s) * 1000)
}

fn exceeded_deadline(
    s: &PlanInput<'_>,
    active: &ActiveRun,
    process: &ProcessRecord,
) -> Option<PendingStop> {
    deadline_ms(active, process).filter(|at_ms| s.at.now_ms >= *at_ms)?;
    let text = format!("the job did not end within {} s", active.rules.deadline_s?);
    Some(PendingStop { failure: Failure::new(FailureCode::DEADLINE_EXCEEDED, text), again: false })
}

fn await_readiness(s: &PlanInput<'_>, active: &ActiveRun, process: &ProcessRecord) -> Next {
    let timeout_s = active.rules.ready_timeout_s;
    let too_late_ms = process.started_ms + u64::from(timeout_s) * 1000;
    let failure = match s.health {
        Health::Refused(failure) => failure.clone(),
        // Conditions that were met in time get the full hold time.
        Health::Holds { since_ms } if *since_ms <= too_late_ms => {
            let ready_at_ms =
                (*since_ms).max(process.started_ms) + u64::from(active.rules.hold_s) * 1000;
            return if s.at.now_ms >= ready_at_ms {
                become_ready(s)
            } else {
                rest(active, process, ready_at_ms)
            };
        }
        _ if s.at.now_ms < too_late_ms => return rest(active, process, too_late_ms),
        Health::Missing(missing) => missing.timeout_failure(timeout_s),
        Health::Unknown => Failure::new(
            FailureCode::NOT_READY,
            format!("not seen on the ROS graph within {timeout_s} s"),
        ),
        Health::Holds { .. } => {
            let text = format!("its readiness conditions were met only after {timeout_s} s");
            Failure::new(FailureCode::NOT_READY, text)
        }
    };
    // A run that was ready before is restarted; a run that never was has failed. The same holds for
    // a refusal: after a power cut a device may come up later than its driver.
    let again = active.was_ever_ready() && active.may_restart();
    fail(s, PendingStop { failure, again })
}

fn check_ready_run(s: &PlanInput<'_>, active: &ActiveRun, process: &ProcessRecord) -> Next {
    if let Health::Missing(missing) = s.health
        && missing.is_own_fault
        && active.may_restart()
    {
        let enough_ms = missing.since_ms.max(process.started_ms)
            + u64::from(active.rules.ready_timeout_s) * 1000;
        if s.at.now_ms < enough_ms {
            return rest(active, process, enough_ms);
        }
        return fail(s, PendingStop { failure: missing.failure(), again: true });
    }
    let deadline_ms = deadline_ms(active, process);
    if active.restarts_in_a_row() == 0 {
        return prune_surplus(s, deadline_ms);
    }
    let calm_at_ms = process.started_ms + CALM_MS;
    if s.at.now_ms >= calm_at_ms && !matches!(s.health, Health::Missing(_)) {
        return change(s, |record| record.change_active(ActiveRun::calm_down));
    }
    prune_surplus(
        s,
        [deadline_ms, Some(calm_at_ms).filter(|at_ms| *at_ms > s.at.now_ms)]
            .into_iter()
            .flatten()
            .min(),
    )
}

fn rest(active: &ActiveRun, process: &ProcessRecord, until_ms: u64) -> Next {
    let until_ms = deadline_ms(active, process).map_or(until_ms, |at_ms| until_ms.min(at_ms));
    Next::Rest { until_ms: Some(until_ms) }
}
