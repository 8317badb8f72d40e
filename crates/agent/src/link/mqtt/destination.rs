//! The places that the server names for MQTT sessions: its own broker, or external brokers in the
//! order of attempts. This module opens no connection.

use std::time::Duration;

use task_proto::api::{BrokerAddress, ExternalBroker, MqttEndpoint};
use task_proto::messages::topic::TopicPrefix;
use tokio::sync::watch;

use super::MqttAccess;
use crate::link::state::LinkState;

/// Longest wait before the session's first question to the server about its place.
const FIRST_QUESTION: Duration = Duration::from_secs(10);
/// Longest wait before a repeated question.
const MAX_QUESTION: Duration = Duration::from_secs(5 * 60);

/// Address and credentials of one session.
#[derive(Clone, PartialEq, Eq)]
pub(super) struct Destination {
    pub(super) host: String,
    pub(super) port: u16,
    pub(super) prefix: TopicPrefix,
    /// Whether the port speaks TLS.
    pub(super) is_encrypted: bool,
    /// Credentials and CA pin of an external broker; `None` at the server's own broker.
    pub(super) external: Option<ExternalBroker>,
}

impl MqttAccess {
    /// The place with this index among the places that the server names, starting at 0.
    pub(super) fn destination(
        &self,
        endpoint: Option<&MqttEndpoint>,
        number: usize,
    ) -> Destination {
        let Some(MqttEndpoint { host, port, prefix, tls, external, alternatives }) =
            endpoint.cloned()
        else {
            let (host, prefix) = (self.host.clone(), self.prefix.clone());
            return Destination {
                host,
                port: self.port,
                prefix,
                is_encrypted: false,
                external: None,
            };
        };
        let other = number.checked_sub(1).and_then(|at| alternatives.into_iter().nth(at));
        let BrokerAddress { host, port, tls } = other.unwrap_or(BrokerAddress { host, port, tls });
        let host = host.unwrap_or_else(|| self.host.clone());
        Destination { host, port, prefix, is_encrypted: tls, external }
    }

    /// The same access at this destination.
    pub(super) fn at(&self, there: &Destination) -> Self {
        let Destination { host, port, prefix, .. } = there.clone();
        Self { host, port, prefix, ..self.clone() }
    }
}

/// Number of places that the server names.
pub(super) fn place_count(endpoint: Option<&MqttEndpoint>) -> usize {
    1 + endpoint.map_or(0, |endpoint| endpoint.alternatives.len())
}

/// Waits until the server's first place is no longer `there`, the place of the current session or
/// attempt.
pub(super) async fn first_place_changed(
    endpoint: &mut watch::Receiver<Option<MqttEndpoint>>,
    access: &MqttAccess,
    there: &Destination,
) {
    // Cancel-safe: a watch remembers a change.
    while endpoint.changed().await.is_ok() {
        if access.destination(endpoint.borrow_and_update().as_ref(), 0) != *there {
            return;
        }
    }
    std::future::pending().await
}

/// Asks the server for its place from time to time, until that place differs from `there`. A server
/// and a robot that search for a broker at the same time may find different ones; while the
/// server's answer stays the same, [`first_place_changed`] does not return. `questions` counts the
/// questions, and each doubles the wait.
pub(super) async fn await_other_place(
    link_state: &LinkState,
    access: &MqttAccess,
    there: &Destination,
    questions: &mut u32,
) -> Destination {
    let mut answers = link_state.endpoint_answers.subscribe();
    loop {
        // Cancel-safe: the timer is recreated on each iteration.
        tokio::time::sleep(wait_before_question(*questions, rand::random())).await;
        *questions = questions.saturating_add(1);
        answers.borrow_and_update();
        link_state.refresh_endpoint.notify_one();
        // Cancel-safe: a watch remembers a change. Without an answer the session stays.
        if answers.changed().await.is_err() {
            return std::future::pending().await;
        }
        let first = access.destination(link_state.endpoint.borrow().as_ref(), 0);
        if first != *there {
            return first;
        }
    }
}

/// The wait before the next question. `jitter`, uniform from 0 to 1, randomizes its second half.
fn wait_before_question(questions: u32, jitter: f64) -> Duration {
    let longest = FIRST_QUESTION.saturating_mul(1 << questions.min(10)).min(MAX_QUESTION);
    longest.mul_f64(0.5 + jitter.clamp(0.0, 1.0) / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoint_questions_back_off() {
        assert_eq!(wait_before_question(0, 0.0), Duration::from_secs(5));
        assert_eq!(wait_before_question(0, 1.0), FIRST_QUESTION);
        assert_eq!(wait_before_question(2, 1.0), FIRST_QUESTION * 4);
        assert_eq!(wait_before_question(u32::MAX, 1.0), MAX_QUESTION);
        assert_eq!(wait_before_question(7, 0.0), MAX_QUESTION / 2);
    }
}
