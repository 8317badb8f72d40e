//! The presence of one robot, and an agent's identity. This module has values only.

use std::net::SocketAddr;

use serde::{Deserialize, Serialize};
use task_proto::{Digest, InstanceId};

/// The presence of one robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotPresence {
    /// Connected over MQTT, or heard over HTTP within the window.
    pub online: bool,
    /// The last known address, if any. Port 0: the client of a trusted proxy, with an unknown port.
    pub address: Option<SocketAddr>,
    /// Start of the MQTT connection, if connected here or at another server.
    pub connected_since_ms: Option<u64>,
    /// The number of that connection, if it is to this server.
    pub connection: Option<u64>,
    /// Time of the last message or request.
    pub last_seen_ms: u64,
    /// Two instances of the robot keep displacing each other.
    pub duplicate: bool,
    /// Another instance has appeared recently, and waits for the known instance to fall silent.
    pub has_waiting_instance: bool,
}

impl RobotPresence {
    /// The address for people: `ip:port`, or the IP address alone if the port is unknown.
    pub fn address_text(&self) -> Option<String> {
        self.address.map(|address| match address.port() {
            0 => address.ip().to_string(),
            _ => address.to_string(),
        })
    }
}

/// An agent's statement about itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AgentIdentity {
    /// The instance, which is one start of the agent.
    pub instance: InstanceId,
    /// The place where the agent runs; absent from older agents.
    #[serde(default)]
    pub place: Option<Digest>,
}
