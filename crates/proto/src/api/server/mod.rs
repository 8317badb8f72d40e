//! Bodies about the server: its identity, and the traffic of its connections.

mod mqtt;
mod status;

use serde::{Deserialize, Serialize};

pub use self::mqtt::{
    BrokerAddress, BrokerCheck, BrokerChecks, BrokerFiles, ExternalBroker, MqttEndpoint, NatsFile,
};
pub use self::status::{
    BrokerStatus, DatabaseStatus, DiskStatus, LimitView, ListenerView, MAX_SITES, NodeFigures,
    NodeList, NodeState, NodeView, ReportStatus, RobotCounts, RobotSession, RuleView, ServerRules,
    ServerStatus, SessionList, SiteStatus, Subscription, TransferStatus,
};
use crate::CaPin;
use crate::trust::envelope::PublicKey;

/// `GET /server` (read).
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ServerInfo {
    /// The server's version.
    pub version: String,
    /// The key that signs desired states.
    pub key: PublicKey,
    /// The pin of the authority that issued the server's certificate, if the server has its own
    /// authority.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_pin: Option<CaPin>,
    /// The MQTT address, `host:port`: the listener's, as bound, or the external broker's.
    pub mqtt: String,
    /// The server's clock.
    pub now_ms: u64,
    /// MQTT traffic since the server started.
    #[serde(default)]
    pub traffic: MqttTraffic,
    /// HTTP traffic since the server started.
    #[serde(default)]
    pub http: HttpTraffic,
    /// Measures against misbehaving robots since the server started.
    #[serde(default)]
    pub conduct: PenaltyTotals,
}

/// HTTP traffic of all connections together, counted at the sockets. "In" is towards the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct HttpTraffic {
    /// Connections accepted.
    pub connections: u64,
    /// Requests whose head was read.
    pub requests: u64,
    /// Bytes received, heads and bodies.
    pub bytes_in: u64,
    /// Bytes sent, heads and bodies.
    pub bytes_out: u64,
}

/// MQTT traffic of all connections together, except the server's own watchdog. With an external
/// broker, only the server's own connection to the broker is counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct MqttTraffic {
    /// Robots connected now.
    pub robots_connected: u64,
    /// Clients accepted.
    pub connections_accepted: u64,
    /// Clients refused: too many, too slow, a wrong password, no MQTT.
    pub connections_refused: u64,
    /// Messages refused: sent to a topic that the sender may not use, or impossible to store.
    pub messages_refused: u64,
    /// Messages dropped because a subscriber was too slow.
    pub messages_dropped: u64,
    /// Sum of the traffic of all connections.
    pub all: Traffic,
}

/// Traffic of an MQTT connection since its start. "In" is towards the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Traffic {
    /// Bytes received, including refused ones.
    pub bytes_in: u64,
    /// Bytes sent.
    pub bytes_out: u64,
    /// MQTT control packets received, including CONNECT.
    pub packets_in: u64,
    /// MQTT control packets sent, including CONNACK.
    pub packets_out: u64,
    /// PUBLISH packets received.
    pub messages_in: u64,
    /// PUBLISH packets sent.
    pub messages_out: u64,
    /// PUBACK packets received.
    pub acks_in: u64,
    /// PUBACK packets sent.
    pub acks_out: u64,
}

/// A robot's MQTT connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MqttConnection {
    /// When the connection began.
    pub since_ms: u64,
    /// Traffic of the connection.
    pub traffic: Traffic,
}

/// Measures against robots that exceeded their limits or sent forbidden messages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = ConductTotals))]
#[serde(default)]
pub struct PenaltyTotals {
    /// Number of times that a robot was slowed down.
    pub slowed: u64,
    /// Number of times that a robot was disconnected.
    pub cut: u64,
    /// Number of times that a disconnected robot came back too early, or asked for more than it was
    /// held up for.
    pub turned_away: u64,
}
