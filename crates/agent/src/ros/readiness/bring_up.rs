//! Brings one promised node up: its parameters are set, then it is configured and activated, from
//! whichever state it is in. Pure: it says what to ask the node next and takes the answers in.
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

/// When to ask again where no answer came, or one that will be another soon.
const ASK_AGAIN_MS: u64 = 500;
/// How often a lifecycle node that is up is asked for its state.
const LOOK_EVERY_MS: u64 = 2000;
/// How long a node that is up may declare parameters before those it did not declare count as
/// rejected.
const UNDECLARED_PATIENCE_MS: u64 = 3000;

/// Something to ask a node.
#[derive(Debug, Clone, PartialEq)]
pub struct Question {
    /// The node.
    pub node: GraphName,
    /// The participant it is in; an answer of a later one is no answer.
    pub instance: ParticipantId,
    /// What.
    pub ask: Ask,
}

/// What a node can be asked.
#[derive(Debug, Clone, PartialEq)]
pub enum Ask {
    /// To answer at all: a question for no parameter.
    Anything,
    /// Its lifecycle state.
    State,
    /// A lifecycle transition.
    Transition(Transition),
    /// To take these parameters.
    Set(Vec<(String, Value)>),
}

/// What it answered.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// It answers.
    Something,
    /// Its lifecycle state.
    State(LifecycleState),
    /// Whether it made the transition.
    Transition(bool),
    /// For each parameter, in the order asked, whether it was taken, or why not.
    Set(Vec<Result<(), String>>),
    /// Nothing, within the time for it.
    None,
}

/// A promised node on its way up.
#[derive(Debug, Clone)]
pub(super) struct BringUp {
    node: GraphName,
    is_lifecycle: bool,
    /// Whether it offers services that are only known to answer when the node does.
    is_asked: bool,
    instance: ParticipantId,
    /// Parameters it has not taken yet, each with what it last said.
    pending: BTreeMap<String, (Value, Option<String>)>,
    /// In which state they were last tried; a node without lifecycle counts as active.
    tried_in: Option<LifecycleState>,
    /// Since when nothing but undeclared parameters is left.
    undeclared_since_ms: Option<u64>,
    state: Option<LifecycleState>,
    /// It was brought up once, or by an earlier agent: it is only looked at.
    is_up: bool,
    failed: Option<Transition>,
    refused: Option<Failure>,
    answered: bool,
    silent_since_ms: Option<u64>,
    in_flight: bool,
    ask_at_ms: u64,
}

/// Whether a rejection only says that the node does not know the parameter yet: rclcpp and rclpy
/// have words of their own.
fn is_undeclared(reason: &str) -> bool {
    reason.contains("not declared") || reason.contains("undeclared")
}

impl BringUp {
    /// Of a node that has just been seen; `is_up`: an earlier agent brought it up.
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

    /// It is to show that it answers.
    pub(super) fn must_answer(&mut self) {
        self.is_asked = true;
    }

    /// Whether it answered once, if it is to.
    pub(super) fn answers(&self) -> bool {
        self.answered || !self.is_asked
    }

    pub(super) fn refused(&self) -> Option<&Failure> {
        self.refused.as_ref()
    }

    /// Whether it was brought up, so that it is only looked at.
    pub(super) fn is_up(&self) -> bool {
        self.is_up
    }

    pub(super) fn has_its_parameters(&self) -> bool {
        self.pending.is_empty()
    }

    /// The state it is in, as far as is known; `None`: it has not said, or does not say any more.
    pub(super) fn state(&self) -> Option<LifecycleState> {
        self.state
    }

    /// Since when it has answered nothing.
    pub(super) fn silent_since_ms(&self) -> Option<u64> {
        self.silent_since_ms
    }

    /// What to ask it now, if anything.
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

    /// Takes an answer in.
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
                // It may have been made all the same: look before asking again.
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
        // Until it is known where the other attempt led, nothing has failed: somebody else may
        // bring it up as well.
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

/// Whether a node in this state has what a transition was asked for.
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
