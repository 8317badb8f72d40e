//! Owns the MQTT broker as the rest of the server sees it; it never stores anything and never reads
//! a payload.
//!
//! It rings a robot, receives what robots send and knows who is there. It asks a [`Gatekeeper`] who
//! may come in and hands messages to an [`Inbox`]. [`Broker::start`] serves MQTT itself,
//! [`Broker::connect`] makes the server a client of another broker; behind the handle both are the
//! same to the rest of the server.

mod external;
mod fan_out;
mod front;
mod router;
mod watchdog;

use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use task_proto::api::{MqttTraffic, Subscription, Traffic};
use task_proto::report::MAX_REPORT_BYTES;
use task_proto::topic::{RobotTopic, TopicPrefix};
use task_proto::{Digest, RobotId, UserName};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;

use crate::limits::conduct::Conduct;
use crate::net::tls::{ClientProof, Tls};
pub use external::{CANARY_LEVEL, ExternalConfig, external_route};
use external::{Crowd, External};
pub use fan_out::{FanOut, FanOutError, FanOutSettings, MAX_PART_BYTES, Part, PartQos};
use front::Front;
/// What reads clients' bytes; public for those who try it with any.
pub use front::codec;
use router::Router;

/// What a packet has around its message: the topic and the packet id.
const AROUND_MESSAGE_BYTES: usize = 1024;

/// What a client shows at the door.
#[derive(Clone)]
pub struct Login {
    /// The MQTT client id; empty if the client left the choice to us.
    pub client_id: String,
    /// The user name, if there is one.
    pub user_name: Option<String>,
    /// The password, if there is one: a token.
    pub password: Option<String>,
    /// Where the connection comes from.
    pub peer: SocketAddr,
    /// What the client has proven when it shook hands.
    pub proof: ClientProof,
}

/// Who a client turned out to be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Principal {
    /// A robot: speaks and listens on its own topics only. Its client id must be its robot id.
    Robot {
        /// Which.
        robot: RobotId,
        /// Which of its tokens it showed; comes back with its messages.
        token_number: u64,
        /// Whether that has just ended its other tokens: who came in by those has to leave.
        is_first_use: bool,
    },
    /// A person, or a program with a person's token: may listen below the prefix.
    Operator(UserName),
}

/// Why a client is not let in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// No such user, or the wrong password (CONNACK 4).
    #[error("bad user name or password")]
    BadCredentials,
    /// Known, but not allowed: a revoked token, another robot's name as user name (CONNACK 5).
    #[error("not authorised")]
    NotAuthorised,
    /// Nobody could say just now (CONNACK 3).
    #[error("the server cannot check credentials at the moment")]
    Unavailable,
}

/// Decides who may come in.
pub trait Gatekeeper: Send + Sync + 'static {
    /// Who this is, or why they may not enter. After [`Limits::admit_timeout`] the client is told
    /// [`Refusal::Unavailable`]; what was asked goes on to its end.
    fn admit(&self, login: Login) -> BoxFuture<'_, Result<Principal, Refusal>>;
}

/// A message from a robot on its `report`, `status`, `reply` or `log` topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotMessage {
    /// Who sent it: proven by the connection, or as far as an external broker's access control list
    /// does.
    pub robot: RobotId,
    /// Which of these topics.
    pub topic: RobotTopic,
    /// The bytes, unread.
    pub payload: Bytes,
    /// The peer's address; an external broker does not tell it.
    pub peer: Option<SocketAddr>,
    /// The connection it came by, as in [`Inbox::connected`].
    pub connection: u64,
    /// The token the connection was let in by, as in [`Principal::Robot`]. An external broker is
    /// shown no token, so what comes from there can't speak for one, and no report does.
    pub token_number: Option<u64>,
}

/// The message could not be stored; the robot keeps it and sends it again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the message was not stored")]
pub struct NotStored;

/// Receives what robots send.
pub trait Inbox: Send + Sync + 'static {
    /// A message arrived. The robot gets its acknowledgement once this resolves to `Ok`; on `Err`,
    /// or after [`Limits::inbox_timeout`], its connection is closed instead, so that it sends
    /// again. A message whose content is nonsense must resolve to `Ok`, or the robot would send it
    /// for ever. May be dropped half-way.
    fn receive(&self, message: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>>;

    /// A robot's session is live: [`Broker::ring`] reaches it from now on, so this is the moment to
    /// send its state. `connection` grows with every connection of this process. Any earlier
    /// session of this robot has fully ended. An external broker does not tell the peer.
    fn connected(&self, robot: &RobotId, peer: Option<SocketAddr>, connection: u64);

    /// The robot's session with this number has ended. Comes exactly once for each `connected`,
    /// after it.
    fn disconnected(&self, robot: &RobotId, connection: u64);

    /// The external broker is back, and any robot may be at it already: [`Broker::ring`] each, so
    /// that those who are there have their state and say so.
    fn everyone_may_be_there(&self);
}

/// Where the broker listens and what bounds it.
#[derive(Debug, Clone)]
pub struct BrokerConfig {
    /// The listener's address; port 0 picks a free one.
    pub listen: SocketAddr,
    /// What it speaks, if it encrypts.
    pub tls: Option<Tls>,
    /// What all topics start with.
    pub prefix: TopicPrefix,
    /// The bounds.
    pub limits: Limits,
    /// How robots behave.
    pub conduct: Arc<Conduct>,
}

/// Bounds on everything a client may take up.
#[derive(Debug, Clone)]
pub struct Limits {
    /// Connections at a time, those not yet admitted included.
    pub max_connections: usize,
    /// Those of one address that have not sent CONNECT yet; a further one takes the place of the
    /// oldest.
    pub max_silent_per_address: usize,
    /// Operators among them.
    pub max_operators: usize,
    /// Sessions of one person among those.
    pub max_sessions_per_person: usize,
    /// The largest packet of an admitted client, in bytes after the fixed header.
    pub max_packet_bytes: usize,
    /// Filters in one SUBSCRIBE that are looked at, and subscriptions of one client.
    pub max_filters: usize,
    /// From accepting a connection until its CONNECT must be complete.
    pub connect_timeout: Duration,
    /// How long the gatekeeper may think.
    pub admit_timeout: Duration,
    /// How long the inbox may take to store a message.
    pub inbox_timeout: Duration,
    /// How long a client may leave our bytes unread.
    pub write_timeout: Duration,
    /// When a client that asked for no keepalive is taken for gone.
    pub max_silence: Duration,
    /// How often the watchdog sends its canary through the listener.
    pub canary_interval: Duration,
    /// How long each half of its way may take: to be let in, and to hear itself.
    pub canary_timeout: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_connections: 20_000,
            max_silent_per_address: 2048,
            max_operators: 256,
            max_sessions_per_person: 16,
            max_packet_bytes: MAX_REPORT_BYTES + AROUND_MESSAGE_BYTES,
            max_filters: 64,
            connect_timeout: Duration::from_secs(10),
            admit_timeout: Duration::from_secs(10),
            inbox_timeout: Duration::from_secs(15),
            write_timeout: Duration::from_secs(20),
            max_silence: Duration::from_secs(1800),
            canary_interval: Duration::from_secs(5),
            canary_timeout: Duration::from_secs(10),
        }
    }
}

/// How the broker is. Watch it; on [`Health::Failed`] the server should say so and end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Health {
    /// The canary came through.
    Serving,
    /// It did not, and a remedy is under way; says what was seen.
    Recovering(String),
    /// The remedies are used up; says what was seen last.
    Failed(String),
}

/// Why the broker did not start.
#[derive(Debug, thiserror::Error)]
pub enum BrokerError {
    /// The address is taken, or not ours.
    #[error("cannot listen for MQTT on {address}")]
    Listen {
        /// The configured address.
        address: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// The router thread did not come up.
    #[error("the message router did not start: {reason}")]
    Router {
        /// What was seen.
        reason: String,
    },
}

/// The robot has no live session here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the robot is not connected over MQTT")]
pub struct NotConnected;

/// Why a question did not go out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NotAsked {
    /// The robot has no live session here.
    #[error("the robot is not connected over MQTT")]
    NotConnected,
    /// Too many questions wait for it already.
    #[error("the robot has not taken the questions before this one")]
    Busy,
}

/// A handle on the running broker; clones are cheap.
#[derive(Clone)]
pub struct Broker {
    kind: Kind,
    health: watch::Receiver<Health>,
}

#[derive(Clone)]
enum Kind {
    Embedded(Arc<Front>),
    External(Arc<External>),
}

impl Broker {
    /// Binds the listener and starts serving on the current runtime.
    pub async fn start(
        config: BrokerConfig,
        gatekeeper: Arc<dyn Gatekeeper>,
        inbox: Arc<dyn Inbox>,
    ) -> Result<Self, BrokerError> {
        let limits = config.limits.clone();
        let router = Router::start(&config.prefix, limits.max_operators).await;
        let router = router.map_err(|error| BrokerError::Router { reason: error.to_string() })?;
        let front = Front::start(config, gatekeeper, inbox, router.clone()).await?;
        let health = watchdog::start(&front, router, &limits);
        Ok(Self { kind: Kind::Embedded(front), health })
    }

    /// Becomes a client of another broker, now or as soon as that can be reached. Its health is
    /// never
    /// [`Health::Failed`]: it mends by itself.
    pub fn connect(config: ExternalConfig, inbox: Arc<dyn Inbox>) -> Self {
        let (external, health) = External::start(config, inbox);
        Self { kind: Kind::External(external), health }
    }

    /// Sends `payload` on the robot's `desired` topic, QoS 1. Never waits: one undelivered payload
    /// is held for a robot, and a newer one takes its place, also before the robot has subscribed.
    pub fn ring(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotConnected> {
        match &self.kind {
            Kind::Embedded(front) => front.ring(robot, payload),
            Kind::External(external) => external.ring(robot, payload),
        }
    }

    /// Whether [`Broker::ring`] may reach the robot. An external broker does not say who listens:
    /// all of them may.
    pub fn may_reach(&self, robot: &RobotId) -> bool {
        match &self.kind {
            Kind::Embedded(front) => front.has_session(robot),
            Kind::External(external) => external.is_up(),
        }
    }

    /// Whether robots hear all that is said to them from a broker that is not the server's own.
    pub fn is_external(&self) -> bool {
        matches!(self.kind, Kind::External(_))
    }

    /// Waits until many more may be rung.
    pub async fn room(&self) {
        match &self.kind {
            // Each session holds its own one, so there always is.
            Kind::Embedded(_) => {}
            Kind::External(external) => external.room().await,
        }
    }

    /// Sends `payload` on the robot's `request` topic, QoS 1. Never waits; questions that have not
    /// gone out when the session ends are lost.
    pub fn ask(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotAsked> {
        match &self.kind {
            Kind::Embedded(front) => front.ask(robot, payload),
            Kind::External(external) => external.ask(robot, payload),
        }
    }

    /// Lets `robots` subscribe to `p/<digest>`, to hear the parts that are published from then on,
    /// until the [`FanOut`] is dropped. Few packages at a time. At an external broker every robot
    /// may subscribe at any time.
    pub fn fan_out(
        &self,
        digest: Digest,
        settings: FanOutSettings,
        robots: Vec<RobotId>,
    ) -> Result<FanOut, FanOutError> {
        match &self.kind {
            Kind::Embedded(front) => FanOut::begin(front.clone(), digest, settings, robots),
            Kind::External(external) => {
                Ok(FanOut::at(Crowd::new(external.clone(), digest, settings.qos)))
            }
        }
    }

    /// The bytes of packages' parts that are held for listeners: the front's backlog. Those on
    /// their way to an external broker are as few as its window.
    pub fn queued_part_bytes(&self) -> usize {
        match &self.kind {
            Kind::Embedded(front) => front.grants().queued_bytes(),
            Kind::External(external) => external.queued_part_bytes(),
        }
    }

    /// Ends the robot's session, if it has one: its token was revoked or it was removed. At an
    /// external broker nobody can be put out; the robot just counts as gone.
    pub fn disconnect(&self, robot: &RobotId) {
        match &self.kind {
            Kind::Embedded(front) => front.disconnect(robot),
            Kind::External(external) => external.disconnect(robot),
        }
    }

    /// Serves a client whose connection somebody else has accepted, once `handshake` ends. False:
    /// the broker is another one, or has no room.
    pub fn take_in<S>(
        &self,
        peer: SocketAddr,
        handshake: impl Future<Output = io::Result<(S, ClientProof)>> + Send + 'static,
    ) -> bool
    where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        match &self.kind {
            Kind::Embedded(front) => front.take_in(peer, handshake),
            Kind::External(_) => false,
        }
    }

    /// Ends the person's sessions: what they may has changed, or one of their tokens has ended.
    pub fn disconnect_person(&self, user: &UserName) {
        match &self.kind {
            Kind::Embedded(front) => front.disconnect_person(user),
            // There they are not ours to know.
            Kind::External(_) => {}
        }
    }

    /// What went over MQTT so far; with an external broker only over our own connection.
    pub fn traffic(&self) -> MqttTraffic {
        match &self.kind {
            Kind::Embedded(front) => front.traffic(),
            Kind::External(external) => external.traffic(),
        }
    }

    /// What went over the robot's connection, if it has one and it is ours.
    pub fn traffic_of(&self, robot: &RobotId) -> Option<Traffic> {
        match &self.kind {
            Kind::Embedded(front) => front.traffic_of(robot),
            Kind::External(_) => None,
        }
    }

    /// What the robot's session listens to, if it has one and it is ours; sorted by filter.
    pub fn subscriptions_of(&self, robot: &RobotId) -> Vec<Subscription> {
        match &self.kind {
            Kind::Embedded(front) => front.subscriptions_of(robot),
            Kind::External(_) => Vec::new(),
        }
    }

    /// How many robots are connected.
    pub fn connected_count(&self) -> usize {
        match &self.kind {
            Kind::Embedded(front) => front.connected_count(),
            Kind::External(external) => external.connected_count(),
        }
    }

    /// The listener's address as bound; none with an external broker.
    pub fn local_addr(&self) -> Option<SocketAddr> {
        match &self.kind {
            Kind::Embedded(front) => Some(front.local_addr()),
            Kind::External(_) => None,
        }
    }

    /// Where the broker is, `host:port`; of several external ones that which the server was
    /// connected to last.
    pub fn address(&self) -> String {
        match &self.kind {
            Kind::Embedded(front) => front.local_addr().to_string(),
            Kind::External(external) => external.address(),
        }
    }

    /// How the broker is, now and from now on.
    pub fn health(&self) -> watch::Receiver<Health> {
        self.health.clone()
    }

    /// Stops accepting, ends every session of ours and waits until all have ended, at most for
    /// `patience`.
    pub async fn shutdown(&self, patience: Duration) {
        match &self.kind {
            Kind::Embedded(front) => front.shutdown(patience).await,
            Kind::External(external) => external.shutdown(patience).await,
        }
    }
}

impl fmt::Debug for Login {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Login")
            .field("client_id", &self.client_id)
            .field("user_name", &self.user_name)
            .field("peer", &self.peer)
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Broker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Broker").field("address", &self.address()).finish_non_exhaustive()
    }
}
