//! The MQTT endpoint of robots, and the files that an operator gives to an external broker.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::messages::topic::TopicPrefix;
use crate::trust::pin::CaPin;

/// The MQTT endpoint of a robot: part of the answer to an enrollment, and of `GET
/// /robots/{robot}/mqtt` (that robot).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MqttEndpoint {
    /// Host; absent means the host of the server's URL.
    #[serde(default)]
    pub host: Option<String>,
    /// TCP port.
    pub port: u16,
    /// The prefix of all topics.
    pub prefix: TopicPrefix,
    /// Whether the port uses TLS.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub tls: bool,
    /// Set if the broker is not the server's own. Absent: the server's own broker, where the
    /// password is the robot's token.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub external: Option<ExternalBroker>,
    /// Other external brokers with the same accounts, in the order that a robot tries them if the
    /// first does not answer. Agents that don't know this field ask the server again.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub alternatives: Vec<BrokerAddress>,
}

/// Address of an external broker.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = MqttPlace))]
pub struct BrokerAddress {
    /// Host; absent means the host of the server's URL.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<String>,
    /// TCP port.
    pub port: u16,
    /// Whether the port uses TLS.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub tls: bool,
}

/// Differences of a broker that is not the server's own. Its PUBACK means that the broker took a
/// message, and says nothing about the server: reports go over HTTP, whose answer means stored.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ExternalBroker {
    /// The robot's password for this broker. The robot's token is never shown to such a broker.
    pub password: String,
    /// The robot's MQTT client id for this broker. No other client knows it, so that none can end
    /// this robot's session by connecting with the same id. Absent: the robot id.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_id: Option<String>,
    /// The only authority trusted for the broker's certificate, in place of the robot's system
    /// roots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_pin: Option<CaPin>,
}

impl fmt::Debug for ExternalBroker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ExternalBroker").finish_non_exhaustive()
    }
}

/// `GET /broker` (administer): configuration files for mosquitto.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BrokerFiles {
    /// Mosquitto's access control list.
    pub acl: String,
    /// Mosquitto's password file: salted hashes.
    pub passwd: String,
    /// Mosquitto's listener configuration.
    #[serde(default)]
    pub conf: String,
}

/// `GET /broker/nats` (administer): configuration file for a NATS server.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NatsFile {
    /// The `authorization` block: users, salted hashes and permissions.
    pub authorization: String,
}

/// `GET /broker/check` (administer): tests of the external brokers that are not part of a session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BrokerChecks {
    /// One test per broker, in the order of the setting.
    pub brokers: Vec<BrokerCheck>,
}

/// The test of one external broker, made with two accounts reserved for it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BrokerCheck {
    /// Host and port.
    pub address: String,
    /// Whether one account can end another's session by connecting with its client id. Absent: the
    /// test did not get that far.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub displaces: Option<bool>,
    /// Why the test did not complete.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
}
