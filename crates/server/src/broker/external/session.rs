//! One session at an external broker, and the only module of the server that names rumqttc. It
//! subscribes and receives its own message once, which proves that the broker passes messages on.
//! Then it receives robots' messages and publishes the outbox.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::atomic::Ordering;
use std::time::Duration;

use rumqttc::{
    AsyncClient, ConnectReturnCode, ConnectionError, Event, MqttOptions, Outgoing, Packet, Publish,
    QoS, SubscribeFilter, Transport,
};
use task_proto::RobotId;
use task_proto::error_chain::chain;
use task_proto::messages::report::Status;
use task_proto::messages::topic::{RobotTopic, Topic};
use task_transport::{Relay, RelayError};
use tokio::sync::{OwnedSemaphorePermit, mpsc, watch};
use tokio::time::Instant;

use super::super::{Health, MAX_PART_BYTES, PartQos, RobotMessage};
use super::online_robots::PresenceChange;
use super::outbox::OutgoingMessage;
use super::{BrokerEndpoint, CANARY_LEVEL, External, lock};
use crate::domain::broker_url::BrokerUrl;

const KEEP_ALIVE: Duration = Duration::from_secs(20);
/// Time limit for connecting, and for flushing.
const NETWORK_TIMEOUT: Duration = Duration::from_secs(10);
/// Time limit for the server's own message to come back.
const CANARY_PATIENCE: Duration = Duration::from_secs(10);
/// Time limit for the DISCONNECT.
const GOODBYE_PATIENCE: Duration = Duration::from_secs(1);
/// Maximum unacknowledged messages of the server.
const MAX_IN_FLIGHT: u16 = 256;
/// Requests between this task and rumqttc, and events the other way.
const QUEUED: usize = 64;
/// Maximum size of a received message. A larger one ends the session, so the broker should refuse
/// it earlier: see docs/broker.md.
const MAX_RECEIVED_BYTES: usize = 4 * 1024 * 1024;
/// Maximum size of a sent message: a part and its overhead.
const MAX_SENT_BYTES: usize = MAX_PART_BYTES + 1024;
/// Maximum size of a status.
const MAX_STATUS_BYTES: usize = 4 * 1024;
/// Robots' topics other than reports.
const RECEIVED_TOPICS: [RobotTopic; 4] =
    [RobotTopic::Status, RobotTopic::Reply, RobotTopic::Log, RobotTopic::Telemetry];
/// Maximum size of MQTT's fixed header plus the packet id.
const HEADER_BYTES: usize = 7;

/// The reason why a session ended.
pub(super) enum SessionEnd {
    /// The broker refused the server's CONNECT.
    Refused(ConnectReturnCode),
    /// The TLS connection failed.
    Unreachable(RelayError),
    /// The server's own message did not come back.
    NoEcho,
    Lost(ConnectionError),
}

impl SessionEnd {
    pub(super) fn is_refusal(&self) -> bool {
        matches!(self, Self::Refused(_))
    }

    /// Text for the operator: the error and the place to fix it.
    pub(super) fn text(&self, url: &BrokerUrl) -> String {
        let broker = format!("the broker at {}", url.address());
        match self {
            Self::Refused(
                ConnectReturnCode::BadUserNamePassword | ConnectReturnCode::NotAuthorized,
            ) => {
                format!(
                    "{broker} does not accept the user {} with the password in `broker`",
                    url.user_name
                )
            }
            Self::Refused(code) => format!("{broker} refuses the server: {code:?}"),
            Self::Unreachable(error) => {
                format!("{broker} can't be reached: {}", chain(error))
            }
            Self::NoEcho => {
                format!(
                    "{broker} does not forward the messages of the server: it needs the ACL of `taskd broker acl`"
                )
            }
            Self::Lost(ConnectionError::Io(error)) => format!("{broker} can't be reached: {error}"),
            Self::Lost(ConnectionError::NetworkTimeout) => format!("{broker} does not answer"),
            Self::Lost(error) => format!("the session at {broker} ended: {error}"),
        }
    }
}

/// Runs one session to its end; `None`: the server stops.
pub(super) async fn run(
    external: &External,
    endpoint: &BrokerEndpoint,
    health: &watch::Sender<Health>,
) -> Option<SessionEnd> {
    let relay = tokio::select! {
        relay = Relay::open(&endpoint.route, NETWORK_TIMEOUT) => relay,
        () = external.stop.cancelled() => return None,
    };
    let relay = match relay {
        Ok(relay) => relay,
        Err(error) => return Some(SessionEnd::Unreachable(error)),
    };
    let (client, mut event_loop) = AsyncClient::new(options(external, endpoint, &relay), QUEUED);
    event_loop.network_options.set_connection_timeout(NETWORK_TIMEOUT.as_secs());
    let (events_in, mut events) = mpsc::channel(QUEUED);
    // rumqttc's poll must not be dropped half way, so one future runs it for as long as the session
    // lives.
    let pump = async {
        loop {
            match event_loop.poll().await {
                // The receiver lives as long as this future.
                Ok(event) => drop(events_in.send(event).await),
                Err(ConnectionError::ConnectionRefused(code)) => return SessionEnd::Refused(code),
                Err(error) => return SessionEnd::Lost(error),
            }
        }
    };
    let relaying = relay.run();
    tokio::pin!(pump, relaying);
    let mut session = Session::new(external, endpoint, client);
    let deadline = Instant::now() + NETWORK_TIMEOUT + CANARY_PATIENCE;
    let ended = loop {
        tokio::select! {
            // Cancel-safe: the future is pinned outside of the loop and continues in the next
            // iteration.
            ended = &mut pump => break Some(ended),
            // Cancel-safe: the future is pinned outside of the loop. It does not end before the
            // session does.
            () = &mut relaying => {}
            // Cancel-safe: an event stays in the channel until received.
            Some(event) = events.recv() => {
                if session.take(event).await {
                    health.send_replace(Health::Serving);
                }
            }
            // Cancel-safe: a permit that was not taken stays.
            () = external.filled.notified() => {}
            // Cancel-safe: the timer is recreated with the same deadline.
            () = tokio::time::sleep_until(deadline), if !session.is_up => break Some(SessionEnd::NoEcho),
            // Cancel-safe: a token can be awaited again.
            () = external.stop.cancelled() => break None,
        }
        session.publish_waiting();
    };
    if ended.is_none() && session.client.try_disconnect().is_ok() {
        // The pump ends by itself once the broker has closed the connection.
        let goodbye =
            async { tokio::join!(&mut pump, async { while events.recv().await.is_some() {} }) };
        let goodbye = async {
            tokio::select! {
                _ = goodbye => {}
                () = &mut relaying => {}
            }
        };
        let _ = tokio::time::timeout(GOODBYE_PATIENCE, goodbye).await;
    }
    ended
}

fn options(external: &External, endpoint: &BrokerEndpoint, relay: &Relay) -> MqttOptions {
    let url = &endpoint.url;
    let mut options = MqttOptions::new(&external.config.client_id, relay.name(), url.port);
    options.set_transport(Transport::Unix);
    options.set_credentials(&url.user_name, &url.password);
    options.set_clean_session(true);
    options.set_keep_alive(KEEP_ALIVE);
    options.set_inflight(MAX_IN_FLIGHT);
    options.set_max_packet_size(MAX_RECEIVED_BYTES, MAX_SENT_BYTES);
    options
}

struct Session<'a> {
    external: &'a External,
    endpoint: &'a BrokerEndpoint,
    client: AsyncClient,
    canary: String,
    is_up: bool,
    /// The permits of messages that were handed to rumqttc and have no packet id yet.
    unsent: VecDeque<Option<OwnedSemaphorePermit>>,
    /// The permits of messages sent under this packet id.
    sent: VecDeque<(u16, Option<OwnedSemaphorePermit>)>,
}

impl<'a> Session<'a> {
    fn new(external: &'a External, endpoint: &'a BrokerEndpoint, client: AsyncClient) -> Self {
        let canary = format!("{}/{CANARY_LEVEL}", external.config.prefix);
        Self {
            external,
            endpoint,
            client,
            canary,
            is_up: false,
            unsent: VecDeque::new(),
            sent: VecDeque::new(),
        }
    }

    /// Handles an event; returns whether the session has come up through it.
    async fn take(&mut self, event: Event) -> bool {
        self.count(&event);
        match event {
            Event::Incoming(Packet::ConnAck(_)) => self.begin(),
            Event::Incoming(Packet::Publish(message)) if message.topic == self.canary => {
                return self.mark_up();
            }
            Event::Incoming(Packet::Publish(message)) => self.receive(message).await,
            Event::Incoming(Packet::PubAck(ack)) => self.acknowledged(ack.pkid),
            Event::Incoming(Packet::PubComp(complete)) => self.acknowledged(complete.pkid),
            Event::Outgoing(Outgoing::Publish(id)) => {
                // Without a packet id there is no acknowledgement: the permit is free at once.
                if let Some(permit) = self.unsent.pop_front().filter(|_| id != 0) {
                    self.sent.push_back((id, permit));
                }
            }
            _ => {}
        }
        false
    }

    fn acknowledged(&mut self, id: u16) {
        if let Some(at) = self.sent.iter().position(|(sent, _)| *sent == id) {
            self.sent.remove(at);
        }
    }

    fn begin(&mut self) {
        let prefix = &self.external.config.prefix;
        let filters = RECEIVED_TOPICS.map(|topic| format!("{prefix}/r/+/{}", topic.as_str()));
        let filters = filters.into_iter().chain([self.canary.clone()]);
        // The queue is empty at the start of a session, and a lost session is noticed by the pump.
        let _ = self
            .client
            .try_subscribe_many(filters.map(|path| SubscribeFilter::new(path, QoS::AtLeastOnce)));
        if self.client.try_publish(&self.canary, QoS::AtLeastOnce, false, "up").is_ok() {
            self.unsent.push_back(None);
        }
    }

    /// The server has received its own message. From here on robots are reachable, and a notice
    /// asks each robot to report its presence.
    fn mark_up(&mut self) -> bool {
        if self.is_up {
            return false;
        }
        self.is_up = true;
        self.external.config.current.store(self.endpoint.number, Ordering::Relaxed);
        tracing::info!(broker = %self.endpoint.url.address(), "connected to the MQTT broker");
        lock(&self.external.traffic).connections_accepted += 1;
        lock(&self.external.outbox).open();
        self.external.inbox.external_broker_connected();
        true
    }

    async fn receive(&mut self, message: Publish) {
        // We retain nothing: this message is old, and its sender is unknown.
        if message.retain {
            return;
        }
        let Some(Topic::Robot(robot, topic)) = self.external.config.prefix.parse(&message.topic)
        else {
            return;
        };
        if !RECEIVED_TOPICS.contains(&topic) {
            return;
        }
        let status = (topic == RobotTopic::Status && message.payload.len() <= MAX_STATUS_BYTES)
            .then(|| serde_json::from_slice::<Status>(&message.payload).ok());
        let change = {
            let mut online = lock(&self.external.online);
            match &status {
                Some(Some(status)) => online.status(&robot, status),
                // An unreadable message carries no information; the inbox reports the error.
                Some(None) => PresenceChange::default(),
                None => online.message(&robot),
            }
        };
        self.notify_inbox(&robot, &change);
        // The status that announced the end belongs to no connection.
        let connection = lock(&self.external.online).connection(&robot).unwrap_or_default();
        let message = RobotMessage {
            robot,
            topic,
            payload: message.payload,
            peer: None,
            connection,
            token_number: None,
        };
        // Messages on these topics are not stored, so this returns at once.
        let _ = self.external.inbox.receive(message).await;
    }

    fn notify_inbox(&self, robot: &RobotId, change: &PresenceChange) {
        const UNKNOWN: Option<SocketAddr> = None;
        if let Some(number) = change.ended {
            self.external.inbox.disconnected(robot, number);
        }
        if let Some(number) = change.begun {
            self.external.inbox.connected(robot, UNKNOWN, number, None);
        }
    }

    /// Hands over the waiting messages, as many as rumqttc can certainly accept at once.
    fn publish_waiting(&mut self) {
        while self.is_up && self.unsent.len() < QUEUED / 2 {
            let Some(message) = lock(&self.external.outbox).next() else { break };
            let OutgoingMessage { topic, payload, qos, permit } = message;
            let name = self.external.config.prefix.format(&topic);
            let bytes = HEADER_BYTES + name.len() + payload.len();
            let qos = match qos {
                PartQos::AtMostOnce => QoS::AtMostOnce,
                PartQos::AtLeastOnce => QoS::AtLeastOnce,
                PartQos::ExactlyOnce => QoS::ExactlyOnce,
            };
            if self.client.try_publish(name, qos, false, payload).is_ok() {
                lock(&self.external.traffic).all.bytes_out += bytes as u64;
                self.unsent.push_back(permit);
            }
            self.external.taken.notify_waiters();
        }
    }

    fn count(&self, event: &Event) {
        let mut traffic = lock(&self.external.traffic);
        let all = &mut traffic.all;
        match event {
            Event::Incoming(packet) => {
                all.packets_in += 1;
                all.bytes_in += packet.size() as u64;
                all.messages_in += u64::from(matches!(packet, Packet::Publish(_)));
                all.acks_in += u64::from(matches!(packet, Packet::PubAck(_)));
            }
            Event::Outgoing(packet) => {
                all.packets_out += 1;
                all.messages_out += u64::from(matches!(packet, Outgoing::Publish(_)));
                all.acks_out += u64::from(matches!(packet, Outgoing::PubAck(_)));
            }
        }
    }
}
