//! Brings one promised node up: its parameters are set, then it is configured and activated, from
//! any lifecycle state. Pure: the module returns the next question for the node and takes the
//! answers in.
//!
//! ```text
//! seen ─► parameters ─► configure ─► parameters ─► activate ─► parameters ─► up: only looked at from now on
//!            (only those that were undeclared are tried again; any other rejection refuses the run)
//! ```

use std::collections::BTreeMap;

use serde_json::Value;
use task_proto::report::{Failure, FailureCode};
use task_proto::ros::{GraphName, LifecycleState, Transition};

use crate::ros::graph::ParticipantId;

/// Pause before a question is repeated, when no answer came or the answer is expected to change
/// soon.
const ASK_AGAIN_MS: u64 = 500;
/// Interval between queries for the state of a lifecycle node that is up.
const LOOK_EVERY_MS: u64 = 2000;
/// Time that a node that is up has to declare parameters before the undeclared ones count as
/// rejected.
const UNDECLARED_PATIENCE_MS: u64 = 3000;

/// A question for a node.
#[derive(Debug, Clone, PartialEq)]
pub struct Question {
    pub node: GraphName,
    /// The participant of the node; answers of a later participant do not count.
    pub instance: ParticipantId,
    pub ask: Ask,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Ask {
    /// Any answer at all: a query for no parameter.
    Anything,
    /// The node's lifecycle state.
    State,
    /// Make a lifecycle transition.
    Transition(Transition),
    Set(Vec<(String, Value)>),
}

#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    Something,
    /// The node's lifecycle state.
    State(LifecycleState),
    /// Whether it made the transition.
    Transition(bool),
    /// For each parameter, in the order asked: accepted, or the reason for the rejection.
    Set(Vec<Result<(), String>>),
    /// No answer within the time limit.
    None,
}

/// A promised node that is being brought up.
#[derive(Debug, Clone)]
pub(super) struct BringUp {
    node: GraphName,
    is_lifecycle: bool,
    /// Whether the node offers services whose availability can only be tested by a question to the
    /// node.
    is_asked: bool,
    instance: ParticipantId,
    /// Parameters that the node has not accepted yet, each with its last rejection.
    pending: BTreeMap<String, (Value, Option<String>)>,
    /// The state in which they were last tried; a node without lifecycle counts as active.
    tried_in: Option<LifecycleState>,
    /// Start of the time in which only undeclared parameters are left.
    undeclared_since_ms: Option<u64>,
    state: Option<LifecycleState>,
    /// The node was brought up once, or by an earlier agent: it is only observed.
    is_up: bool,
    failed: Option<Transition>,
    refused: Option<Failure>,
    answered: bool,
    silent_since_ms: Option<u64>,
    in_flight: bool,
    ask_at_ms: u64,
}

/// Whether a rejection only means that the node has not declared the parameter yet: rclcpp and
/// rclpy have their own texts for this.
fn is_undeclared(reason: &str) -> bool {
    reason.contains("not declared") || reason.contains("undeclared")
}

impl BringUp {
    /// A node that has just been seen; `is_up`: an earlier agent brought it up.
    pub(super) fn new(
        node: GraphName,
        instance: ParticipantId,
        is_lifecycle: bool,
        parameters: Option<&BTreeMap<String, Value>>,
        is_up: bool,
    ) -> Self {
        let pending = parameters.filter(|_| !is_up).into_iter().flatten();
        Self {
            node,
            is_lifecycle,
            is_asked: false,
            instance,
            pending: pending.map(|(name, value)| (name.clone(), (value.clone(), None))).collect(),
            tried_in: None,
            undeclared_since_ms: None,
            state: None,
            is_up,
            failed: None,
            refused: None,
            answered: false,
            silent_since_ms: None,
            in_flight: false,
            ask_at_ms: 0,
        }
    }

    pub(super) fn instance(&self) -> ParticipantId {
        self.instance
    }

    /// Requires that the node answers a question.
    pub(super) fn must_answer(&mut self) {
        self.is_asked = true;
    }

    /// Whether the node answered once, if an answer is required.
    pub(super) fn answers(&self) -> bool {
        self.answered || !self.is_asked
    }

    pub(super) fn refused(&self) -> Option<&Failure> {
        self.refused.as_ref()
    }

    /// Whether the node was brought up, so that it is only observed.
    pub(super) fn is_up(&self) -> bool {
        self.is_up
    }

    pub(super) fn has_its_parameters(&self) -> bool {
        self.pending.is_empty()
    }

    /// The node's state, as far as known; `None`: the node has not told its state, or no longer
    /// answers.
    pub(super) fn state(&self) -> Option<LifecycleState> {
        self.state
    }

    /// Start of the time in which the node has answered nothing.
    pub(super) fn silent_since_ms(&self) -> Option<u64> {
        self.silent_since_ms
    }

    /// The next question for the node, if any.
    pub(super) fn question(&mut self, now_ms: u64) -> Option<Question> {
        if self.in_flight || self.refused.is_some() || now_ms < self.ask_at_ms {
            return None;
        }
        let ask = self.ask()?;
        self.in_flight = true;
        Some(Question { node: self.node.clone(), instance: self.instance, ask })
    }

    fn ask(&self) -> Option<Ask> {
        let unasked = (self.is_asked && !self.answered).then_some(Ask::Anything);
        if self.is_lifecycle && (self.is_up || self.state.is_none()) {
            return Some(Ask::State);
        }
        let stage = self.state.unwrap_or(LifecycleState::Active);
        let may_take = self.tried_in != Some(stage) || stage == LifecycleState::Active;
        if stage != LifecycleState::Changing && !self.pending.is_empty() && may_take {
            let pending =
                self.pending.iter().map(|(name, (value, _))| (name.clone(), value.clone()));
            return Some(Ask::Set(pending.collect()));
        }
        match self.state {
            Some(LifecycleState::Unconfigured) => Some(Ask::Transition(Transition::Configure)),
            Some(LifecycleState::Inactive) => Some(Ask::Transition(Transition::Activate)),
            Some(LifecycleState::Changing | LifecycleState::Active) => Some(Ask::State),
            Some(LifecycleState::Finalized) | None => unasked,
        }
    }

    pub(super) fn answered(&mut self, question: &Question, answer: Answer, now_ms: u64) {
        if question.instance != self.instance {
            return;
        }
        self.in_flight = false;
        self.ask_at_ms = now_ms;
        if answer == Answer::None {
            self.silent_since_ms.get_or_insert(now_ms);
            self.ask_at_ms = now_ms + ASK_AGAIN_MS;
            if matches!(question.ask, Ask::Transition(_)) {
                // The node may have made the transition all the same: query the state before asking
                // again.
                self.state = None;
            }
            return;
        }
        self.answered = true;
        self.silent_since_ms = None;
        match (&question.ask, answer) {
            (_, Answer::State(state)) => self.is_in(state, now_ms),
            (Ask::Transition(transition), Answer::Transition(true)) => {
                self.is_in(goal(*transition), now_ms)
            }
            (Ask::Transition(transition), Answer::Transition(false)) => {
                self.failed = Some(*transition);
                self.state = None;
            }
            (Ask::Set(asked), Answer::Set(results)) => self.took(asked, results, now_ms),
            _ => {}
        }
    }

    fn is_in(&mut self, state: LifecycleState, now_ms: u64) {
        self.state = Some(state);
        // Until the result of the other attempt is known, nothing has failed: another program may
        // bring the node up as well.
        let failed = if state == LifecycleState::Changing { None } else { self.failed.take() };
        if let Some(transition) = failed.filter(|transition| !leads_to(*transition, state)) {
            let text = format!(
                "`{}` failed to {} and is {}",
                self.node,
                transition.as_str(),
                state.as_str()
            );
            self.refused = Some(Failure::new(FailureCode::LIFECYCLE_FAILED, text));
        } else if state == LifecycleState::Finalized && !self.is_up {
            let text = format!("`{}` is finalized, from where nothing leads to active", self.node);
            self.refused = Some(Failure::new(FailureCode::LIFECYCLE_FAILED, text));
        }
        self.is_up |= state == LifecycleState::Active && self.pending.is_empty();
        if self.is_up {
            self.ask_at_ms = now_ms + LOOK_EVERY_MS;
        } else if state == LifecycleState::Changing {
            self.ask_at_ms = now_ms + ASK_AGAIN_MS;
        }
    }

    fn took(&mut self, asked: &[(String, Value)], results: Vec<Result<(), String>>, now_ms: u64) {
        let stage = self.state.unwrap_or(LifecycleState::Active);
        self.tried_in = Some(stage);
        for ((name, _), result) in asked.iter().zip(results) {
            match result {
                Ok(()) => {
                    self.pending.remove(name);
                }
                Err(reason) => {
                    if let Some((_, said)) = self.pending.get_mut(name) {
                        *said = Some(reason);
                    }
                }
            }
        }
        let rejected = || {
            self.pending
                .iter()
                .filter_map(|(name, (value, said))| Some((name, value, said.as_ref()?)))
        };
        let for_good = rejected().any(|(_, _, reason)| !is_undeclared(reason));
        let waits = stage == LifecycleState::Active && rejected().next().is_some();
        let since_ms = if waits { *self.undeclared_since_ms.get_or_insert(now_ms) } else { now_ms };
        if for_good || now_ms.saturating_sub(since_ms) >= UNDECLARED_PATIENCE_MS {
            let each = rejected()
                .map(|(name, value, reason)| format!("`{}` {name} = {value}: {reason}", self.node));
            let text = each.collect::<Vec<_>>().join("; ");
            self.refused = Some(Failure::new(FailureCode::PARAMETER_REJECTED, text));
        } else if waits {
            self.ask_at_ms = now_ms + ASK_AGAIN_MS;
        } else if stage == LifecycleState::Active {
            self.is_up = true;
        }
    }
}

/// Whether a node in this state has reached the goal of a transition.
fn leads_to(transition: Transition, state: LifecycleState) -> bool {
    let is_passed = transition == Transition::Configure && state == LifecycleState::Active;
    is_passed || state == goal(transition)
}

/// The state a transition leads to.
fn goal(transition: Transition) -> LifecycleState {
    match transition {
        Transition::Configure | Transition::Deactivate => LifecycleState::Inactive,
        Transition::Cleanup => LifecycleState::Unconfigured,
        Transition::Activate => LifecycleState::Active,
        Transition::Shutdown => LifecycleState::Finalized,
    }
}
