//! Decides when the robot's gate is asked, and interprets its answer. Pure, like the plan.
//!
//! The gate is asked before the first start of a run, before its first start since the robot
//! booted, before the operator's order stops a run, and before one version replaces another. The
//! answer to a replacement covers the stop of the old version, the start of the new one, and the
//! return of the old one if the new one does not become ready. The gate is not asked before a
//! restart of a process that ended by itself, nor before a stop of a failed process: the robot has
//! admitted the run, and half of a run does not help the robot.

use task_proto::desired::Wanted;

use super::{Next, Situation, Step, record, takes_over, transition};
use crate::task::ledger::{GateAnswer, GateQuestion, GateStep};
use crate::task::observed::ProcessState;

/// The gate's decision about the next step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// There is no gate, the gate allowed the step, or the step needs no permission.
    Go,
    /// The gate has not answered yet.
    Asked,
    /// The gate refused and is asked again later.
    NotNow,
}

/// The next question to the gate, if one is due now.
pub fn consult(s: &Situation<'_>) -> Next {
    let rest = |until_ms| Next::Rest { until_ms };
    // The allowed step may be the one under way.
    if s.acting {
        return rest(None);
    }
    match (question(s), &s.record.gate) {
        (None, None) => rest(None),
        (None, Some(_)) => record(transition::ungated(s)),
        (Some(question), Some(gate)) if gate.question == question => match gate.answer {
            Some(GateAnswer::Allowed) => rest(None),
            Some(GateAnswer::Refused(_)) if s.now_ms < gate.retry_at_ms => {
                rest(Some(gate.retry_at_ms))
            }
            _ => Next::Act(Step::Ask(question)),
        },
        (Some(question), _) => Next::Act(Step::Ask(question)),
    }
}

/// Whether the gate permits the next step.
pub(super) fn verdict(s: &Situation<'_>) -> Verdict {
    let Some(question) = question(s) else { return Verdict::Go };
    match s.record.gate.as_ref().filter(|gate| gate.question == question).map(|gate| &gate.answer) {
        Some(Some(GateAnswer::Allowed)) => Verdict::Go,
        Some(Some(GateAnswer::Refused(_))) => Verdict::NotNow,
        _ => Verdict::Asked,
    }
}

/// The question that the gate has to answer before any further step.
fn question(s: &Situation<'_>) -> Option<GateQuestion> {
    if !s.gated {
        return None;
    }
    let order = &s.record.order;
    let active = s.record.active.as_ref();
    let process = active.and_then(|active| active.process.as_ref());
    let of_order = |step| GateQuestion {
        step,
        deployment: order.deployment.clone(),
        run: order.run,
        version: order.package.version.clone(),
    };
    let of_active = |step| {
        let active = active?;
        Some(GateQuestion {
            step,
            deployment: active.deployment.clone(),
            run: active.run,
            version: active.package.version.clone(),
        })
    };
    let takes_over = takes_over(s) && active.is_none_or(|active| !active.is_for(order));
    if let Some(process) = process {
        if process.condemned.is_some() || !matches!(s.process, ProcessState::Alive { .. }) {
            return None;
        }
        return match s.desired.is_some_and(|task| task.wanted == Wanted::Running) {
            false => of_active(GateStep::Stop),
            true => takes_over.then(|| of_order(GateStep::Switch)),
        };
    }
    if takes_over {
        let switch = of_order(GateStep::Switch);
        let allowed = |gate: &&crate::task::ledger::GateRecord| {
            gate.question == switch && gate.answer == Some(GateAnswer::Allowed)
        };
        return Some(if s.record.gate.as_ref().is_some_and(|gate| allowed(&gate)) {
            switch
        } else {
            of_order(GateStep::Start)
        });
    }
    let starts = |active: &&crate::task::ledger::ActiveRun| {
        active.end.is_none() && !active.admitted && !s.held
    };
    active.filter(starts)?;
    (order.wanted == Wanted::Running && s.desired.is_some()).then(|| of_active(GateStep::Start))?
}
