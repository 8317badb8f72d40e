//! The protocol between the agent and the program that takes part in the ROS graph for it: one JSON
//! object a line, on the program's standard input and output. `task-agent graph` is one such
//! program; any other program that speaks this protocol can replace it.
//!
//! Both sides ignore fields and lines that they do not know, so either may be older. A line has a
//! limit: an event above the limit ends the program, and a request above the limit is refused by
//! the agent. Times are ages in milliseconds, because two programs need not share a clock.
//!
//! ```text
//! agent                                    program
//! {"join":{"domain_id":0,…}}           ─▶
//!                                      ◀─  "joined", or {"failed":{"error":{…}}} and its end
//!                                      ◀─  {"snapshot":{…}} whenever the graph shows something else
//!                                      ◀─  {"unchanged":{"age_ms":…}} every few seconds otherwise
//! {"call":{"id":1,"within_ms":2000,…}} ─▶
//!                                      ◀─  {"answer":{"id":1,…}} or {"refused":{"id":1,"error":{…}}}
//! {"listen":"rosout"}                  ─▶
//!                                      ◀─  {"rosout":{…}} for each line
//! {"count":{"meter":1,…}}              ─▶
//!                                      ◀─  {"rate":{"meter":1,…}} whenever it is another
//! the end of its input                 ─▶
//!                                      ◀─  its end
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use task_proto::telemetry::ros::{GraphName, LifecycleState, Transition};
use task_proto::time::millis;
use tokio::io::{AsyncBufRead, AsyncBufReadExt as _, AsyncReadExt as _};

use crate::ros::graph::calls::parameters::{ParameterValue, SetResult};
use crate::ros::graph::dds::snapshot::{MAX_NODES, Node, Participant, ParticipantId, Snapshot};
use crate::ros::graph::feeds::{DiagnosticStatus, RosoutLine};
use crate::ros::graph::{GraphError, GraphSettings};

/// The longest request, in bytes.
pub const MAX_REQUEST_BYTES: usize = 1 << 20;
/// The longest event, in bytes: a graph of thousands of nodes.
pub const MAX_EVENT_BYTES: usize = 8 << 20;
/// Capacity that a line buffer keeps from one line to the next.
const KEPT_BUFFER_BYTES: usize = 64 << 10;
/// Maximum number of participants in a snapshot.
const MAX_PARTICIPANTS: usize = 4096;
/// Maximum interval between two events of the program. A program that is silent for much longer
/// hangs.
pub const ALIVE_INTERVAL: Duration = Duration::from_secs(3);

/// Requests of the agent.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Request {
    /// Take part in the graph. This request comes first, and once.
    Join(GraphSettings),
    /// Call a node and return the result.
    Call {
        id: u64,
        /// Time limit of the call.
        within_ms: u64,
        call: Call,
    },
    /// Forward messages of a feed from now on.
    Listen(Feed),
    /// Count the messages of a topic.
    Count { meter: u64, topic: GraphName, kind: String },
    /// Stop counting the messages of a topic.
    StopCounting { meter: u64 },
}

/// A call to a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Call {
    /// Create the endpoints that calls to this node need, before the node exists.
    Prepare { node: GraphName },
    /// Wait until a server of the service would receive a request.
    Servers {
        service: GraphName,
        /// The service's type; absent: the type that the graph shows.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        kind: Option<String>,
    },
    /// Ask a lifecycle node for its state.
    LifecycleState { node: GraphName },
    /// Request a transition of a lifecycle node, once.
    ChangeState { node: GraphName, transition: Transition },
    /// Ask a node for all its parameters. The time limit applies to each of the calls that this
    /// takes.
    Parameters { node: GraphName },
    /// Ask a node for one parameter.
    Parameter { node: GraphName, name: String },
    /// Set parameters of a node, each independently.
    SetParameters { node: GraphName, parameters: Vec<(String, ParameterValue)> },
}

/// Feeds of messages from all nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Feed {
    Rosout,
    /// Diagnostic statuses of the robot's parts.
    Diagnostics,
}

/// Events of the program.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// The program takes part in the graph.
    Joined,
    /// The program could not join, and ends.
    Failed { error: GraphError },
    /// The new state of the graph.
    Snapshot(SnapshotMessage),
    /// The graph has not changed.
    Unchanged {
        /// Age of the last look at the graph.
        age_ms: u64,
    },
    /// A call was answered.
    Answer {
        /// Id of the call.
        id: u64,
        /// The result of the call.
        answer: Answer,
    },
    Refused {
        /// Id of the call.
        id: u64,
        error: GraphError,
    },
    /// A node logged something.
    Rosout(RosoutLine),
    /// A node published the status of a part.
    Diagnostic(DiagnosticStatus),
    /// Messages of a feed came too fast to be forwarded.
    Missed {
        /// Number of lost messages.
        count: u64,
    },
    /// Message rate of a topic.
    Rate {
        meter: u64,
        hz: f64,
        /// Age of the last message; absent: no message has come.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        since_last_ms: Option<u64>,
        /// Messages since the meter was made.
        samples: u64,
    },
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Answer {
    /// The call succeeded and has no result.
    Done,
    /// The participants with such a server.
    Servers(BTreeSet<ParticipantId>),
    State(LifecycleState),
    /// Whether the node made the transition.
    Changed(bool),
    /// Parameters with their values.
    Parameters(Vec<(String, ParameterValue)>),
    Parameter(ParameterValue),
    /// The result for each parameter that was set.
    Set(Vec<SetResult>),
}

/// A snapshot in the form in which it is sent.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SnapshotMessage {
    /// Age of the snapshot.
    age_ms: u64,
    nodes: Vec<Node>,
    participants: Vec<ParticipantMessage>,
    #[serde(default)]
    omitted: usize,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct ParticipantMessage {
    id: ParticipantId,
    #[serde(default)]
    locators: BTreeSet<SocketAddr>,
    /// Time since the participant was first seen.
    seen_ms: u64,
}

impl SnapshotMessage {
    /// The form of the snapshot for sending at `now`.
    pub fn of(snapshot: &Snapshot, now: Instant) -> Self {
        let participant = |(id, participant): (&ParticipantId, &Participant)| ParticipantMessage {
            id: *id,
            locators: participant.locators.clone(),
            seen_ms: millis(now.saturating_duration_since(participant.first_seen)),
        };
        Self {
            age_ms: millis(now.saturating_duration_since(snapshot.at)),
            nodes: snapshot.nodes.clone(),
            participants: snapshot
                .participants
                .iter()
                .take(MAX_PARTICIPANTS)
                .map(participant)
                .collect(),
            omitted: snapshot.omitted,
        }
    }

    /// Drops the second half of the nodes; false when there is at most one node.
    fn halve(&mut self) -> bool {
        let kept = self.nodes.len() / 2;
        self.omitted += self.nodes.len() - kept;
        self.nodes.truncate(kept);
        kept > 0
    }

    /// The snapshot as received at `now`. `before` is the previously received one: a participant
    /// keeps its first-seen time from there, however long this message was on its way.
    pub fn into_snapshot(self, now: Instant, before: &Snapshot) -> Snapshot {
        let ago = |age_ms| now.checked_sub(Duration::from_millis(age_ms)).unwrap_or(now);
        let mut nodes = self.nodes;
        let omitted = self.omitted.saturating_add(nodes.len().saturating_sub(MAX_NODES));
        nodes.truncate(MAX_NODES);
        nodes.sort();
        let participants = self.participants.into_iter().take(MAX_PARTICIPANTS).map(|shown| {
            let seen = ago(shown.seen_ms);
            let known = before.participants.get(&shown.id).map(|known| known.first_seen);
            let first_seen =
                known.filter(|known| seen.saturating_duration_since(*known) < ALIVE_INTERVAL);
            (
                shown.id,
                Participant { locators: shown.locators, first_seen: first_seen.unwrap_or(seen) },
            )
        });
        let participants: BTreeMap<_, _> = participants.collect();
        Snapshot { at: ago(self.age_ms), nodes, participants, omitted }
    }
}

impl Event {
    /// The event as one line. A graph that is too large for one line is cut.
    pub fn line(self) -> io::Result<Vec<u8>> {
        let mut event = self;
        loop {
            let line = line_of(&event)?;
            if line.len() <= MAX_EVENT_BYTES {
                return Ok(line);
            }
            let was_cut =
                if let Self::Snapshot(shown) = &mut event { shown.halve() } else { false };
            if !was_cut {
                return Err(io::Error::new(io::ErrorKind::InvalidData, "an event is too long"));
            }
        }
    }
}

impl Request {
    /// The request as one line.
    pub fn line(&self) -> io::Result<Vec<u8>> {
        line_of(self).and_then(|line| {
            let fits = line.len() <= MAX_REQUEST_BYTES;
            if fits {
                Ok(line)
            } else {
                Err(io::Error::new(io::ErrorKind::InvalidData, "a request is too long"))
            }
        })
    }
}

fn line_of(message: &impl Serialize) -> io::Result<Vec<u8>> {
    let mut line = serde_json::to_vec(message)?;
    line.push(b'\n');
    Ok(line)
}

/// Reads messages from lines.
#[derive(Debug)]
pub struct Lines<R> {
    from: R,
    max_bytes: usize,
    line: Vec<u8>,
}

impl<R: AsyncBufRead + Unpin> Lines<R> {
    /// Lines of at most `max_bytes`.
    pub fn new(from: R, max_bytes: usize) -> Self {
        Self { from, max_bytes, line: Vec::new() }
    }

    /// The next message that can be parsed; `None`: there are no more. Not cancel-safe.
    pub async fn next<M: DeserializeOwned>(&mut self) -> io::Result<Option<M>> {
        loop {
            self.line.clear();
            self.line.shrink_to(KEPT_BUFFER_BYTES);
            let limit = self.max_bytes as u64 + 1;
            if (&mut self.from).take(limit).read_until(b'\n', &mut self.line).await? == 0 {
                return Ok(None);
            }
            if self.line.len() > self.max_bytes {
                return Err(io::Error::new(io::ErrorKind::InvalidData, "a line is too long"));
            }
            match serde_json::from_slice(&self.line) {
                Ok(message) => return Ok(Some(message)),
                Err(error) => tracing::debug!(%error, "cannot parse a line of the graph protocol"),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn node(name: &str) -> Node {
        let (publishers, subscriptions, services, clients) = Default::default();
        let participant = ParticipantId([1; 12]);
        Node {
            name: name.parse().expect("a name"),
            participant,
            publishers,
            subscriptions,
            services,
            clients,
        }
    }

    #[test]
    fn messages_are_written_as_documented() {
        let settings = GraphSettings {
            domain_id: 7,
            localhost_only: true,
            node_name: "/agent".parse().expect("a name"),
            distro: None,
        };
        let call =
            Call::Parameter { node: "/talker".parse().expect("a name"), name: "rate".to_owned() };
        let requests = [
            (
                Request::Join(settings),
                json!({"join": {"domain_id": 7, "localhost_only": true, "node_name": "/agent", "distro": null}}),
            ),
            (
                Request::Call { id: 1, within_ms: 2000, call },
                json!({"call": {"id": 1, "within_ms": 2000, "call": {"parameter": {"node": "/talker", "name": "rate"}}}}),
            ),
            (Request::Listen(Feed::Rosout), json!({"listen": "rosout"})),
        ];
        for (request, expected) in requests {
            assert_eq!(
                serde_json::from_slice::<Value>(&request.line().expect("a line")).expect("JSON"),
                expected
            );
        }
        let value = ParameterValue::Doubles(vec![1.0, f64::NAN, f64::NEG_INFINITY]);
        let answer = Event::Answer { id: 1, answer: Answer::Parameter(value) };
        let line = answer.line().expect("a line");
        let expected = json!({"answer": {"id": 1, "answer": {"parameter": {"doubles": [1.0, "NaN", "-inf"]}}}});
        assert_eq!(serde_json::from_slice::<Value>(&line).expect("JSON"), expected);
        let read: Event = serde_json::from_slice(&line).expect("an event");
        let Event::Answer { answer: Answer::Parameter(ParameterValue::Doubles(read)), .. } = read
        else {
            panic!("another event: {read:?}")
        };
        assert!(read[0] == 1.0 && read[1].is_nan() && read[2] == f64::NEG_INFINITY);
    }

    #[tokio::test]
    async fn unknown_lines_and_fields_are_ignored_and_a_long_line_is_an_error() {
        let text =
            b"{\"sing\":{}}\nnot JSON\n{\"unchanged\":{\"age_ms\":5,\"mood\":\"good\"}}\n".to_vec();
        let mut lines = Lines::new(&text[..], 100);
        let read = lines.next::<Event>().await.expect("a line").expect("an event");
        assert!(matches!(read, Event::Unchanged { age_ms: 5 }), "{read:?}");
        assert!(lines.next::<Event>().await.expect("the end").is_none());
        let text = [b'x'; 300];
        let error = Lines::new(&text[..], 100).next::<Event>().await.expect_err("too long");
        assert_eq!(error.kind(), io::ErrorKind::InvalidData);
    }

    #[test]
    fn snapshot_keeps_its_content_and_first_seen_times_over_the_wire() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut sent = Snapshot::empty(at(900));
        sent.nodes = vec![node("/a"), node("/b")];
        let locators = BTreeSet::from(["127.0.0.1:7411".parse().expect("an address")]);
        sent.participants
            .insert(ParticipantId([1; 12]), Participant { locators, first_seen: at(400) });
        let message = serde_json::to_vec(&SnapshotMessage::of(&sent, at(1000))).expect("JSON");
        let shown: SnapshotMessage = serde_json::from_slice(&message).expect("a snapshot");
        let first = shown.clone().into_snapshot(at(1000), &Snapshot::empty(start));
        assert!(first.has_same_content(&sent) && first.at == sent.at, "{first:?}");
        let late = shown.into_snapshot(at(1500), &first);
        assert!(late.has_same_content(&first), "{late:?}");
    }

    #[test]
    fn too_large_graph_is_cut_by_the_sender() {
        let mut snapshot = Snapshot::empty(Instant::now());
        let kind = "x".repeat(9000);
        for number in 0..MAX_NODES {
            let mut node = node(&format!("/node_{number}"));
            let name = "/topic".parse().expect("a name");
            node.publishers.push(task_proto::telemetry::ros::Endpoint { name, kind: kind.clone() });
            snapshot.nodes.push(node);
        }
        let line =
            Event::Snapshot(SnapshotMessage::of(&snapshot, Instant::now())).line().expect("a line");
        assert!(line.len() <= MAX_EVENT_BYTES);
        let Event::Snapshot(shown) = serde_json::from_slice(&line).expect("an event") else {
            panic!("another event")
        };
        assert_eq!((shown.nodes.len(), shown.omitted), (MAX_NODES / 4, MAX_NODES / 4 * 3));
    }

    #[test]
    fn too_large_graph_is_cut_by_the_receiver() {
        let now = Instant::now();
        let nodes = (0..MAX_NODES + 3).map(|number| node(&format!("/node_{number}"))).collect();
        let participant = |number: u64| {
            let mut id = [0; 12];
            id[..8].copy_from_slice(&number.to_le_bytes());
            ParticipantMessage { id: ParticipantId(id), locators: BTreeSet::new(), seen_ms: 0 }
        };
        let participants = (0..=MAX_PARTICIPANTS as u64).map(participant).collect();
        let shown = SnapshotMessage { age_ms: 0, nodes, participants, omitted: 2 };
        let received = shown.into_snapshot(now, &Snapshot::empty(now));
        assert_eq!((received.nodes.len(), received.omitted), (MAX_NODES, 5));
        assert_eq!(received.participants.len(), MAX_PARTICIPANTS);
    }
}
