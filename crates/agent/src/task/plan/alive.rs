//! Supervision of a live, wanted process: readiness, degradation and the deadline. Pure, like the
//! plan.

use task_proto::manifest::{Restart, TaskKind};
use task_proto::report::{Failure, FailureCode};

use super::{CALM_MS, Next, Situation, Step, record, tidy, transition};
use crate::task::ledger::{ActiveRun, Condemned, ProcessRecord};
use crate::task::observed::Health;

/// The next step for `process`, which no order stops.
pub(super) fn next(s: &Situation<'_>, active: &ActiveRun, process: &ProcessRecord) -> Next {
    if process.condemned.is_some() {
        return stop(s, active);
    }
    if let Some(condemned) = overdue(s, active, process) {
        return record(transition::condemned(s, condemned));
    }
    if process.ready { goes_on(s, active, process) } else { gets_ready(s, active, process) }
}

/// Stops the run's process, unless a stop has just failed.
pub(super) fn stop(s: &Situation<'_>, active: &ActiveRun) -> Next {
    if s.now_ms < active.retry_at_ms {
        return Next::Rest { until_ms: Some(active.retry_at_ms) };
    }
    Next::Act(Step::Stop(Box::new(active.clone())))
}

fn deadline_ms(active: &ActiveRun, process: &ProcessRecord) -> Option<u64> {
    let deadline_s = active.rules.deadline_s.filter(|_| active.rules.kind == TaskKind::Job)?;
    Some(process.started_ms + u64::from(deadline_s) * 1000)
}

fn overdue(s: &Situation<'_>, active: &ActiveRun, process: &ProcessRecord) -> Option<Condemned> {
    deadline_ms(active, process).filter(|at_ms| s.now_ms >= *at_ms)?;
    let text = format!("the job had not ended after {} s", active.rules.deadline_s?);
    Some(Condemned { failure: Failure::new(FailureCode::DEADLINE_EXCEEDED, text), again: false })
}

fn gets_ready(s: &Situation<'_>, active: &ActiveRun, process: &ProcessRecord) -> Next {
    let timeout_s = active.rules.ready_timeout_s;
    let too_late_ms = process.started_ms + u64::from(timeout_s) * 1000;
    let failure = match s.health {
        Health::Refused(failure) => failure.clone(),
        // Conditions that were met in time get the full hold time.
        Health::Holds { since_ms } if *since_ms <= too_late_ms => {
            let ready_at_ms =
                (*since_ms).max(process.started_ms) + u64::from(active.rules.hold_s) * 1000;
            return if s.now_ms >= ready_at_ms {
                record(transition::ready(s))
            } else {
                rest(active, process, ready_at_ms)
            };
        }
        _ if s.now_ms < too_late_ms => return rest(active, process, too_late_ms),
        Health::Missing(missing) => missing.not_within(timeout_s),
        Health::Unknown => Failure::new(
            FailureCode::NOT_READY,
            format!("nothing was seen of it on the ROS graph within {timeout_s} s"),
        ),
        Health::Holds { .. } => {
            let text = format!("what it promises held only after {timeout_s} s");
            Failure::new(FailureCode::NOT_READY, text)
        }
    };
    // A run that was ready before is restarted; a run that never was has failed. The same holds for
    // a refusal: after a power cut a device may come up later than its driver.
    let again = active.ever_ready && starts_again(active);
    record(transition::condemned(s, Condemned { failure, again }))
}

fn goes_on(s: &Situation<'_>, active: &ActiveRun, process: &ProcessRecord) -> Next {
    if let Health::Missing(missing) = s.health
        && missing.is_its_own
        && starts_again(active)
    {
        let enough_ms = missing.since_ms.max(process.started_ms)
            + u64::from(active.rules.ready_timeout_s) * 1000;
        if s.now_ms < enough_ms {
            return rest(active, process, enough_ms);
        }
        return record(transition::condemned(
            s,
            Condemned { failure: missing.failure(), again: true },
        ));
    }
    let deadline_ms = deadline_ms(active, process);
    if active.restarts_in_a_row == 0 {
        return tidy(s, deadline_ms);
    }
    let calm_at_ms = process.started_ms + CALM_MS;
    if s.now_ms >= calm_at_ms && !matches!(s.health, Health::Missing(_)) {
        return record(transition::calm(s.record));
    }
    tidy(
        s,
        [deadline_ms, Some(calm_at_ms).filter(|at_ms| *at_ms > s.now_ms)]
            .into_iter()
            .flatten()
            .min(),
    )
}

/// Whether the policy restarts a failed process. A job is never restarted: it runs once.
fn starts_again(active: &ActiveRun) -> bool {
    active.rules.kind == TaskKind::Service && active.rules.restart != Restart::Never
}

fn rest(active: &ActiveRun, process: &ProcessRecord, until_ms: u64) -> Next {
    let until_ms = deadline_ms(active, process).map_or(until_ms, |at_ms| until_ms.min(at_ms));
    Next::Rest { until_ms: Some(until_ms) }
}
