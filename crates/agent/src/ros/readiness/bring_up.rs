//! Brings one promised node up: its parameters are set, then it is configured and activated, from
//! any lifecycle state. Pure: the module returns the next request to the node and takes the
//! answers in.
//!
//! ```text
//! seen ─► parameters ─► configure ─► parameters ─► activate ─► parameters ─► up: only looked at from now on
//!            (only those that were undeclared are tried again; any other rejection refuses the run)
//! ```

use std::collections::BTreeMap;

use serde_json::Value;
use task_proto::messages::report::{Failure, FailureCode};
use task_proto::telemetry::ros::{GraphName, LifecycleState, Transition};

use crate::ros::graph::ParticipantId;

/// Pause before a question is repeated, when no answer came or the answer is expected to change
/// soon.
const RETRY_INTERVAL_MS: u64 = 500;
/// Interval between queries for the state of a lifecycle node that is up.
const POLL_INTERVAL_MS: u64 = 2000;
/// Time that a node that is up has to declare parameters before the undeclared ones count as
/// rejected.
const UNDECLARED_TIMEOUT_MS: u64 = 3000;

/// A request to a node.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeRequest {
    pub node: GraphName,
    /// The participant of the node; answers of a later participant do not count.
    pub instance: ParticipantId,
    pub kind: RequestKind,
}

#[derive(Debug, Clone, PartialEq)]
pub enum RequestKind {
    /// Any answer at all: a query for no parameter.
    Ping,
    /// The node's lifecycle state.
    State,
    /// Make a lifecycle transition.
    Transition(Transition),
    Set(Vec<(String, Value)>),
}

#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    Pong,
    /// The node's lifecycle state.
    State(LifecycleState),
    /// Whether it made the transition.
    Transition(bool),
    /// For each parameter, in the order requested: accepted, or the reason for the rejection.
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
    must_answer: bool,
    instance: ParticipantId,
    /// Parameters that the node has not accepted yet, each with its last rejection.
    pending: BTreeMap<String, (Value, Option<String>)>,
    /// The state in which they were last tried; a node without lifecycle counts as active.
    set_attempted_in: Option<LifecycleState>,
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
    next_request_at_ms: u64,
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
            must_answer: false,
            instance,
            pending: pending.map(|(name, value)| (name.clone(), (value.clone(), None))).collect(),
            set_attempted_in: None,
            undeclared_since_ms: None,
            state: None,
            is_up,
            failed: None,
            refused: None,
            answered: false,
            silent_since_ms: None,
            in_flight: false,
            next_request_at_ms: 0,
        }
    }

    pub(super) fn instance(&self) -> ParticipantId {
        self.instance
    }

    /// Requires that the node answers a question.
    pub(super) fn require_answer(&mut self) {
        self.must_answer = true;
    }

    /// Whether the node answered once, if an answer is required.
    pub(super) fn has_answered(&self) -> bool {
        self.answered || !self.must_answer
    }

    pub(super) fn refused(&self) -> Option<&Failure> {
        self.refused.as_ref()
    }

    /// Whether the node was brought up, so that it is only observed.
    pub(super) fn is_up(&self) -> bool {
        self.is_up
    }

    pub(super) fn has_all_parameters(&self) -> bool {
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

    /// The next request to the node, if any.
    pub(super) fn next_request(&mut self, now_ms: u64) -> Option<NodeRequest> {
        if self.in_flight || self.refused.is_some() || now_ms < self.next_request_at_ms {
            return None;
        }
        let kind = self.next_kind()?;
        self.in_flight = true;
        Some(NodeRequest { node: self.node.clone(), instance: self.instance, kind })
    }

    fn next_kind(&self) -> Option<RequestKind> {
        let ping = (self.must_answer && !self.answered).then_some(RequestKind::Ping);
        if self.is_lifecycle && (self.is_up || self.state.is_none()) {
            return Some(RequestKind::State);
        }
        let stage = self.state.unwrap_or(LifecycleState::Active);
        let may_set = self.set_attempted_in != Some(stage) || stage == LifecycleState::Active;
        if stage != LifecycleState::Changing && !self.pending.is_empty() && may_set {
            let pending =
                self.pending.iter().map(|(name, (value, _))| (name.clone(), value.clone()));
            return Some(RequestKind::Set(pending.collect()));
        }
        match self.state {
            Some(LifecycleState::Unconfigured) => {
                Some(RequestKind::Transition(Transition::Configure))
            }
            Some(LifecycleState::Inactive) => Some(RequestKind::Transition(Transition::Activate)),
            Some(LifecycleState::Changing | LifecycleState::Active) => Some(RequestKind::State),
            Some(LifecycleState::Finalized) | None => ping,
        }
    }

    pub(super) fn record_answer(&mut self, request: &NodeRequest, answer: Answer, now_ms: u64) {
        if request.instance != self.instance {
            return;
        }
        self.in_flight = false;
        self.next_request_at_ms = now_ms;
        if answer == Answer::None {
            self.silent_since_ms.get_or_insert(now_ms);
            self.next_request_at_ms = now_ms + RETRY_INTERVAL_MS;
            if matches!(request.kind, RequestKind::Transition(_)) {
                // The node may have made the transition all the same: query the state before asking
                // again.
                self.state = None;
            }
            return;
        }
        self.answered = true;
        self.silent_since_ms = None;
        match (&request.kind, answer) {
            (_, Answer::State(state)) => self.enter_state(state, now_ms),
            (RequestKind::Transition(transition), Answer::Transition(true)) => {
                self.enter_state(goal(*transition), now_ms)
            }
            (RequestKind::Transition(transition), Answer::Transition(false)) => {
                self.failed = Some(*transition);
                self.state = None;
            }
            (RequestKind::Set(requested), Answer::Set(results)) => {
                self.record_set_results(requested, results, now_ms)
            }
            _ => {}
        }
    }

    fn enter_state(&mut self, state: LifecycleState, now_ms: u64) {
        self.state = Some(state);
        // Until the result of the other attempt is known, nothing has failed: another program may
        // bring the node up as well.
        let failed = if state == LifecycleState::Changing { None } else { self.failed.take() };
        if let Some(transition) = failed.filter(|transition| !reached_goal(*transition, state)) {
            let text = format!(
                "`{}` failed to {} and is {}",
                self.node,
                transition.as_str(),
                state.as_str()
            );
            self.refused = Some(Failure::new(FailureCode::LIFECYCLE_FAILED, text));
        } else if state == LifecycleState::Finalized && !self.is_up {
            let text = format!("`{}` is finalized and cannot become active", self.node);
            self.refused = Some(Failure::new(FailureCode::LIFECYCLE_FAILED, text));
        }
        self.is_up |= state == LifecycleState::Active && self.pending.is_empty();
        if self.is_up {
            self.next_request_at_ms = now_ms + POLL_INTERVAL_MS;
        } else if state == LifecycleState::Changing {
            self.next_request_at_ms = now_ms + RETRY_INTERVAL_MS;
        }
    }

    fn record_set_results(
        &mut self,
        requested: &[(String, Value)],
        results: Vec<Result<(), String>>,
        now_ms: u64,
    ) {
        let stage = self.state.unwrap_or(LifecycleState::Active);
        self.set_attempted_in = Some(stage);
        for ((name, _), result) in requested.iter().zip(results) {
            match result {
                Ok(()) => {
                    self.pending.remove(name);
                }
                Err(reason) => {
                    if let Some((_, reason_seen)) = self.pending.get_mut(name) {
                        *reason_seen = Some(reason);
                    }
                }
            }
        }
        let rejected = || {
            self.pending.iter().filter_map(|(name, (value, reason_seen))| {
                Some((name, value, reason_seen.as_ref()?))
            })
        };
        let is_final = rejected().any(|(_, _, reason)| !is_undeclared(reason));
        let waits = stage == LifecycleState::Active && rejected().next().is_some();
        let since_ms = if waits { *self.undeclared_since_ms.get_or_insert(now_ms) } else { now_ms };
        if is_final || now_ms.saturating_sub(since_ms) >= UNDECLARED_TIMEOUT_MS {
            let each = rejected()
                .map(|(name, value, reason)| format!("`{}` {name} = {value}: {reason}", self.node));
            let text = each.collect::<Vec<_>>().join("; ");
            self.refused = Some(Failure::new(FailureCode::PARAMETER_REJECTED, text));
        } else if waits {
            self.next_request_at_ms = now_ms + RETRY_INTERVAL_MS;
        } else if stage == LifecycleState::Active {
            self.is_up = true;
        }
    }
}

/// Whether a node in this state has reached the goal of a transition.
fn reached_goal(transition: Transition, state: LifecycleState) -> bool {
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
