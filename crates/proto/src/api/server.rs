//! Bodies about what the server is, and what went over its connections.

use serde::{Deserialize, Serialize};

use super::ConductTotals;
use crate::CaPin;
use crate::envelope::PublicKey;

/// `GET /server` (read).
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ServerInfo {
    /// The server's version.
    pub version: String,
    /// The key that signs desired states.
    pub key: PublicKey,
    /// The pin of the authority that made its certificate, if that is its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_pin: Option<CaPin>,
    /// Where MQTT is: the listener's address, `host:port`, as bound, or the external broker's.
    pub mqtt: String,
    /// The server's clock.
    pub now_ms: u64,
    /// What went over MQTT since the server started.
    #[serde(default)]
    pub traffic: MqttTraffic,
    /// What went over HTTP since then.
    #[serde(default)]
    pub http: HttpTraffic,
    /// What was done about robots that misbehaved since then.
    #[serde(default)]
    pub conduct: ConductTotals,
}

/// What went over HTTP, all connections together, counted at the sockets. In is towards the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct HttpTraffic {
    /// Connections that were taken.
    pub connections: u64,
    /// Requests whose head was read.
    pub requests: u64,
    /// Bytes, heads and bodies.
    pub bytes_in: u64,
    /// Likewise.
    pub bytes_out: u64,
}

/// What went over MQTT, all connections together, the server's own watchdog excepted. With an
/// external broker only the server's own connection to it is known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct MqttTraffic {
    /// Robots that are connected now.
    pub robots_connected: u64,
    /// Clients that were let in.
    pub connections_accepted: u64,
    /// Clients that were turned away: too many, too slow, a wrong password, no MQTT.
    pub connections_refused: u64,
    /// Messages that were sent where their sender may not, or could not be stored.
    pub messages_refused: u64,
    /// Messages that a listener would have got, had it kept up.
    pub messages_dropped: u64,
    /// The connections' own figures, added up.
    pub all: Traffic,
}

/// What went over an MQTT connection since it began. In is towards the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Traffic {
    /// Bytes, with those that were refused.
    pub bytes_in: u64,
    /// Likewise.
    pub bytes_out: u64,
    /// MQTT control packets, CONNECT included.
    pub packets_in: u64,
    /// MQTT control packets, CONNACK included.
    pub packets_out: u64,
    /// PUBLISH.
    pub messages_in: u64,
    /// PUBLISH.
    pub messages_out: u64,
    /// PUBACK.
    pub acks_in: u64,
    /// PUBACK.
    pub acks_out: u64,
}

/// A robot's MQTT connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MqttConnection {
    /// When it began.
    pub since_ms: u64,
    /// What went over it.
    pub traffic: Traffic,
}
