//! Messages between a run and the process of its robots: one JSON document per line. Points in time
//! are nanoseconds of the machine's monotonic clock, which both read.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use task_proto::api::EnrollResponse;
use task_proto::trust::envelope::PublicKey;
use task_proto::{CaPin, DeploymentId, MacAddress};

/// The first line to the process: the list of its robots. Every further line is an
/// [`RobotCommand`].
#[derive(Serialize, Deserialize)]
pub struct RobotGroup {
    /// Where robots connect; each robot has the one at its number, counted round.
    pub entrances: Vec<Entrance>,
    /// Pin of the certificate authority; absent without encryption.
    pub pin: Option<CaPin>,
    /// The key that its states are signed with.
    pub key: PublicKey,
    /// Directory of the robots' data.
    pub data: PathBuf,
    /// Milliseconds between two polls while a session is up; robots vary the interval by half.
    pub poll_ms: u64,
    /// Whether each robot connects over HTTP from an address of its own below 127.0.0.0/16.
    pub own_addresses: bool,
    /// The file for the robots' log; absent: no log.
    pub log: Option<PathBuf>,
    /// The number of the first robot; the others count on from there.
    pub first: usize,
    pub members: Vec<GroupMember>,
}

/// The server as robots know it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entrance {
    /// The URL for HTTP.
    pub url: String,
    /// The MQTT listener's host; the port is in each robot's enrollment.
    pub mqtt_host: String,
}

#[derive(Clone, Serialize, Deserialize)]
pub struct GroupMember {
    /// The MAC used for registration.
    pub mac: MacAddress,
    /// The server's answer to the enrollment.
    pub enrolled: EnrollResponse,
}

/// Messages to the robots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RobotCommand {
    /// All robots start, at once.
    Start,
}

/// Messages from the process. A robot is identified by its number.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RobotEvent {
    /// The process has all that its robots need.
    Ready,
    /// A session is up and the server has stored a report that shows the robot in its desired
    /// state.
    Reconciled {
        /// Number of the robot.
        robot: usize,
        /// Time of the event.
        at_ns: u64,
    },
    /// The server has acknowledged, and so stored, a report that the ordered package is verified
    /// and unpacked.
    Verified {
        /// Number of the robot.
        robot: usize,
        deployment: DeploymentId,
        /// When the acknowledgement came.
        at_ns: u64,
    },
    /// The robot reported a failure.
    Failed {
        /// Number of the robot.
        robot: usize,
        deployment: DeploymentId,
        why: String,
    },
}

/// The `number`th loopback address, 250 in each of 127.0.1.0/24, 127.0.2.0/24, …
pub fn own_address(number: usize) -> Ipv4Addr {
    let subnet = 1 + number / 250 % 250;
    let host = 1 + number % 250;
    let byte = |value: usize| u8::try_from(value).unwrap_or(1);
    Ipv4Addr::new(127, 0, byte(subnet), byte(host))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_loopback_and_differ() {
        let all: std::collections::BTreeSet<Ipv4Addr> = (0..10_000).map(own_address).collect();
        assert_eq!(all.len(), 10_000);
        assert!(all.iter().all(Ipv4Addr::is_loopback));
        assert_eq!(own_address(251).to_string(), "127.0.2.2");
    }
}
