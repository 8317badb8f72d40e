//! Where robots reach MQTT, and what an operator gives to a broker that is not the server's own.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::pin::CaPin;
use crate::topic::TopicPrefix;

/// Where a robot's MQTT session goes: part of the answer to an enrolment, and `GET /robots/{robot}/mqtt` (that robot).
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
    /// The broker there is not the server's own. Absent: it is, and the password is the robot's token.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub external: Option<ExternalBroker>,
}

/// What is otherwise with a broker that is not the server's own. Its PUBACK says that the broker took a message, and
/// nothing of the server: reports go over HTTP, whose answer means stored.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ExternalBroker {
    /// The robot's password there, in the place of its token, which such a broker is never shown.
    pub password: String,
    /// The authority behind the broker's certificate, if that is to be it alone and no root of the robot's system.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_pin: Option<CaPin>,
}

impl fmt::Debug for ExternalBroker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ExternalBroker").finish_non_exhaustive()
    }
}

/// `GET /broker` (administer): what an external broker must know, as mosquitto reads it.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BrokerFiles {
    /// The access control list.
    pub acl: String,
    /// The password file: salted hashes.
    pub passwd: String,
}
