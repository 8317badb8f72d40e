//! The messages between servers, and the packets in which they travel. Packets are JSON: servers of
//! different versions skip the messages that they do not know.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use task_proto::{RobotId, UserName};

use crate::orders::change::Change;
use crate::orders::outbox::Updates;

/// The largest packet, in bytes. Postgres takes 7,999.
const MAX_PACKET_BYTES: usize = 7_500;
/// Space for the fields of a packet around its messages. A run is a host's name and some digits.
const ENVELOPE_BYTES: usize = 400;
/// Maximum robots that are named; more are found by a sweep.
const MAX_ROBOTS: usize = 400;
/// Maximum robots in one message, so that every message fits into a packet.
const ROBOTS_PER_MESSAGE: usize = 50;

/// One message to the other servers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum ClusterMessage {
    /// Tokens or their rights have changed.
    AdmissionsChanged,
    /// People or their tokens have changed, which long-lived connections depend on.
    RightsChanged,
    /// The robot's connections have to end, except those by the token `kept`.
    EndRobot {
        robot: RobotId,
        kept: Option<u64>,
    },
    /// The person's MQTT sessions have to end.
    EndPerson(UserName),
    /// These robots have a new desired state.
    NotifyRobots(Vec<RobotId>),
    NotifyAllRobots,
    /// Many robots have a new desired state.
    Sweep,
    /// Rows of robots' sessions have changed.
    SessionsChanged,
    /// An object has changed.
    Changed(Change),
}

/// The messages of one moment.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Packet {
    pub(super) run: String,
    /// Counts the packets of the sender.
    pub(super) sequence: u64,
    #[serde(default)]
    messages: Vec<Value>,
}

impl Packet {
    /// The messages that this version knows.
    pub(super) fn into_messages(self) -> Vec<ClusterMessage> {
        self.messages.into_iter().filter_map(|value| serde_json::from_value(value).ok()).collect()
    }
}

/// The messages of these updates. Those that end rights come first.
pub(super) fn messages(updates: Updates) -> Vec<ClusterMessage> {
    let Updates {
        to_notify,
        robots_to_end,
        people_to_end,
        auth,
        rights,
        sessions,
        changes,
        missed,
    } = updates;
    let mut messages = Vec::new();
    messages.extend(auth.then_some(ClusterMessage::AdmissionsChanged));
    messages.extend(rights.then_some(ClusterMessage::RightsChanged));
    let end = |(robot, kept)| ClusterMessage::EndRobot { robot, kept };
    messages.extend(robots_to_end.into_iter().map(end));
    messages.extend(people_to_end.into_iter().map(ClusterMessage::EndPerson));
    messages.extend(to_notify.all.then_some(ClusterMessage::NotifyAllRobots));
    if to_notify.robots.len() > MAX_ROBOTS {
        messages.push(ClusterMessage::Sweep);
    } else {
        let robots: Vec<RobotId> = to_notify.robots.into_iter().collect();
        let some = robots.chunks(ROBOTS_PER_MESSAGE).map(<[RobotId]>::to_vec);
        messages.extend(some.map(ClusterMessage::NotifyRobots));
    }
    messages.extend(sessions.then_some(ClusterMessage::SessionsChanged));
    messages.extend(changes.into_iter().map(ClusterMessage::Changed));
    messages.extend(missed.then_some(ClusterMessage::Changed(Change::Missed)));
    messages
}

/// Packs messages, at least into one packet, which may be empty. Packets are numbered by
/// `next_sequence`.
pub(super) fn pack(
    run: &str,
    mut next_sequence: impl FnMut() -> u64,
    messages: Vec<ClusterMessage>,
) -> Vec<String> {
    let mut packets = Vec::new();
    let mut packet: Vec<Value> = Vec::new();
    let mut bytes = ENVELOPE_BYTES;
    let mut close = |messages: Vec<Value>| {
        let packet = Packet { run: run.to_owned(), sequence: next_sequence(), messages };
        serde_json::to_string(&packet).expect("plain values always have a JSON form")
    };
    for message in messages {
        let (value, size) = sized(message);
        if bytes + size > MAX_PACKET_BYTES {
            packets.push(close(std::mem::take(&mut packet)));
            bytes = ENVELOPE_BYTES;
        }
        bytes += size;
        packet.push(value);
    }
    if packets.is_empty() || !packet.is_empty() {
        packets.push(close(packet));
    }
    packets
}

/// The message with its size. An object that is too large for a packet, as a removed robot with many
/// labels can be, is not named.
fn sized(message: ClusterMessage) -> (Value, usize) {
    let of = |message: &ClusterMessage| {
        let value = serde_json::to_value(message).expect("a message always has a JSON form");
        let size = value.to_string().len() + 1;
        (value, size)
    };
    let (value, size) = of(&message);
    match size + ENVELOPE_BYTES > MAX_PACKET_BYTES {
        true => of(&ClusterMessage::Changed(Change::Missed)),
        false => (value, size),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use super::*;
    use crate::orders::changes::RobotsToNotify;

    fn packed(messages: Vec<ClusterMessage>) -> Vec<Packet> {
        let mut sequence = 0;
        let next = || {
            sequence += 1;
            sequence
        };
        let packets = pack("rack-1-5f0c2d9b8e1a7734", next, messages);
        assert!(packets.iter().all(|packet| packet.len() <= MAX_PACKET_BYTES));
        packets.iter().map(|text| serde_json::from_str(text).expect("a packet")).collect()
    }

    #[test]
    fn updates_travel_in_numbered_packets_of_limited_size() {
        let robots: BTreeSet<RobotId> = (0..MAX_ROBOTS).map(|_| RobotId::random()).collect();
        let (ended, user) = (RobotId::random(), "eve".parse::<UserName>().expect("a name"));
        let updates = Updates {
            to_notify: RobotsToNotify { all: false, robots: robots.clone() },
            robots_to_end: BTreeMap::from([(ended.clone(), Some(3))]),
            people_to_end: BTreeSet::from([user.clone()]),
            auth: true,
            changes: robots.iter().cloned().map(Change::Robot).collect(),
            ..Updates::default()
        };
        let packets = packed(messages(updates));
        let sequences: Vec<u64> = packets.iter().map(|packet| packet.sequence).collect();
        assert_eq!(sequences, (1..=packets.len() as u64).collect::<Vec<_>>());
        let received: Vec<_> = packets.into_iter().flat_map(Packet::into_messages).collect();
        assert_eq!(
            received[..3],
            [
                ClusterMessage::AdmissionsChanged,
                ClusterMessage::EndRobot { robot: ended, kept: Some(3) },
                ClusterMessage::EndPerson(user)
            ]
        );
        let named = |message: &ClusterMessage| match message {
            ClusterMessage::NotifyRobots(robots) => robots.clone(),
            _ => Vec::new(),
        };
        assert_eq!(received.iter().flat_map(named).collect::<BTreeSet<_>>(), robots);
        let is_change = |message: &&ClusterMessage| matches!(message, ClusterMessage::Changed(_));
        assert_eq!(received.iter().filter(is_change).count(), MAX_ROBOTS);
    }

    #[test]
    fn many_robots_become_a_sweep_and_nothing_an_empty_packet() {
        let robots = (0..=MAX_ROBOTS).map(|_| RobotId::random()).collect();
        let to_notify = RobotsToNotify { all: false, robots };
        let updates = Updates { to_notify, ..Updates::default() };
        assert_eq!(messages(updates), [ClusterMessage::Sweep]);
        assert_eq!(packed(Vec::new()).len(), 1);
    }

    #[test]
    fn unknown_messages_and_fields_are_skipped() {
        let text = r#"{"run": "b-1", "sequence": 7, "later": true, "messages": [
            "sweep", {"reboot": ["r1"]}, {"changed": {"site": "lab"}}, "rights_changed"]}"#;
        let packet: Packet = serde_json::from_str(text).expect("a packet");
        assert_eq!(packet.into_messages(), [ClusterMessage::Sweep, ClusterMessage::RightsChanged]);
    }
}
