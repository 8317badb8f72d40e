//! Decides when the robot's gate is asked, and interprets its answer. Pure, like the plan.
//!
//! The gate is asked before the first start of a run, before its first start since the robot
//! booted, before the operator's order stops a run, and before one version replaces another. The
//! answer to a replacement covers the stop of the old version, the start of the new one, and the
//! return of the old one if the new one does not become ready. The gate is not asked before a
//! restart of a process that ended by itself, nor before a stop of a failed process: the robot has
//! admitted the run, and half of a run does not help the robot.

use task_proto::desired::TargetState;

use super::{Lane, Next, Outcome, PlanInput, Step, StepFailure, change, takes_over};
use crate::task::ledger::{GateAnswer, GateQuestion, GateRecord, GateStep};
use crate::task::observed::ProcessState;
use crate::task::run::ActiveRun;
use crate::task::timing::Moment;

/// The longest wait before the robot's gate is asked again.
const MAX_GATE_BACKOFF_MS: u64 = 60 * 1000;

/// The gate's decision about the next step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum GateDecision {
    /// There is no gate, the gate allowed the step, or the step needs no permission.
    Proceed,
    /// The gate has not answered yet.
    Pending,
    /// The gate refused and is asked again later.
    Refused,
}

/// The next question to the gate, if one is due now.
pub fn check_gate(s: &PlanInput<'_>) -> Next {
    let rest = |until_ms| Next::Rest { until_ms };
    // The allowed step may be the one under way.
    if s.is_busy(Lane::Run) {
        return rest(None);
    }
    match (question(s), &s.record.gate) {
        (None, None) => rest(None),
        (None, Some(_)) => change(s, |record| record.gate = None),
        (Some(question), Some(gate)) if gate.question == question => match gate.answer {
            Some(GateAnswer::Allowed) => rest(None),
            Some(GateAnswer::Refused(_)) if s.at.now_ms < gate.retry_at_ms => {
                rest(Some(gate.retry_at_ms))
            }
            _ => Next::Act(Step::QueryGate(question)),
        },
        (Some(question), _) => Next::Act(Step::QueryGate(question)),
    }
}

/// Whether the gate permits the next step.
pub(super) fn decision(s: &PlanInput<'_>) -> GateDecision {
    let Some(question) = question(s) else { return GateDecision::Proceed };
    match s.record.gate.as_ref().filter(|gate| gate.question == question).map(|gate| &gate.answer) {
        Some(Some(GateAnswer::Allowed)) => GateDecision::Proceed,
        Some(Some(GateAnswer::Refused(_))) => GateDecision::Refused,
        _ => GateDecision::Pending,
    }
}

/// The question that the gate has to answer before any further step.
fn question(s: &PlanInput<'_>) -> Option<GateQuestion> {
    if !s.permissions.gated {
        return None;
    }
    let order = &s.record.order;
    let active = s.record.active.as_ref();
    let question_for_order = |step| GateQuestion {
        step,
        deployment: order.deployment.clone(),
        run: order.run,
        version: order.package.version.clone(),
    };
    let question_for_active = |step| {
        let active = active?;
        Some(GateQuestion {
            step,
            deployment: active.deployment.clone(),
            run: active.run,
            version: active.package.version.clone(),
        })
    };
    let takes_over = takes_over(s) && active.is_none_or(|active| !active.is_for(order));
    if let Some(active) = active.filter(|active| active.process().is_some()) {
        if active.pending_stop().is_some() || !matches!(s.process, ProcessState::Alive { .. }) {
            return None;
        }
        return match s.desired.is_some_and(|task| task.wanted == TargetState::Running) {
            false => question_for_active(GateStep::Stop),
            true => takes_over.then(|| question_for_order(GateStep::Switch)),
        };
    }
    if takes_over {
        let switch = question_for_order(GateStep::Switch);
        let allowed = |gate: &&GateRecord| {
            gate.question == switch && gate.answer == Some(GateAnswer::Allowed)
        };
        return Some(if s.record.gate.as_ref().is_some_and(|gate| allowed(&gate)) {
            switch
        } else {
            question_for_order(GateStep::Start)
        });
    }
    let starts =
        |active: &&ActiveRun| active.is_waiting() && !active.is_admitted() && !s.permissions.held;
    active.filter(starts)?;
    (order.wanted == TargetState::Running && s.desired.is_some())
        .then(|| question_for_active(GateStep::Start))?
}

/// Keeps the record of a question that is asked again, and begins that of another question.
pub(super) fn begin(gate: &mut Option<GateRecord>, question: &GateQuestion) {
    if gate.as_ref().is_none_or(|gate| gate.question != *question) {
        let question = question.clone();
        *gate = Some(GateRecord { question, answer: None, refusals: 0, retry_at_ms: 0 });
    }
}

/// Records the answer to the question, if that is still the current one.
pub(super) fn finish(
    gate: Option<&mut GateRecord>,
    question: &GateQuestion,
    outcome: Outcome,
    at: &Moment<'_>,
) {
    let Some(gate) = gate.filter(|gate| gate.question == *question) else { return };
    gate.answer = Some(match outcome {
        Ok(_) => GateAnswer::Allowed,
        Err(StepFailure { failure, .. }) => {
            gate.refusals = gate.refusals.saturating_add(1);
            gate.retry_at_ms = at.retry_at(gate.refusals, MAX_GATE_BACKOFF_MS);
            GateAnswer::Refused(failure)
        }
    });
}
