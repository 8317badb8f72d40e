//! The places that the server names for MQTT sessions: its own broker, or external ones in the order in which they are
//! tried. It opens nothing.

use task_proto::api::{ExternalBroker, MqttEndpoint, MqttPlace};
use task_proto::topic::TopicPrefix;
use tokio::sync::watch;

use super::MqttAccess;

/// Where one session goes, and as whom.
#[derive(Clone, PartialEq, Eq)]
pub(super) struct Destination {
    pub(super) host: String,
    pub(super) port: u16,
    pub(super) prefix: TopicPrefix,
    /// Whether the port speaks TLS.
    pub(super) is_encrypted: bool,
    /// What is otherwise there than at the server's own broker.
    pub(super) external: Option<ExternalBroker>,
}

impl MqttAccess {
    /// The place with this number among those that the server names, beginning with 0.
    pub(super) fn destination(&self, endpoint: Option<&MqttEndpoint>, number: usize) -> Destination {
        let Some(MqttEndpoint { host, port, prefix, tls, external, alternatives }) = endpoint.cloned() else {
            let (host, prefix) = (self.host.clone(), self.prefix.clone());
            return Destination { host, port: self.port, prefix, is_encrypted: false, external: None };
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

/// How many places the server names.
pub(super) fn place_count(endpoint: Option<&MqttEndpoint>) -> usize {
    1 + endpoint.map_or(0, |endpoint| endpoint.alternatives.len())
}

/// Waits until the server names another place first than `there`, where a session is or is tried.
pub(super) async fn moved(
    endpoint: &mut watch::Receiver<Option<MqttEndpoint>>,
    access: &MqttAccess,
    there: &Destination,
) {
    // Cancel-safe: a watch remembers that it changed.
    while endpoint.changed().await.is_ok() {
        if access.destination(endpoint.borrow_and_update().as_ref(), 0) != *there {
            return;
        }
    }
    std::future::pending().await
}
