//! The MQTT broker as the rest of the server sees it: ring a robot, receive what robots send, know who is there.
//! It asks a [`Gatekeeper`] who may come in and hands messages to an [`Inbox`]; it never stores anything and knows no
//! payloads. An external broker would be another start function that returns the same [`Broker`].

mod fan_out;
mod front;
mod router;
mod watchdog;

use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use task_proto::api::{MqttTraffic, Traffic};
use task_proto::topic::{RobotTopic, TopicPrefix};
use task_proto::{Digest, RobotId};
use tokio::sync::watch;

pub use fan_out::{FanOut, FanOutError, FanOutSettings, MAX_PART_BYTES, Part, PartQos};
use front::Front;
use router::Router;

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
    },
    /// A person or program with an operator's token: may listen below the prefix.
    Operator,
}

/// Why a client is not let in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// No such user, or the wrong password (CONNACK 4).
    #[error("bad user name or password")]
    BadCredentials,
    /// Known, but not allowed: a revoked token, another robot's name (CONNACK 5).
    #[error("not authorised")]
    NotAuthorised,
    /// Nobody could say just now (CONNACK 3).
    #[error("the server cannot check credentials at the moment")]
    Unavailable,
}

/// Decides who may come in.
pub trait Gatekeeper: Send + Sync + 'static {
    /// Who this is, or why they may not enter. Given up on after [`Limits::admit_timeout`], which counts as
    /// [`Refusal::Unavailable`].
    fn admit(&self, login: Login) -> BoxFuture<'_, Result<Principal, Refusal>>;
}

/// A message from a robot on its `report`, `status`, `reply` or `log` topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotMessage {
    /// Who sent it; proven by the connection.
    pub robot: RobotId,
    /// Which of these topics.
    pub topic: RobotTopic,
    /// The bytes, unread.
    pub payload: Bytes,
    /// The peer's address.
    pub peer: SocketAddr,
    /// The connection it came by, as in [`Inbox::connected`].
    pub connection: u64,
    /// The token the connection was let in by, as in [`Principal::Robot`].
    pub token_number: u64,
}

/// The message could not be stored; the robot keeps it and sends it again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the message was not stored")]
pub struct NotStored;

/// Receives what robots send.
pub trait Inbox: Send + Sync + 'static {
    /// A message arrived. The robot gets its acknowledgement once this resolves to `Ok`; on `Err`, or after
    /// [`Limits::inbox_timeout`], its connection is closed instead, so that it sends again. A message whose content is
    /// nonsense must resolve to `Ok`, or the robot would send it for ever. May be dropped half-way.
    fn receive(&self, message: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>>;

    /// A robot's session is live: [`Broker::ring`] reaches it from now on, so this is the moment to send its state.
    /// `connection` grows with every connection of this process. Any earlier session of this robot has fully ended.
    fn connected(&self, robot: &RobotId, peer: SocketAddr, connection: u64);

    /// The robot's session with this number has ended. Comes exactly once for each `connected`, after it.
    fn disconnected(&self, robot: &RobotId, connection: u64);
}

/// Where the broker listens and what bounds it.
#[derive(Debug, Clone)]
pub struct BrokerConfig {
    /// The plain TCP listener's address; port 0 picks a free one.
    pub listen: SocketAddr,
    /// What all topics start with.
    pub prefix: TopicPrefix,
    /// The bounds.
    pub limits: Limits,
}

/// Bounds on everything a client may take up.
#[derive(Debug, Clone)]
pub struct Limits {
    /// Connections at a time, those not yet admitted included.
    pub max_connections: usize,
    /// Those of one address that have not sent CONNECT yet; a further one takes the place of the oldest.
    pub max_silent_per_address: usize,
    /// Operators among them.
    pub max_operators: usize,
    /// The largest packet of an admitted client, in bytes after the fixed header.
    pub max_packet_bytes: usize,
    /// Filters in one SUBSCRIBE or UNSUBSCRIBE, and subscriptions of one client.
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
            max_packet_bytes: 256 * 1024,
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
    front: Arc<Front>,
    health: watch::Receiver<Health>,
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
        Ok(Self { front, health })
    }

    /// Sends `payload` on the robot's `desired` topic, QoS 1, straight into its session. Never waits: a session holds
    /// one undelivered payload, and a newer one takes its place, also before the robot has subscribed.
    pub fn ring(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotConnected> {
        self.front.ring(robot, payload)
    }

    /// Sends `payload` on the robot's `request` topic, QoS 1, straight into its session. Never waits; questions that the
    /// session has not taken when it ends are lost.
    pub fn ask(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotAsked> {
        self.front.ask(robot, payload)
    }

    /// Lets `robots` subscribe to `p/<digest>`, to hear the parts that are published from then on, until the [`FanOut`]
    /// is dropped. Few packages at a time.
    pub fn fan_out(
        &self,
        digest: Digest,
        settings: FanOutSettings,
        robots: Vec<RobotId>,
    ) -> Result<FanOut, FanOutError> {
        FanOut::begin(self.front.clone(), digest, settings, robots)
    }

    /// The bytes of packages' parts that are held for listeners: the front's backlog.
    pub fn queued_part_bytes(&self) -> usize {
        self.front.grants().queued_bytes()
    }

    /// Ends the robot's session, if it has one: its token was revoked or it was removed.
    pub fn disconnect(&self, robot: &RobotId) {
        self.front.disconnect(robot);
    }

    /// What went over MQTT so far.
    pub fn traffic(&self) -> MqttTraffic {
        self.front.traffic()
    }

    /// What went over the robot's connection, if it has one.
    pub fn traffic_of(&self, robot: &RobotId) -> Option<Traffic> {
        self.front.traffic_of(robot)
    }

    /// How many robots are connected.
    pub fn connected_count(&self) -> usize {
        self.front.connected_count()
    }

    /// The listener's address as bound.
    pub fn local_addr(&self) -> SocketAddr {
        self.front.local_addr()
    }

    /// How the broker is, now and from now on.
    pub fn health(&self) -> watch::Receiver<Health> {
        self.health.clone()
    }

    /// Stops accepting, ends every session and waits until all have ended, at most for `patience`.
    pub async fn shutdown(&self, patience: Duration) {
        self.front.shutdown(patience).await;
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
        f.debug_struct("Broker").field("local_addr", &self.local_addr()).finish_non_exhaustive()
    }
}
