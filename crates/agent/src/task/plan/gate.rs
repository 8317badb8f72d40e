//! When the robot's gate is asked, and what its answer means. Pure, like the plan.
//!
//! It is asked before a run is started for the first time or for the first time since the robot was
//! booted, before the operator's order stops one, and before one version takes the place of
//! another; that one answer covers the stop of the old, the start of the new, and the return of the
//! old should the new one not get ready. It is not asked before a process is started again that
//! ended by itself, nor before one is stopped that failed: the robot has let it in, and is no
//! better off with half of it.

use task_proto::desired::Wanted;

use super::{Next, Situation, Step, record, takes_over, transition};
use crate::task::ledger::{GateAnswer, GateQuestion, GateStep};
use crate::task::observed::ProcessState;

/// What the gate says of the step that is next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// There is no gate, it allowed the step, or it need not be asked.
    Go,
    /// It has not answered yet.
    Asked,
    /// It refused, and is asked again later.
    NotNow,
}

/// The next question to the gate, if there is one to be asked now.
pub fn consult(s: &Situation<'_>) -> Next {
    let rest = |until_ms| Next::Rest { until_ms };
    // The step that was allowed may be the one under way.
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

/// Whether the step that is next may be done as far as the gate is concerned.
pub(super) fn verdict(s: &Situation<'_>) -> Verdict {
    let Some(question) = question(s) else { return Verdict::Go };
    match s.record.gate.as_ref().filter(|gate| gate.question == question).map(|gate| &gate.answer) {
        Some(Some(GateAnswer::Allowed)) => Verdict::Go,
        Some(Some(GateAnswer::Refused(_))) => Verdict::NotNow,
        _ => Verdict::Asked,
    }
}

/// What the gate has to allow before anything more can be done.
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
