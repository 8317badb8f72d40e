//! Owns the MQTT broker as the rest of the server sees it; it never stores anything and never reads
//! a payload.
//!
//! The broker notifies robots, receives their messages and knows which robots are connected. A
//! [`Gatekeeper`] decides which clients are admitted, and an [`Inbox`] receives the messages.
//! [`Broker::start`] serves MQTT in this process; [`Broker::connect`] makes the server a client of
//! another broker. The handle hides the difference from the rest of the server.

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
use task_proto::messages::report::MAX_REPORT_BYTES;
use task_proto::messages::topic::{RobotTopic, TopicPrefix};
use task_proto::{Digest, RobotId, UserName};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;

use crate::domain::limits::robot_limiter::RobotLimiter;
use crate::net::proxy_protocol::ProxyProtocol;
use crate::net::tls::{ClientProof, Tls};
pub use external::{CANARY_LEVEL, ExternalConfig, external_route};
use external::{External, ExternalFanOut};
pub use fan_out::{FanOut, FanOutError, FanOutSettings, MAX_PART_BYTES, Part, PartQos};
use front::Front;
/// The decoder of clients' bytes; public so that fuzzers can call it with arbitrary input.
pub use front::codec;
use router::Router;

/// Bytes of a packet besides the message: the topic and the packet id.
const AROUND_MESSAGE_BYTES: usize = 1024;

/// Credentials that a client presents in CONNECT.
#[derive(Clone)]
pub struct Login {
    /// The MQTT client id; empty if the client left the choice to us.
    pub client_id: String,
    /// The user name, if there is one.
    pub user_name: Option<String>,
    /// The password, if there is one: a token.
    pub password: Option<String>,
    /// The remote address of the connection.
    pub peer: SocketAddr,
    /// Proof from the TLS handshake.
    pub proof: ClientProof,
}

/// The identity of an admitted client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Principal {
    /// A robot: publishes and subscribes on its own topics only. Its client id must be its robot
    /// id.
    Robot {
        robot: RobotId,
        /// The number of the token that was presented; it is attached to the robot's messages.
        token_number: u64,
        /// Whether this login has just ended the robot's other tokens: sessions admitted by those
        /// tokens must be closed.
        is_first_use: bool,
    },
    /// A person, or a program with a person's token: may subscribe below the prefix.
    Operator(UserName),
}

/// The reason for refusing a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// No such user, or the wrong password (CONNACK 4).
    #[error("bad user name or password")]
    BadCredentials,
    /// Known, but not allowed: a revoked token, or another robot's name as user name (CONNACK 5).
    #[error("not authorised")]
    NotAuthorised,
    /// The decision could not be made now (CONNACK 3).
    #[error("the server cannot check credentials at the moment")]
    Unavailable,
}

/// Decides which clients are admitted.
pub trait Gatekeeper: Send + Sync + 'static {
    /// Returns the client's identity, or the reason for refusing. After [`Limits::admit_timeout`]
    /// the client receives [`Refusal::Unavailable`]; the lookup itself still runs to its end.
    fn admit(&self, login: Login) -> BoxFuture<'_, Result<Principal, Refusal>>;
}

/// A message from a robot on its `report`, `status`, `reply` or `log` topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotMessage {
    /// The sender. The embedded broker proves the sender by the connection; an external broker only
    /// as far as its access control list does.
    pub robot: RobotId,
    pub topic: RobotTopic,
    /// The bytes, not decoded.
    pub payload: Bytes,
    /// The peer's address; unknown with an external broker.
    pub peer: Option<SocketAddr>,
    /// The connection that delivered the message, as in [`Inbox::connected`].
    pub connection: u64,
    /// The token that admitted the connection, as in [`Principal::Robot`]. An external broker never
    /// sees a token, so its messages can't speak for a token, and no report arrives through it.
    pub token_number: Option<u64>,
}

/// The message could not be stored; the robot keeps the message and sends it again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the message was not stored")]
pub struct NotStored;

/// Receives messages from robots.
pub trait Inbox: Send + Sync + 'static {
    /// Handles a message. The robot gets its acknowledgement once this resolves to `Ok`; on `Err`,
    /// or after [`Limits::inbox_timeout`], the connection is closed instead, so that the robot
    /// sends again. A message with invalid content must resolve to `Ok`, or the robot would send it
    /// for ever. The future may be dropped half-way.
    fn receive(&self, message: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>>;

    /// A robot's session is live: [`Broker::send_desired`] reaches the robot from now on, so this
    /// is the moment to send its state. `connection` grows with every connection of this process.
    /// Any earlier session of this robot has fully ended. `token_number` is that of the token that
    /// admitted it. With an external broker, peer and token are unknown.
    fn connected(
        &self,
        robot: &RobotId,
        peer: Option<SocketAddr>,
        connection: u64,
        token_number: Option<u64>,
    );

    /// The robot's session with this number has ended. Called exactly once for each `connected`,
    /// after that call.
    fn disconnected(&self, robot: &RobotId, connection: u64);

    /// The external broker is reachable again, and any robot may already be connected there. Call
    /// [`Broker::send_desired`] for each robot, so that connected robots get their state and report
    /// their presence.
    fn external_broker_connected(&self);
}

/// The broker's listener and bounds.
#[derive(Debug, Clone)]
pub struct BrokerConfig {
    /// The listener's address; port 0 picks a free one.
    pub listen: SocketAddr,
    /// The TLS configuration, if the listener encrypts.
    pub tls: Option<Tls>,
    /// The balancers, which begin each connection with the address of its client.
    pub proxy_protocol: ProxyProtocol,
    /// The prefix of all topics.
    pub prefix: TopicPrefix,
    pub limits: Limits,
    pub robot_limiter: Arc<RobotLimiter>,
}

/// Bounds on every resource that a client can use.
#[derive(Debug, Clone)]
pub struct Limits {
    /// Maximum concurrent connections, including those not yet admitted.
    pub max_connections: usize,
    /// Maximum connections of one address that have not sent CONNECT yet. At the limit, the oldest
    /// is closed to admit a new one.
    pub max_silent_per_address: usize,
    /// Maximum operators among the connections.
    pub max_operators: usize,
    /// Maximum sessions of one person among the operators.
    pub max_sessions_per_person: usize,
    /// The largest packet of an admitted client, in bytes after the fixed header.
    pub max_packet_bytes: usize,
    /// Maximum filters that are read from one SUBSCRIBE, and maximum subscriptions of one client.
    pub max_filters: usize,
    /// Time limit of a proxy's header, and from then, or from accepting a connection, until CONNECT
    /// is complete.
    pub connect_timeout: Duration,
    /// Time limit of the gatekeeper's decision.
    pub admit_timeout: Duration,
    /// Time limit of the inbox for storing a message.
    pub inbox_timeout: Duration,
    /// Time limit for a client to read the bytes that we send.
    pub write_timeout: Duration,
    /// Silence after which a client without a keepalive counts as gone.
    pub max_silence: Duration,
    /// Interval at which the watchdog sends its canary through the listener.
    pub canary_interval: Duration,
    /// Time limit of each half of the canary's path: to be admitted, and to receive its own
    /// message.
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

/// The broker's health. On [`Health::Failed`] the server should report the failure and end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Health {
    Serving,
    /// The canary did not arrive, and a remedy is under way; contains the observation.
    Recovering(String),
    /// The remedies are used up; contains the last observation.
    Failed(String),
}

/// The reason why the broker did not start.
#[derive(Debug, thiserror::Error)]
pub enum BrokerError {
    /// The address is in use, or does not belong to this machine.
    #[error("cannot listen for MQTT on {address}")]
    Listen {
        address: SocketAddr,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The router thread did not come up.
    #[error("the message router did not start: {reason}")]
    Router { reason: String },
}

/// The robot has no live session here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the robot is not connected over MQTT")]
pub struct NotConnected;

/// The reason why a request was not sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NotSent {
    /// The robot has no live session here.
    #[error("the robot is not connected over MQTT")]
    NotConnected,
    /// Too many requests are already queued for the robot.
    #[error("too many requests are already queued for the robot")]
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

    /// Becomes a client of another broker, now or as soon as the broker is reachable. The health is
    /// never [`Health::Failed`], because the connection recovers by itself.
    pub fn connect(config: ExternalConfig, inbox: Arc<dyn Inbox>) -> Self {
        let (external, health) = External::start(config, inbox);
        Self { kind: Kind::External(external), health }
    }

    /// Sends `payload` on the robot's `desired` topic, QoS 1. Never waits. One undelivered payload
    /// is held for each robot, and a newer one replaces the held one, also before the robot has
    /// subscribed.
    pub fn send_desired(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotConnected> {
        match &self.kind {
            Kind::Embedded(front) => front.send_desired(robot, payload),
            Kind::External(external) => external.send_desired(robot, payload),
        }
    }

    /// Whether [`Broker::send_desired`] may reach the robot. An external broker does not tell us
    /// its subscribers, so every robot counts as reachable.
    pub fn may_reach(&self, robot: &RobotId) -> bool {
        match &self.kind {
            Kind::Embedded(front) => front.has_session(robot),
            Kind::External(external) => external.is_up(),
        }
    }

    /// Whether robots receive all messages from a broker that is not the server's own.
    pub fn is_external(&self) -> bool {
        matches!(self.kind, Kind::External(_))
    }

    /// Waits until there is room for many more notifications.
    pub async fn room(&self) {
        match &self.kind {
            // Each session holds its own payload, so there is always room.
            Kind::Embedded(_) => {}
            Kind::External(external) => external.room().await,
        }
    }

    /// Sends `payload` on the robot's `request` topic, QoS 1. Never waits; requests still queued
    /// when the session ends are lost.
    pub fn send_request(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotSent> {
        match &self.kind {
            Kind::Embedded(front) => front.send_request(robot, payload),
            Kind::External(external) => external.send_request(robot, payload),
        }
    }

    /// Lets `robots` subscribe to `p/<digest>` until the [`FanOut`] is dropped. They receive the
    /// parts that are published from then on. Only a few packages can be open at a time. At an
    /// external broker every robot may subscribe at any time.
    pub fn fan_out(
        &self,
        digest: Digest,
        settings: FanOutSettings,
        robots: Vec<RobotId>,
    ) -> Result<FanOut, FanOutError> {
        match &self.kind {
            Kind::Embedded(front) => FanOut::embedded(front.clone(), digest, settings, robots),
            Kind::External(external) => {
                Ok(FanOut::external(ExternalFanOut::new(external.clone(), digest, settings.qos)))
            }
        }
    }

    /// The bytes of packages' parts that are held for subscribers: the front's backlog. For an
    /// external broker, the parts in flight are bounded by its window.
    pub fn queued_part_bytes(&self) -> usize {
        match &self.kind {
            Kind::Embedded(front) => front.grants().queued_bytes(),
            Kind::External(external) => external.queued_part_bytes(),
        }
    }

    /// Ends the robot's session, if any: its token was revoked, or the robot was removed. At an
    /// external broker we cannot close sessions; the robot only counts as gone.
    pub fn disconnect(&self, robot: &RobotId) {
        match &self.kind {
            Kind::Embedded(front) => front.disconnect(robot),
            Kind::External(external) => external.disconnect(robot),
        }
    }

    /// Ends the robot's session unless the token `kept` has admitted it: the robot has used that
    /// token for the first time, at another server.
    pub fn disconnect_other_tokens(&self, robot: &RobotId, kept: u64) {
        match &self.kind {
            Kind::Embedded(front) => front.disconnect_other_tokens(robot, kept),
            Kind::External(_) => {}
        }
    }

    /// Ends the robot's session with this number: the robot has a newer one at another server.
    pub fn disconnect_session(&self, robot: &RobotId, connection: u64) {
        match &self.kind {
            Kind::Embedded(front) => front.disconnect_session(robot, connection),
            Kind::External(_) => {}
        }
    }

    /// Serves a client on a connection that another listener has accepted, once `handshake` ends.
    /// Returns false if the broker is external or has no room.
    pub fn serve_connection<S>(
        &self,
        peer: SocketAddr,
        handshake: impl Future<Output = io::Result<(S, ClientProof)>> + Send + 'static,
    ) -> bool
    where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        match &self.kind {
            Kind::Embedded(front) => front.serve_connection(peer, handshake),
            Kind::External(_) => false,
        }
    }

    /// Ends the person's sessions: the person's rights have changed, or one of the person's tokens
    /// has ended.
    pub fn disconnect_person(&self, user: &UserName) {
        match &self.kind {
            Kind::Embedded(front) => front.disconnect_person(user),
            // An external broker does not tell us its sessions.
            Kind::External(_) => {}
        }
    }

    /// Ends all people's sessions, because some person's rights may have ended. Clients reconnect.
    pub fn disconnect_people(&self) {
        match &self.kind {
            Kind::Embedded(front) => front.disconnect_people(),
            Kind::External(_) => {}
        }
    }

    /// MQTT traffic so far; with an external broker, only that of our own connection.
    pub fn traffic(&self) -> MqttTraffic {
        match &self.kind {
            Kind::Embedded(front) => front.traffic(),
            Kind::External(external) => external.traffic(),
        }
    }

    /// Traffic of the robot's connection, if the robot is connected to the embedded broker.
    pub fn traffic_of(&self, robot: &RobotId) -> Option<Traffic> {
        match &self.kind {
            Kind::Embedded(front) => front.traffic_of(robot),
            Kind::External(_) => None,
        }
    }

    /// The subscriptions of the robot's session, sorted by filter, if the robot is connected to the
    /// embedded broker.
    pub fn subscriptions_of(&self, robot: &RobotId) -> Vec<Subscription> {
        match &self.kind {
            Kind::Embedded(front) => front.subscriptions_of(robot),
            Kind::External(_) => Vec::new(),
        }
    }

    /// The number of connected robots.
    pub fn connected_count(&self) -> usize {
        match &self.kind {
            Kind::Embedded(front) => front.connected_count(),
            Kind::External(external) => external.connected_count(),
        }
    }

    /// The listener's address as bound; `None` with an external broker.
    pub fn local_addr(&self) -> Option<SocketAddr> {
        match &self.kind {
            Kind::Embedded(front) => Some(front.local_addr()),
            Kind::External(_) => None,
        }
    }

    /// The broker's `host:port`; of several external brokers, the one that the server was connected
    /// to last.
    pub fn address(&self) -> String {
        match &self.kind {
            Kind::Embedded(front) => front.local_addr().to_string(),
            Kind::External(external) => external.address(),
        }
    }

    /// The broker's health, now and from now on.
    pub fn health(&self) -> watch::Receiver<Health> {
        self.health.clone()
    }

    /// Ends the robots' sessions one after the other within `time`, so that not all reconnect at
    /// once. Sessions at an external broker are not ours to end.
    pub async fn drain(&self, time: Duration) {
        match &self.kind {
            Kind::Embedded(front) => front.drain(time).await,
            Kind::External(_) => {}
        }
    }

    /// Stops accepting, ends every session of the embedded broker and waits until all have ended,
    /// at most for `patience`.
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
