//! Where robots reach MQTT, and what an operator gives to a broker that is not the server's own.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::pin::CaPin;
use crate::topic::TopicPrefix;

/// Where a robot's MQTT session goes: part of the answer to an enrolment, and
/// `GET /robots/{robot}/mqtt` (that robot).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MqttEndpoint {
    /// Host; absent means the host of the server's URL.
    #[serde(default)]
    pub host: Option<String>,
    /// TCP port.
    pub port: u16,
    /// What all topics start with.
    pub prefix: TopicPrefix,
    /// Whether the port speaks TLS.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub tls: bool,
    /// The broker there is not the server's own. Absent: it is, and the password is the robot's
    /// token.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub external: Option<ExternalBroker>,
    /// Other external brokers with the same accounts, in the order in which a robot tries them when
    /// the first one does not answer. Agents that don't know this field ask the server again.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub alternatives: Vec<MqttPlace>,
}

/// Where an external broker listens.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct MqttPlace {
    /// Host; absent means the host of the server's URL.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<String>,
    /// TCP port.
    pub port: u16,
    /// Whether the port speaks TLS.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub tls: bool,
}

/// What is otherwise with a broker that is not the server's own. Its PUBACK says that the broker
/// took a message, and nothing of the server: reports go over HTTP, whose answer means stored.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ExternalBroker {
    /// The robot's password there, in the place of its token, which such a broker is never shown.
    pub password: String,
    /// The robot's MQTT client id there. No other client knows it, so that none can end this
    /// robot's session by connecting with the same id. Absent: the robot id.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_id: Option<String>,
    /// The authority behind the broker's certificate, if that is to be it alone and no root of the
    /// robot's system.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_pin: Option<CaPin>,
}

impl fmt::Debug for ExternalBroker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ExternalBroker").finish_non_exhaustive()
    }
}

/// `GET /broker` (administer): the files of a mosquitto.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BrokerFiles {
    /// Mosquitto's access control list.
    pub acl: String,
    /// Mosquitto's password file: salted hashes.
    pub passwd: String,
    /// Mosquitto's configuration of the listener.
    #[serde(default)]
    pub conf: String,
}

/// `GET /broker/nats` (administer): the file of a NATS server.
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
    /// One for each broker, in the order of the setting.
    pub brokers: Vec<BrokerCheck>,
}

/// The test of one external broker with two accounts that are there for it alone.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BrokerCheck {
    /// Host and port.
    pub address: String,
    /// Whether one account ends the session of another by connecting with its client id. Absent:
    /// the test did not get so far.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub displaces: Option<bool>,
    /// Why it did not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
}
