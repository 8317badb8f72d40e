//! What a run and the process of its robots say to each other: one JSON document a line. Moments
//! are nanoseconds of the machine's monotonic clock, which both read.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use task_proto::api::EnrollResponse;
use task_proto::envelope::PublicKey;
use task_proto::{CaPin, DeploymentId, MacAddress};

/// The first line to the process: which robots there are. Every further line is an [`Order`].
#[derive(Serialize, Deserialize)]
pub struct Crew {
    /// The server's URL.
    pub server: String,
    /// Of its certificate authority, if it encrypts.
    pub pin: Option<CaPin>,
    /// The MQTT listener's host; the port is in each robot's enrolment.
    pub mqtt_host: String,
    /// The key that its states are signed with.
    pub key: PublicKey,
    /// Where the robots have their data.
    pub data: PathBuf,
    /// Between two polls, milliseconds, while a session is up; robots vary it by half.
    pub poll_ms: u64,
    /// Whether each robot connects over HTTP from an address of its own below 127.0.0.0/16.
    pub own_addresses: bool,
    /// The number of the first of the robots; those after it count on.
    pub first: usize,
    /// The robots.
    pub members: Vec<Member>,
}

/// A registered robot.
#[derive(Clone, Serialize, Deserialize)]
pub struct Member {
    /// The MAC it registered by.
    pub mac: MacAddress,
    /// What the server said.
    pub enrolled: EnrollResponse,
}

/// What the robots are told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Order {
    /// All robots start, at once.
    Start,
}

/// What the process says. A robot is its number.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Word {
    /// The process has all that its robots need.
    Ready,
    /// A session is up and the server has stored a report that says the robot keeps to its state.
    Reconciled {
        /// Who.
        robot: usize,
        /// When.
        at_ns: u64,
    },
    /// The server has acknowledged, and so stored, a report that the ordered package is verified
    /// and unpacked.
    Verified {
        /// Who.
        robot: usize,
        /// By which order.
        deployment: DeploymentId,
        /// When the acknowledgement came.
        at_ns: u64,
    },
    /// The robot reported a failure.
    Failed {
        /// Who.
        robot: usize,
        /// By which order.
        deployment: DeploymentId,
        /// Code and text.
        why: String,
    },
}

/// The `number`th loopback address, 250 in each of 127.0.1.0/24, 127.0.2.0/24, …
pub fn own_address(number: usize) -> Ipv4Addr {
    let (subnet, host) = (1 + number / 250 % 250, 1 + number % 250);
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
