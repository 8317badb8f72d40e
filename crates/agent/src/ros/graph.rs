//! The robot's ROS 2 graph: what it shows, calls to nodes, what nodes say. It decides nothing about
//! tasks.
//!
//! Everybody on the network may send to whatever takes part in a ROS graph, and the bytes are read
//! by a large library. So the agent, which may be root, does not take part itself: it starts a
//! program for it ([`program`]) that has no rights and little memory, and speaks with it over pipes
//! ([`protocol`], [`connection`]). This program is the agent itself ([`serve`]) with a DDS
//! participant ([`participant`]).
//!
//! These modules are the only place that names `ros2-client`. Of it the graph uses the message
//! types and the DDS library below it (RustDDS), not its `Node`, `Spinner` and `Client`: those fix
//! the length of a gid when they are compiled, so one agent could not serve Humble and newer
//! robots, keep 8 events and lose the rest, never take back an endpoint they announced, and take
//! whatever a stranger says about its nodes.
//!
//! It costs no C library. What it cannot do: see participants that speak neither UDP nor RTPS
//! (Zenoh), or DDS Security.

pub mod entities;
pub mod feeds;
pub mod names;
pub mod owners;
pub mod parameters;
pub mod program;
pub mod protocol;
pub mod rate;
pub mod serve;
pub mod snapshot;

mod connection;
mod endpoint;
mod lifecycle;
mod observer;
mod own;
mod participant;
mod services;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use task_proto::ros::{GraphName, LifecycleState, Transition};
use tokio::sync::{broadcast, watch};
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;

use self::connection::Connection;
pub use self::feeds::{DiagnosticLevel, DiagnosticStatus, RosoutLine};
use self::names::Role;
pub use self::owners::Owners;
pub use self::parameters::{ParameterValue, SetResult};
pub use self::program::GraphProgram;
use self::protocol::{Answer, Call, Feed, Request};
pub use self::rate::{Rate, RateMeter};
pub use self::snapshot::{EndpointId, Node, Participant, ParticipantId, Snapshot};

/// The highest domain id whose ports exist.
pub const MAX_DOMAIN_ID: u16 = 232;

/// How the agent takes part in the graph. It reads no environment: whoever opens the graph has.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GraphSettings {
    /// `ROS_DOMAIN_ID`, at most [`MAX_DOMAIN_ID`].
    pub domain_id: u16,
    /// Whether only this host's nodes are met. Then nothing from another host is read.
    pub localhost_only: bool,
    /// The agent's node. Two agents on one host, or in one domain, need two names.
    pub node_name: GraphName,
    /// The distribution of the robot's nodes, which decides the form in which the agent's node is
    /// announced; nodes of all distributions are understood.
    pub distro: Option<String>,
}

/// What can go wrong with the graph.
#[derive(Debug, Clone, PartialEq, thiserror::Error, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GraphError {
    /// No such domain.
    #[error("ros_domain_id: {0} is not from 0 to {MAX_DOMAIN_ID}")]
    DomainId(u16),
    /// The program that takes part could not be started.
    #[error("cannot start the program that takes part in the ROS graph: {reason}")]
    Start {
        /// Why.
        reason: String,
    },
    /// The agent could not take part.
    #[error("cannot take part in ROS domain {domain_id}: {reason}")]
    Join {
        /// The domain.
        domain_id: u16,
        /// Why.
        reason: String,
    },
    /// A reader or writer could not be made.
    #[error("cannot make a reader or writer for {topic}: {reason}")]
    Endpoint {
        /// The DDS topic.
        topic: String,
        /// Why.
        reason: String,
    },
    /// Not a type's name.
    #[error("{0:?} is not a type like std_srvs/srv/Trigger")]
    Kind(String),
    /// A node's name to which nothing can be added.
    #[error("{node}/{service} is longer than a ROS name may be")]
    Name {
        /// The node.
        node: GraphName,
        /// The service.
        service: String,
    },
    /// A message could not be put into bytes.
    #[error("cannot encode the request: {reason}")]
    Encode {
        /// Why.
        reason: String,
    },
    /// A message could not be sent.
    #[error("cannot send the request: {reason}")]
    Write {
        /// Why, in the DDS library's words.
        reason: String,
    },
    /// Nobody offers the service.
    #[error("{service}: no server within {within:?}")]
    NoServer {
        /// The service.
        service: GraphName,
        /// How long was waited.
        #[serde(rename = "within_ms", with = "milliseconds")]
        within: Duration,
    },
    /// There is a server, but no answer.
    #[error("{service}: no answer within {within:?}")]
    NoAnswer {
        /// The service.
        service: GraphName,
        /// How long was waited.
        #[serde(rename = "within_ms", with = "milliseconds")]
        within: Duration,
    },
    /// An answer that is none.
    #[error("{service}: the answer is not of the service's type")]
    Malformed {
        /// The service.
        service: GraphName,
    },
    /// Beyond a limit.
    #[error("{node}: {found} {what} are too many")]
    TooMany {
        /// Of what.
        what: String,
        /// The node.
        node: GraphName,
        /// How many.
        found: usize,
    },
    /// More calls than can be under way at a time.
    #[error("too many calls to nodes are under way")]
    Busy,
    /// The graph was closed, or the program that takes part in it has ended.
    #[error("the graph is closed")]
    Closed,
}

/// A handle on the graph; when the last one is dropped the agent's node leaves.
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
    /// Takes part in the domain, by a program that is started for it.
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

    /// What the graph shows. [`Snapshot::at`] is at most a few seconds ago while the graph is open.
    pub fn snapshot(&self) -> Arc<Snapshot> {
        self.shared.snapshot.borrow().clone()
    }

    /// Wakes when the graph shows something else, many changes at once as one. It ends when the
    /// graph is closed.
    pub fn changes(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.shared.snapshot.clone()
    }

    /// The process that takes part in the graph.
    pub fn pid(&self) -> u32 {
        self.shared.connection.pid()
    }

    /// Which of the participants in this snapshot live in these processes: only what a task started
    /// is its own.
    pub async fn owners(snapshot: Arc<Snapshot>, pids: Vec<u32>) -> Owners {
        let unknown = Owners {
            unknown: snapshot.participants.keys().copied().collect(),
            ..Owners::default()
        };
        let asked =
            tokio::task::spawn_blocking(move || Owners::of(&snapshot.participants, &pids)).await;
        asked.unwrap_or(unknown)
    }

    /// The process on this host that a participant lives in, where it can be told.
    pub async fn process_of(participant: Participant) -> Option<u32> {
        tokio::task::spawn_blocking(move || Owners::process_of(&participant)).await.ok().flatten()
    }

    /// Makes what [`Self::lifecycle_state`], [`Self::change_state`] and the parameter calls need
    /// for this node. A node that starts later finds it there, and answers the sooner.
    pub async fn prepare(&self, node: &GraphName) -> Result<(), GraphError> {
        match self.call(Call::Prepare { node: node.clone() }, Duration::ZERO).await? {
            Answer::Done => Ok(()),
            _ => Err(GraphError::Malformed { service: node.clone() }),
        }
    }

    /// Waits until a server of this service would hear a request, and its answer would be heard;
    /// says which participants have one. Without `kind` the service's type is taken from what the
    /// graph shows.
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

    /// The state this lifecycle node is in.
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

    /// Asks this lifecycle node for a transition, once; says whether it made it. After
    /// [`GraphError::NoAnswer`] it may have, and so after [`GraphError::Closed`]: ask for its
    /// state.
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

    /// All parameters of this node. `within` is for each of the calls that takes.
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

    /// One parameter of this node; [`ParameterValue::NotSet`] where it has none of that name.
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

    /// Sets these parameters, each for itself; says what became of each, in their order.
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

    /// What nodes log, from now on; the first who asks also gets the last lines from before, for
    /// nodes keep them. A listener that is too slow is told how many lines it missed.
    pub fn rosout(&self) -> Result<broadcast::Receiver<Arc<RosoutLine>>, GraphError> {
        let listener = self.shared.connection.rosout()?;
        self.shared.connection.say(Request::Listen(Feed::Rosout))?;
        Ok(listener)
    }

    /// What nodes say about the robot's parts, from now on.
    pub fn diagnostics(&self) -> Result<broadcast::Receiver<Arc<DiagnosticStatus>>, GraphError> {
        let listener = self.shared.connection.diagnostics()?;
        self.shared.connection.say(Request::Listen(Feed::Diagnostics))?;
        Ok(listener)
    }

    /// How many messages of nodes came too fast to reach this handle's listeners at all.
    pub fn missed_messages(&self) -> u64 {
        self.shared.connection.missed_messages()
    }

    /// Counts the messages of this topic, whose type is `kind`, whatever its publishers' settings
    /// are.
    pub fn rate(&self, topic: &GraphName, kind: &str) -> Result<RateMeter, GraphError> {
        names::type_to_dds(Role::Topic, kind).ok_or_else(|| GraphError::Kind(kind.to_owned()))?;
        Connection::meter(&self.shared.connection, topic, kind)
    }

    /// Whether it shows nothing new any more.
    pub fn is_closed(&self) -> bool {
        self.shared.closing.is_cancelled()
    }

    async fn call(&self, call: Call, within: Duration) -> Result<Answer, GraphError> {
        self.shared.connection.call(call, within).await
    }

    /// Leaves the graph. Other handles see nothing any more.
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

    pub fn serialize<S: Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_u64(u64::try_from(duration.as_millis()).unwrap_or(u64::MAX))
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Duration, D::Error> {
        u64::deserialize(deserializer).map(Duration::from_millis)
    }
}
