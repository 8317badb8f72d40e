//! The robot's ROS 2 graph: its nodes and endpoints, calls to nodes, and messages from nodes. This
//! module decides nothing about tasks.
//!
//! Every host on the network may send to a participant of a ROS graph, and a large library reads
//! the bytes. So the agent, which may be root, does not take part itself. It starts a program that
//! has no rights and little memory, and communicates with this program over pipes ([`process`]).
//! The program is the agent's own executable with a DDS participant.
//!
//! Only these modules name `ros2-client`. The graph uses its message types and the DDS library
//! below it (RustDDS), but not its `Node`, `Spinner` and `Client`. Those fix the length of a gid at
//! compile time, so one agent could not serve Humble and newer robots; they keep 8 events and lose
//! the rest, never withdraw an announced endpoint, and accept any claim of an untrusted sender
//! about its nodes.
//!
//! No C library is needed. Two kinds of participants stay invisible: those that speak neither UDP
//! nor RTPS (Zenoh), and those that use DDS Security.

pub mod calls;
pub mod dds;
pub mod feeds;
pub mod owners;
pub mod process;
pub mod rate;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use task_proto::telemetry::ros::{GraphName, LifecycleState, Transition};
use tokio::sync::{broadcast, watch};
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;

pub use self::calls::parameters::{ParameterValue, SetResult};
use self::dds::names::{self, Role};
pub use self::dds::snapshot::{EndpointId, Node, Participant, ParticipantId, Snapshot};
pub use self::feeds::{DiagnosticLevel, DiagnosticStatus, RosoutLine};
pub use self::owners::Owners;
use self::process::connection::Connection;
pub use self::process::program::GraphProgram;
use self::process::protocol::{Answer, Call, Feed, Request};
pub use self::rate::{Rate, RateMeter};

/// The highest domain id with valid ports.
pub const MAX_DOMAIN_ID: u16 = 232;

/// Settings for taking part in the graph. The program reads no environment variables: the caller
/// that opens the graph has read them.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GraphSettings {
    /// `ROS_DOMAIN_ID`, at most [`MAX_DOMAIN_ID`].
    pub domain_id: u16,
    /// Whether only this host's nodes are met. Then no data from another host is read.
    pub localhost_only: bool,
    /// The agent's node. Two agents on one host, or in one domain, need two names.
    pub node_name: GraphName,
    /// The distribution of the robot's nodes. It decides the form in which the agent's node is
    /// announced; nodes of all distributions are understood.
    pub distro: Option<String>,
}

/// Errors of the graph.
#[derive(Debug, Clone, PartialEq, thiserror::Error, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GraphError {
    /// The domain id is out of range.
    #[error("ros_domain_id: {0} is not from 0 to {MAX_DOMAIN_ID}")]
    DomainId(u16),
    /// The program that takes part could not be started.
    #[error("cannot start the program that takes part in the ROS graph: {reason}")]
    Start { reason: String },
    /// The agent could not take part in the domain.
    #[error("cannot take part in ROS domain {domain_id}: {reason}")]
    Join {
        domain_id: u16,
        /// The DDS library's error.
        reason: String,
    },
    /// A reader or writer could not be created.
    #[error("cannot make a reader or writer for {topic}: {reason}")]
    Endpoint {
        topic: String,
        /// The DDS library's error.
        reason: String,
    },
    /// The text is not the name of a type.
    #[error("{0:?} is not a type like std_srvs/srv/Trigger")]
    Kind(String),
    /// The service's full name would exceed the limit for ROS names.
    #[error("{node}/{service} is longer than a ROS name may be")]
    Name { node: GraphName, service: String },
    /// A message could not be serialized.
    #[error("cannot encode the request: {reason}")]
    Encode { reason: String },
    /// A message could not be sent.
    #[error("cannot send the request: {reason}")]
    Write {
        /// The DDS library's error.
        reason: String,
    },
    /// No node offers the service.
    #[error("{service}: no server within {within:?}")]
    NoServer {
        service: GraphName,
        #[serde(rename = "within_ms", with = "milliseconds")]
        within: Duration,
    },
    /// There is a server, but no answer arrived.
    #[error("{service}: no answer within {within:?}")]
    NoAnswer {
        service: GraphName,
        #[serde(rename = "within_ms", with = "milliseconds")]
        within: Duration,
    },
    /// The answer does not decode as the service's type.
    #[error("{service}: the answer is not of the service's type")]
    Malformed { service: GraphName },
    /// The node exceeds a limit.
    #[error("{node}: {found} {what} are too many")]
    TooMany {
        /// The kind of the counted objects.
        what: String,
        node: GraphName,
        found: usize,
    },
    /// The limit of concurrent calls is reached.
    #[error("too many calls to nodes are under way")]
    Busy,
    /// The graph was closed, or the program that takes part in it has ended.
    #[error("the graph is closed")]
    Closed,
}

/// A handle on the graph. When the last handle is dropped, the agent's node leaves.
#[derive(Clone)]
pub struct Graph {
    shared: Arc<Shared>,
}

struct Shared {
    connection: Arc<Connection>,
    snapshot: watch::Receiver<Arc<Snapshot>>,
    closing: CancellationToken,
    tracker: TaskTracker,
    _closes_with_this: DropGuard,
}

impl GraphSettings {
    fn check(&self) -> Result<(), GraphError> {
        if self.domain_id > MAX_DOMAIN_ID {
            Err(GraphError::DomainId(self.domain_id))
        } else {
            Ok(())
        }
    }
}

impl GraphError {
    fn endpoint(topic: impl Into<String>, source: impl std::error::Error) -> Self {
        Self::Endpoint { topic: topic.into(), reason: source.to_string() }
    }
}

impl Graph {
    /// Takes part in the domain through a program that is started for it.
    pub async fn open(
        settings: &GraphSettings,
        program: &GraphProgram,
    ) -> Result<Self, GraphError> {
        settings.check()?;
        let closing = CancellationToken::new();
        let closes_with_this = closing.clone().drop_guard();
        let tracker = TaskTracker::new();
        let (connection, snapshot) =
            Connection::open(settings.clone(), program, &closing, &tracker).await?;
        let shared =
            Shared { connection, snapshot, closing, tracker, _closes_with_this: closes_with_this };
        Ok(Self { shared: Arc::new(shared) })
    }

    /// The current state of the graph. [`Snapshot::at`] is at most a few seconds old while the
    /// graph is open.
    pub fn snapshot(&self) -> Arc<Snapshot> {
        self.shared.snapshot.borrow().clone()
    }

    /// Wakes when the graph changes; several changes may arrive as one. The channel ends when the
    /// graph is closed.
    pub fn changes(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.shared.snapshot.clone()
    }

    /// The process that takes part in the graph.
    pub fn pid(&self) -> u32 {
        self.shared.connection.pid()
    }

    /// Determines which participants in this snapshot live in these processes: a task owns only the
    /// nodes that it started.
    pub async fn owners(snapshot: Arc<Snapshot>, pids: Vec<u32>) -> Owners {
        let unknown = Owners {
            unknown: snapshot.participants.keys().copied().collect(),
            ..Owners::default()
        };
        let owners =
            tokio::task::spawn_blocking(move || Owners::of(&snapshot.participants, &pids)).await;
        owners.unwrap_or(unknown)
    }

    /// The process on this host that contains the participant, if it can be determined.
    pub async fn process_of(participant: Participant) -> Option<u32> {
        tokio::task::spawn_blocking(move || Owners::process_of(&participant)).await.ok().flatten()
    }

    /// Creates the client endpoints that [`Self::lifecycle_state`], [`Self::change_state`] and the
    /// parameter calls need for this node. A node that starts later finds them there and answers
    /// sooner.
    pub async fn prepare(&self, node: &GraphName) -> Result<(), GraphError> {
        match self.call(Call::Prepare { node: node.clone() }, Duration::ZERO).await? {
            Answer::Done => Ok(()),
            _ => Err(GraphError::Malformed { service: node.clone() }),
        }
    }

    /// Waits until a server of this service would receive a request and its answer would be
    /// received. Returns the participants that have such a server. Without `kind` the service's
    /// type is taken from the graph.
    pub async fn service_answers(
        &self,
        service: &GraphName,
        kind: Option<&str>,
        within: Duration,
    ) -> Result<BTreeSet<ParticipantId>, GraphError> {
        let call = Call::Servers { service: service.clone(), kind: kind.map(str::to_owned) };
        match self.call(call, within).await? {
            Answer::Servers(participants) => Ok(participants),
            _ => Err(GraphError::Malformed { service: service.clone() }),
        }
    }

    /// The state of this lifecycle node.
    pub async fn lifecycle_state(
        &self,
        node: &GraphName,
        within: Duration,
    ) -> Result<LifecycleState, GraphError> {
        match self.call(Call::LifecycleState { node: node.clone() }, within).await? {
            Answer::State(state) => Ok(state),
            _ => Err(GraphError::Malformed { service: node.clone() }),
        }
    }

    /// Requests a transition of this lifecycle node, once; returns whether the node made the
    /// transition. After [`GraphError::NoAnswer`] or [`GraphError::Closed`] the node may have made
    /// the transition: ask for its state.
    pub async fn change_state(
        &self,
        node: &GraphName,
        transition: Transition,
        within: Duration,
    ) -> Result<bool, GraphError> {
        match self.call(Call::ChangeState { node: node.clone(), transition }, within).await? {
            Answer::Changed(changed) => Ok(changed),
            _ => Err(GraphError::Malformed { service: node.clone() }),
        }
    }

    /// All parameters of this node. `within` applies to each of the calls that this takes.
    pub async fn parameters(
        &self,
        node: &GraphName,
        within: Duration,
    ) -> Result<Vec<(String, ParameterValue)>, GraphError> {
        match self.call(Call::Parameters { node: node.clone() }, within).await? {
            Answer::Parameters(parameters) => Ok(parameters),
            _ => Err(GraphError::Malformed { service: node.clone() }),
        }
    }

    /// One parameter of this node; [`ParameterValue::NotSet`] where the node has none of that name.
    pub async fn parameter(
        &self,
        node: &GraphName,
        name: &str,
        within: Duration,
    ) -> Result<ParameterValue, GraphError> {
        match self
            .call(Call::Parameter { node: node.clone(), name: name.to_owned() }, within)
            .await?
        {
            Answer::Parameter(value) => Ok(value),
            _ => Err(GraphError::Malformed { service: node.clone() }),
        }
    }

    /// Sets these parameters, each independently; returns the result of each, in their order.
    pub async fn set_parameters(
        &self,
        node: &GraphName,
        parameters: Vec<(String, ParameterValue)>,
        within: Duration,
    ) -> Result<Vec<SetResult>, GraphError> {
        match self.call(Call::SetParameters { node: node.clone(), parameters }, within).await? {
            Answer::Set(results) => Ok(results),
            _ => Err(GraphError::Malformed { service: node.clone() }),
        }
    }

    /// Log lines of nodes, from now on. The first subscriber also gets the last lines from before,
    /// because nodes keep them. A receiver that is too slow is told how many lines it missed.
    pub fn rosout(&self) -> Result<broadcast::Receiver<Arc<RosoutLine>>, GraphError> {
        let listener = self.shared.connection.rosout()?;
        self.shared.connection.send(Request::Listen(Feed::Rosout))?;
        Ok(listener)
    }

    /// Diagnostics that nodes publish about the robot's parts, from now on.
    pub fn diagnostics(&self) -> Result<broadcast::Receiver<Arc<DiagnosticStatus>>, GraphError> {
        let listener = self.shared.connection.diagnostics()?;
        self.shared.connection.send(Request::Listen(Feed::Diagnostics))?;
        Ok(listener)
    }

    /// Number of messages of nodes that came too fast to reach any listener of this handle.
    pub fn missed_messages(&self) -> u64 {
        self.shared.connection.missed_messages()
    }

    /// Counts the messages of this topic with the type `kind`, whatever the QoS settings of its
    /// publishers.
    pub fn rate(&self, topic: &GraphName, kind: &str) -> Result<RateMeter, GraphError> {
        names::type_to_dds(Role::Topic, kind).ok_or_else(|| GraphError::Kind(kind.to_owned()))?;
        Connection::meter(&self.shared.connection, topic, kind)
    }

    /// Whether the graph is closed and shows no more changes.
    pub fn is_closed(&self) -> bool {
        self.shared.closing.is_cancelled()
    }

    async fn call(&self, call: Call, within: Duration) -> Result<Answer, GraphError> {
        self.shared.connection.call(call, within).await
    }

    /// Leaves the graph. Other handles receive no more changes.
    pub async fn close(self) {
        self.shared.closing.cancel();
        self.shared.tracker.close();
        self.shared.tracker.wait().await;
    }
}

/// The name of a node's own service.
fn service_of(node: &GraphName, service: &str) -> Result<GraphName, GraphError> {
    let too_long = |_| GraphError::Name { node: node.clone(), service: service.to_owned() };
    format!("{node}/{service}").parse().map_err(too_long)
}

mod milliseconds {
    use std::time::Duration;

    use serde::{Deserialize as _, Deserializer, Serializer};
    use task_proto::time::millis;

    pub fn serialize<S: Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_u64(millis(*duration))
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Duration, D::Error> {
        u64::deserialize(deserializer).map(Duration::from_millis)
    }
}
