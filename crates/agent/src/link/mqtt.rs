//! The MQTT half of the link, and the only module that names rumqttc. It keeps one session after
//! another, each with a last will. Incoming: the notice, requests and package parts. Outgoing:
//! status, the newest report, responses and log lines. The PUBACK of a report confirms it, because
//! the server sends the PUBACK once the report is stored. An external broker gets no reports. This
//! module never decides how to react to the received messages.
//!
//! Messages are acknowledged manually: a part after its write, all others at once. At most one part
//! is held here while its receiver is busy; until the receiver takes the part, the session reads
//! nothing more.

mod destination;
mod message_limit;
mod routes;
mod subscriptions;

use std::collections::VecDeque;
use std::time::Duration;

use rumqttc::{
    AsyncClient, ConnectReturnCode, ConnectionError, Event, EventLoop, LastWill, MqttOptions,
    Outgoing, Packet, Publish, QoS, StateError, Transport,
};
use task_proto::RobotId;
use task_proto::api::ExternalBroker;
use task_proto::desired::{DesiredNotice, MAX_DESIRED_NOTICE_BYTES};
use task_proto::error_chain::chain;
use task_proto::messages::report::{MAX_REPORT_BYTES, Status};
use task_proto::messages::request::Request;
use task_proto::messages::topic::{RobotTopic, Topic, TopicPrefix};
use task_transport::{Relay, RelayError, Route};
use tokio::sync::mpsc;
use tokio::time::Instant;

use self::destination::{Destination, await_other_place, first_place_changed, place_count};
use self::message_limit::MessageLimit;
pub use self::routes::Routes;
use self::subscriptions::Subscriptions;
use crate::link::state::{LinkState, Message, MqttChannels, MqttState, ServerMessage};
use crate::task::timing::backoff_ms;
use crate::transfer::credential::Credential;
use crate::transfer::parts::{Acknowledgement, PendingAck, ReceivedPart};

/// MQTT keep-alive: how often an idle robot contacts the broker.
const KEEP_ALIVE: Duration = Duration::from_secs(20);
/// Timeout for opening a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// Longest wait between two connection attempts.
const MAX_BACKOFF_MS: u64 = 60 * 1000;
/// Longest wait after the broker refused this robot.
const MAX_REFUSED_BACKOFF_MS: u64 = 5 * 60 * 1000;
/// Shortest wait after a refusal; up to half of this is added at random.
const MIN_REFUSED_BACKOFF_MS: u64 = 10 * 1000;
/// A session that lasted this long proves the route good and resets the backoff.
const GOOD_SESSION: Duration = Duration::from_secs(60);
/// Capacity of the queue of requests from this task to rumqttc.
const QUEUED_REQUESTS: usize = 16;
/// Capacity of the queue of received events that are not yet handled.
const QUEUED_EVENTS: usize = 2;
/// Capacity of the queue of acknowledgements that are due. Brokers have fewer messages in flight.
const QUEUED_ACKNOWLEDGEMENTS: usize = 1024;
/// Largest packet that we send: the largest report.
const MAX_SENT_BYTES: usize = MAX_REPORT_BYTES + AROUND_MESSAGE_BYTES;
/// Largest message that we read, unless the server sends whole packages as one message: a part of 1
/// MiB.
pub const MESSAGE_BYTES: usize = 1024 * 1024 + AROUND_MESSAGE_BYTES;
/// Largest message that MQTT allows.
const MAX_MESSAGE_BYTES: u64 = 256 * 1024 * 1024 - 1;
/// Overhead of a message: topic, packet id, a part's header.
const AROUND_MESSAGE_BYTES: usize = 4096;

/// Address and credentials of the default connection, unless [`LinkState::endpoint`] names another.
#[derive(Clone)]
pub struct MqttAccess {
    /// Host name or address, also for an endpoint without one.
    pub host: String,
    pub port: u16,
    /// Prefix of all topics.
    pub prefix: TopicPrefix,
    /// User name, and the client id unless the endpoint names another.
    pub robot: RobotId,
    /// Password at the server's own broker.
    pub token: Credential,
    /// Fields of every status. `connection` counts up from the value here.
    pub status: Status,
    /// Initial limit on the size of a message that we read, [`MESSAGE_BYTES`]. Only a wanted
    /// package raises the limit.
    pub message_bytes: usize,
    /// Routes to the broker.
    pub routes: Routes,
}

/// Reasons for the end of a session.
enum SessionEnd {
    /// The broker refuses this robot.
    Refused,
    /// A part of a wanted package exceeds this session's message limit.
    MessageLimitExceeded,
    /// The server names another broker for the session.
    Moved,
    /// The connection to the broker can't be opened.
    Unreachable(RelayError),
    Lost(ConnectionError),
    /// The agent is shutting down.
    Closed,
}

/// Keeps a session up until the agent ends. After each session it waits with full jitter.
pub async fn run(
    mut access: MqttAccess,
    link_state: LinkState,
    server_messages: mpsc::Sender<ServerMessage>,
    mut channels: MqttChannels,
) {
    let mut failures = 0u32;
    // Whether the server has sent a package as a message above the usual limit.
    let mut sends_large = false;
    let mut endpoint = link_state.endpoint.subscribe();
    let (mut known_endpoint, mut place) = (None, 0);
    // Number of attempts to return to the server's place since the last good session there.
    let mut returns = 0u32;
    loop {
        access.status.connection += 1;
        let begun = Instant::now();
        let message_limit = MessageLimit::of(&access, &link_state, sends_large);
        let newest = endpoint.borrow_and_update().clone();
        if newest != known_endpoint {
            (known_endpoint, place, returns) = (newest, 0, 0);
        }
        let there = access.destination(known_endpoint.as_ref(), place);
        let places = place_count(known_endpoint.as_ref());
        let (at, external) = (access.at(&there), there.external.as_ref());
        let route = access.routes.next(&there.host, there.port, there.is_encrypted, external);
        let session = session(
            &at,
            external,
            route,
            &link_state,
            &server_messages,
            &mut channels,
            message_limit,
        );
        let ended = tokio::select! {
            // Cancel-safe: no later code uses the future. The broker sees the end of the session.
            ended = session => ended,
            () = first_place_changed(&mut endpoint, &access, &there) => SessionEnd::Moved,
            // Cancel-safe: the future only asks questions, and its counter lives outside of the
            // future.
            () = server_moved(&access, &link_state, &there, &mut returns), if places > 1 => SessionEnd::Moved,
        };
        let was_up = link_state.mqtt.send_replace(MqttState::Down).is_up();
        if !was_up {
            link_state.refresh_endpoint.notify_one();
            place = (place + 1) % places;
            if matches!(ended, SessionEnd::Lost(_) | SessionEnd::Unreachable(_)) {
                access.routes.switch();
            }
        }
        // Tasks that wait for parts need not give up if the next session begins at once.
        link_state
            .part_subscriptions
            .set_session_up(matches!(ended, SessionEnd::MessageLimitExceeded));
        let was_good = begun.elapsed() >= GOOD_SESSION;
        if was_good && place == 0 {
            returns = 0;
        }
        failures = if was_good { 1 } else { failures.saturating_add(1) };
        let (min_ms, max_ms) = match ended {
            SessionEnd::Closed => return,
            SessionEnd::MessageLimitExceeded => {
                sends_large = true;
                continue;
            }
            SessionEnd::Moved => {
                access.routes.reset();
                (failures, place) = (0, 0);
                continue;
            }
            failure => report_failure(&failure, &link_state, was_up),
        };
        // The wait grows with each full round of all places.
        let rounds = failures.div_ceil(places as u32);
        let wait = Duration::from_millis(backoff_ms(rounds, max_ms, rand::random()).max(min_ms));
        tokio::select! {
            // Cancel-safe: the timer is recreated on each iteration.
            () = tokio::time::sleep(wait) => {}
            // Cancel-safe: a watch remembers a change.
            Ok(()) = endpoint.changed() => failures = 0,
            // Cancel-safe: a token can be awaited again.
            () = link_state.shutdown.cancelled() => return,
        }
    }
}

/// Logs a session that ended in a failure. Returns the bounds of the wait for the next one: at least,
/// at most, in milliseconds.
fn report_failure(failure: &SessionEnd, link_state: &LinkState, was_up: bool) -> (u64, u64) {
    match failure {
        SessionEnd::Refused => {
            tracing::warn!("the MQTT broker refuses this robot");
            // The server's own answer over HTTP tells whether the robot was removed.
            link_state.poll.notify_one();
            let spread_ms = rand::random_range(0..=MIN_REFUSED_BACKOFF_MS / 2);
            return (MIN_REFUSED_BACKOFF_MS + spread_ms, MAX_REFUSED_BACKOFF_MS);
        }
        SessionEnd::Unreachable(error) => {
            tracing::info!(error = %chain(error), "cannot open an MQTT session");
        }
        SessionEnd::Lost(error) => {
            tracing::info!(%error, "the MQTT session was lost");
            if was_up {
                link_state.meter.reconnected(Instant::now());
            }
        }
        SessionEnd::Closed | SessionEnd::MessageLimitExceeded | SessionEnd::Moved => {}
    }
    (0, MAX_BACKOFF_MS)
}

/// Waits until the server names another place than `there` and this robot can reach that place.
/// Until then the session stays up. Each of the earlier `returns` doubles the wait.
async fn server_moved(
    access: &MqttAccess,
    link_state: &LinkState,
    there: &Destination,
    returns: &mut u32,
) {
    let mut questions = *returns;
    loop {
        let first = await_other_place(link_state, access, there, &mut questions).await;
        let route = access.routes.next(
            &first.host,
            first.port,
            first.is_encrypted,
            first.external.as_ref(),
        );
        match Relay::open(&route, CONNECT_TIMEOUT).await {
            Ok(_) => {
                tracing::info!(
                    host = first.host,
                    port = first.port,
                    "the server is at another broker"
                );
                *returns = returns.saturating_add(1);
                return;
            }
            Err(error) => {
                tracing::info!(error = %chain(&error), "the server's broker can't be reached")
            }
        }
    }
}

/// Kinds of messages that were published and are not yet acknowledged, oldest first.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Published {
    Status,
    Report { seq: u64 },
    Message,
    Lines,
}

async fn session(
    access: &MqttAccess,
    external: Option<&ExternalBroker>,
    route: Route,
    link_state: &LinkState,
    server_messages: &mpsc::Sender<ServerMessage>,
    channels: &mut MqttChannels,
    message_limit: MessageLimit,
) -> SessionEnd {
    let MqttChannels { requests, messages, lines } = channels;
    let relay = match Relay::open(&route, CONNECT_TIMEOUT).await {
        Ok(relay) => relay,
        Err(error) => return SessionEnd::Unreachable(error),
    };
    let options = options(access, external, &relay, message_limit);
    let (client, mut event_loop) = AsyncClient::new(options, QUEUED_REQUESTS);
    event_loop.network_options.set_connection_timeout(CONNECT_TIMEOUT.as_secs());
    let (events_in, mut events) = mpsc::channel(QUEUED_EVENTS);
    let (acknowledge, due) = mpsc::channel(QUEUED_ACKNOWLEDGEMENTS);
    let (mut reports, mut content_requests) =
        (link_state.reports.subscribe(), link_state.part_subscriptions.changes());
    let (pump, acknowledgements) = (
        pump(&mut event_loop, events_in, message_limit, link_state),
        acknowledge_all(client.clone(), due),
    );
    let relaying = relay.run();
    tokio::pin!(pump, acknowledgements, relaying);
    let mut session = Session {
        access,
        is_external: external.is_some(),
        link_state,
        server_messages,
        requests,
        client,
        up: false,
        unsent: VecDeque::new(),
        sent: VecDeque::new(),
        subscriptions: Subscriptions::default(),
        acknowledge,
        parked: None,
        pinged_at: None,
    };
    loop {
        if message_limit.is_exceeded(link_state) {
            return SessionEnd::MessageLimitExceeded;
        }
        let parked = session.parked.as_ref().map(|(receiver, _)| receiver.clone());
        tokio::select! {
            // Cancel-safe: the future is pinned outside of the loop and resumes where it stopped.
            ended = &mut pump => return ended,
            // Cancel-safe, for the same reason. Neither future ends before the session.
            () = &mut acknowledgements => {}
            () = &mut relaying => {}
            // Cancel-safe: a message stays in the channel until received.
            Some(event) = events.recv(), if session.parked.is_none() => session.handle_event(event).await,
            // Cancel-safe: a permit that was not taken stays free.
            place = queue_slot(parked) => session.deliver_parked(place),
            // Cancel-safe: a watch remembers a change.
            Ok(()) = content_requests.changed() => session.update_subscriptions(),
            // Cancel-safe: the timer is recreated on each iteration.
            () = tokio::time::sleep_until(session.subscriptions.next_retry()) => session.update_subscriptions(),
            // Cancel-safe: a watch remembers a change.
            Ok(()) = reports.changed() => session.publish_report(),
            // Cancel-safe: a message stays in the channel until received.
            Some(Message { topic, payload }) = messages.recv(), if session.has_queue_space() => {
                session.publish(topic, payload, Published::Message);
            }
            // Cancel-safe: a message stays in the channel until received.
            Some(payload) = lines.recv(), if session.has_queue_space() && !session.is_under_way(|it| *it == Published::Lines) => {
                session.publish(RobotTopic::Log, payload, Published::Lines);
            }
            // Cancel-safe: a token can be awaited again.
            () = link_state.shutdown.cancelled() => {
                // Without a DISCONNECT the broker publishes the will, whose content is correct
                // here.
                return SessionEnd::Closed;
            }
        }
    }
}

/// Drives rumqttc until the session ends. rumqttc's poll must not be dropped midway, so it runs in
/// one future that lives as long as the session.
async fn pump(
    event_loop: &mut EventLoop,
    events: mpsc::Sender<Event>,
    message_limit: MessageLimit,
    link_state: &LinkState,
) -> SessionEnd {
    loop {
        match event_loop.poll().await {
            Ok(event) => {
                if events.send(event).await.is_err() {
                    return SessionEnd::Closed;
                }
            }
            Err(ConnectionError::ConnectionRefused(
                ConnectReturnCode::BadUserNamePassword
                | ConnectReturnCode::NotAuthorized
                | ConnectReturnCode::BadClientId,
            )) => return SessionEnd::Refused,
            Err(ConnectionError::MqttState(StateError::Deserialization(
                rumqttc::Error::PayloadSizeLimitExceeded(bytes),
            ))) if message_limit.was_exceeded_by(bytes, link_state) => {
                return SessionEnd::MessageLimitExceeded;
            }
            Err(error) => return SessionEnd::Lost(error),
        }
    }
}

/// Sends acknowledgements until all senders are gone.
async fn acknowledge_all(client: AsyncClient, mut due: mpsc::Receiver<PendingAck>) {
    while let Some(due) = due.recv().await {
        // An error means that the session has ended, and the pump reports that.
        let _ = client.ack(&ack_target(due)).await;
    }
}

struct Session<'a> {
    access: &'a MqttAccess,
    is_external: bool,
    link_state: &'a LinkState,
    server_messages: &'a mpsc::Sender<ServerMessage>,
    requests: &'a mpsc::Sender<(Request, Instant)>,
    client: AsyncClient,
    up: bool,
    /// Passed to rumqttc, but without a packet id so far.
    unsent: VecDeque<Published>,
    /// Sent with this packet id.
    sent: VecDeque<(u16, Published)>,
    subscriptions: Subscriptions,
    acknowledge: mpsc::Sender<PendingAck>,
    /// A part that waits for space in its receiver's queue, and that receiver.
    parked: Option<(mpsc::Sender<ReceivedPart>, ReceivedPart)>,
    pinged_at: Option<Instant>,
}

/// Waits for a free slot for the parked part. `None` if its receiver is gone.
async fn queue_slot(
    receiver: Option<mpsc::Sender<ReceivedPart>>,
) -> Option<mpsc::OwnedPermit<ReceivedPart>> {
    match receiver {
        Some(receiver) => receiver.reserve_owned().await.ok(),
        None => std::future::pending().await,
    }
}

/// A message with the two fields that its acknowledgement needs.
fn ack_target(due: PendingAck) -> Publish {
    let qos = rumqttc::qos(due.qos).unwrap_or(QoS::AtMostOnce);
    let mut message = Publish::new("", qos, Vec::new());
    message.pkid = due.packet_id;
    message
}

impl Session<'_> {
    async fn handle_event(&mut self, event: Event) {
        match event {
            Event::Incoming(Packet::ConnAck(_)) => self.on_connected(),
            Event::Incoming(Packet::Publish(message)) => self.handle_message(message).await,
            Event::Incoming(Packet::PubAck(ack)) => self.confirm(ack.pkid).await,
            Event::Incoming(Packet::SubAck(answer)) => {
                if let Some(took) =
                    self.subscriptions.handle_suback(&answer, &self.link_state.part_subscriptions)
                {
                    self.link_state.meter.round_trip(took);
                }
            }
            Event::Incoming(Packet::PingResp) => {
                if let Some(pinged_at) = self.pinged_at.take() {
                    self.link_state.meter.round_trip(pinged_at.elapsed());
                }
            }
            Event::Outgoing(Outgoing::PingReq) => self.pinged_at = Some(Instant::now()),
            Event::Outgoing(Outgoing::Subscribe(id)) => self.subscriptions.sent(id),
            Event::Outgoing(Outgoing::Publish(id)) => {
                // A message without a packet id gets no acknowledgement.
                if let Some(published) = self.unsent.pop_front().filter(|_| id != 0) {
                    self.sent.push_back((id, published));
                }
            }
            _ => {}
        }
    }

    fn on_connected(&mut self) {
        self.up = true;
        self.link_state.mqtt.send_replace(if self.is_external {
            MqttState::UpAtExternalBroker
        } else {
            MqttState::UpAtServer
        });
        tracing::info!(host = self.access.host, port = self.access.port, "connected to MQTT");
        for topic in [RobotTopic::Desired, RobotTopic::Request] {
            // The queue is empty at the start of a session, and the pump detects a lost session.
            if self.client.try_subscribe(topic_name(self.access, topic), QoS::AtLeastOnce).is_ok() {
                self.subscriptions.add_own();
            }
        }
        self.link_state.part_subscriptions.set_session_up(true);
        self.publish(RobotTopic::Status, status_payload(self.access, true), Published::Status);
        self.publish_report();
    }

    /// Subscribes to wanted contents, and unsubscribes from contents that are no longer wanted.
    fn update_subscriptions(&mut self) {
        if self.up {
            self.subscriptions.update(
                &self.client,
                &self.access.prefix,
                &self.link_state.part_subscriptions,
            );
        }
    }

    async fn handle_message(&mut self, message: Publish) {
        let acknowledgement = Acknowledgement::new(
            PendingAck { packet_id: message.pkid, qos: message.qos as u8 },
            self.acknowledge.clone(),
        );
        match self.access.prefix.parse(&message.topic) {
            Some(Topic::Package(digest)) => {
                if let Some(receiver) = self.link_state.part_subscriptions.part_sender(&digest) {
                    self.forward_part(
                        receiver,
                        ReceivedPart { message: message.payload, acknowledgement },
                    );
                }
            }
            Some(Topic::Robot(robot, RobotTopic::Request)) if robot == self.access.robot => {
                self.handle_request(&message.payload);
            }
            Some(Topic::Robot(robot, RobotTopic::Desired)) if robot == self.access.robot => {
                self.handle_desired(&message.payload).await;
                if self.is_external {
                    // This status also tells a server that has lost track of its robots which of
                    // them are online.
                    self.publish(
                        RobotTopic::Status,
                        status_payload(self.access, true),
                        Published::Status,
                    );
                }
            }
            _ => {}
        }
    }

    fn forward_part(&mut self, receiver: mpsc::Sender<ReceivedPart>, part: ReceivedPart) {
        match receiver.try_send(part) {
            Err(mpsc::error::TrySendError::Full(part)) => self.parked = Some((receiver, part)),
            // The receiver is gone: dropping the part acknowledges it.
            Ok(()) | Err(mpsc::error::TrySendError::Closed(_)) => {}
        }
    }

    fn deliver_parked(&mut self, place: Option<mpsc::OwnedPermit<ReceivedPart>>) {
        if let (Some((_, part)), Some(place)) = (self.parked.take(), place) {
            place.send(part);
        }
    }

    async fn handle_desired(&self, payload: &[u8]) {
        if payload.len() > MAX_DESIRED_NOTICE_BYTES {
            tracing::warn!(bytes = payload.len(), "a desired state is too large for a message");
            return self.link_state.poll.notify_one();
        }
        match serde_json::from_slice::<DesiredNotice>(payload) {
            Ok(DesiredNotice::State { envelope, inline }) => {
                // The driver ends before this task, and the channel closes only when the agent
                // ends.
                let message = ServerMessage::Desired {
                    envelope: Box::new(envelope),
                    inline,
                    was_asked_for: false,
                };
                let _ = self.server_messages.send(message).await;
            }
            Ok(DesiredNotice::Notice { .. }) => self.link_state.poll.notify_one(),
            Err(error) => tracing::warn!(%error, "invalid message on the desired topic"),
        }
    }

    fn handle_request(&self, payload: &[u8]) {
        match serde_json::from_slice::<Request>(payload) {
            // Requesters wait only for a limited time. A request that finds the queue full may be
            // repeated.
            Ok(request) => {
                if self.requests.try_send((request, Instant::now())).is_err() {
                    tracing::warn!("too many concurrent requests");
                }
            }
            Err(error) => tracing::warn!(%error, "invalid message on the request topic"),
        }
    }

    async fn confirm(&mut self, id: u16) {
        let Some(at) = self.sent.iter().position(|(sent, _)| *sent == id) else { return };
        if let Some((_, Published::Report { seq })) = self.sent.remove(at) {
            let _ = self.server_messages.send(ServerMessage::Confirmed { seq, reply: None }).await;
            self.link_state.confirmed.send_if_modified(|confirmed| {
                let newer = seq > *confirmed;
                *confirmed = (*confirmed).max(seq);
                newer
            });
            self.publish_report();
        }
    }

    /// Whether the queue has space for a message other than a report.
    fn has_queue_space(&self) -> bool {
        self.up && self.unsent.len() < QUEUED_REQUESTS / 2
    }

    fn is_under_way(&self, kind: impl Fn(&Published) -> bool) -> bool {
        self.unsent.iter().any(&kind) || self.sent.iter().any(|(_, published)| kind(published))
    }

    /// Publishes the newest report, unless one is in flight. The acknowledgement of that one calls
    /// this function again.
    fn publish_report(&mut self) {
        let busy = self.is_under_way(|published| matches!(published, Published::Report { .. }));
        let Some(report) = self.link_state.reports.borrow().clone() else { return };
        if !self.up || self.is_external || busy || report.seq <= *self.link_state.confirmed.borrow()
        {
            return;
        }
        match serde_json::to_vec(&*report) {
            // The server would disconnect the robot for this message. Over HTTP the server returns
            // an error, and the session stays.
            Ok(payload) if payload.len() > MAX_REPORT_BYTES => self.link_state.post.notify_one(),
            Ok(payload) => {
                self.publish(RobotTopic::Report, payload, Published::Report { seq: report.seq })
            }
            Err(error) => tracing::error!(%error, "a report can't be written as JSON"),
        }
    }

    fn publish(&mut self, topic: RobotTopic, payload: Vec<u8>, published: Published) {
        let name = topic_name(self.access, topic);
        // The next vitals are more useful than a repetition of old ones.
        let qos = if topic == RobotTopic::Telemetry { QoS::AtMostOnce } else { QoS::AtLeastOnce };
        if self.client.try_publish(name, qos, false, payload).is_ok() {
            self.unsent.push_back(published);
        }
    }
}

fn options(
    access: &MqttAccess,
    external: Option<&ExternalBroker>,
    relay: &Relay,
    message_limit: MessageLimit,
) -> MqttOptions {
    let client_id = external
        .and_then(|external| external.client_id.as_deref())
        .unwrap_or(access.robot.as_str());
    let mut options = MqttOptions::new(client_id, relay.name(), access.port);
    options.set_transport(Transport::Unix);
    let password =
        external.map_or_else(|| access.token.current(), |external| external.password.clone());
    options.set_credentials(access.robot.as_str(), password);
    options.set_clean_session(true);
    options.set_keep_alive(KEEP_ALIVE);
    options.set_manual_acks(true);
    options.set_max_packet_size(message_limit.bytes, MAX_SENT_BYTES);
    let will = status_payload(access, false);
    options.set_last_will(LastWill::new(
        topic_name(access, RobotTopic::Status),
        will,
        QoS::AtLeastOnce,
        false,
    ));
    options
}

fn topic_name(access: &MqttAccess, topic: RobotTopic) -> String {
    access.prefix.format(&Topic::Robot(access.robot.clone(), topic))
}

fn status_payload(access: &MqttAccess, online: bool) -> Vec<u8> {
    // A status holds only numbers and text, so serialization can't fail.
    serde_json::to_vec(&Status { online, ..access.status.clone() }).unwrap_or_default()
}
