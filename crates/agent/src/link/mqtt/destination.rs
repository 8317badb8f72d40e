//! The places that the server names for MQTT sessions: its own broker, or external brokers in the
//! order of attempts. This module opens no connection.

use std::time::Duration;

use task_proto::api::{ExternalBroker, MqttEndpoint, MqttPlace};
use task_proto::topic::TopicPrefix;
use tokio::sync::watch;

use super::MqttAccess;
use crate::link::state::Shared;

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
        let MqttPlace { host, port, tls } = other.unwrap_or(MqttPlace { host, port, tls });
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
pub(super) async fn moved(
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
/// server's answer stays the same, [`moved`] does not return. `asked` counts the questions, and
/// each doubles the wait.
pub(super) async fn named_elsewhere(
    shared: &Shared,
    access: &MqttAccess,
    there: &Destination,
    asked: &mut u32,
) -> Destination {
    let mut answers = shared.endpoint_answers.subscribe();
    loop {
        // Cancel-safe: the timer is recreated on each iteration.
        tokio::time::sleep(wait_before_question(*asked, rand::random())).await;
        *asked = asked.saturating_add(1);
        answers.borrow_and_update();
        shared.find.notify_one();
        // Cancel-safe: a watch remembers a change. Without an answer the session stays.
        if answers.changed().await.is_err() {
            return std::future::pending().await;
        }
        let first = access.destination(shared.endpoint.borrow().as_ref(), 0);
        if first != *there {
            return first;
        }
    }
}

/// The wait before the next question. `jitter`, uniform from 0 to 1, randomizes its second half.
fn wait_before_question(asked: u32, jitter: f64) -> Duration {
    let longest = FIRST_QUESTION.saturating_mul(1 << asked.min(10)).min(MAX_QUESTION);
    longest.mul_f64(0.5 + jitter.clamp(0.0, 1.0) / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn questions_begin_soon_and_become_rare() {
        assert_eq!(wait_before_question(0, 0.0), Duration::from_secs(5));
        assert_eq!(wait_before_question(0, 1.0), FIRST_QUESTION);
        assert_eq!(wait_before_question(2, 1.0), FIRST_QUESTION * 4);
        assert_eq!(wait_before_question(u32::MAX, 1.0), MAX_QUESTION);
        assert_eq!(wait_before_question(7, 0.0), MAX_QUESTION / 2);
    }
}
