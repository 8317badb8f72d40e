//! The MQTT half of the link, and the only module that names rumqttc. It keeps one session after
//! another, each with a last will. Incoming: the doorbell, requests and package parts. Outgoing:
//! status, the newest report, responses and log lines. The PUBACK of a report confirms it, because
//! the server sends the PUBACK once the report is stored. An external broker gets no reports. This
//! module never decides how to react to the received messages.
//!
//! Messages are acknowledged manually: a part after its write, all others at once. At most one part
//! is held here while its receiver is busy; until the receiver takes the part, the session reads
//! nothing more.

mod destination;
mod room;
mod subscriptions;
mod ways;

use std::collections::VecDeque;
use std::time::Duration;

use rumqttc::{
    AsyncClient, ConnectReturnCode, ConnectionError, Event, EventLoop, LastWill, MqttOptions,
    Outgoing, Packet, Publish, QoS, StateError, Transport,
};
use task_proto::RobotId;
use task_proto::api::ExternalBroker;
use task_proto::desired::{Doorbell, MAX_DOORBELL_BYTES};
use task_proto::report::{MAX_REPORT_BYTES, Status};
use task_proto::request::Request;
use task_proto::topic::{RobotTopic, Topic, TopicPrefix};
use task_transport::{Line, LineError, Route};
use tokio::sync::mpsc;
use tokio::time::Instant;

use self::destination::{Destination, moved, named_elsewhere, place_count};
use self::room::MessageRoom;
use self::subscriptions::Subscriptions;
pub use self::ways::Ways;
use crate::link::state::{Heard, Message, Shared, Talk};
use crate::system::error_chain::chain;
use crate::task::plan::backoff_ms;
use crate::transfer::credential::Credential;
use crate::transfer::parts::{Acknowledgement, Arrived, Due};

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

/// Address and credentials of the default connection, unless [`Shared::endpoint`] names another.
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
    pub ways: Ways,
}

/// Reasons for the end of a session.
enum Ended {
    /// The broker refuses this robot.
    Refused,
    /// A part of a wanted package exceeds this session's message limit.
    TooNarrow,
    /// The server names another broker for the session.
    Moved,
    /// The connection to the broker can't be opened.
    Unreachable(LineError),
    Lost(ConnectionError),
    /// The agent is shutting down.
    Closed,
}

/// Keeps a session up until the agent ends. After each session it waits with full jitter.
pub async fn run(
    mut access: MqttAccess,
    shared: Shared,
    heard: mpsc::Sender<Heard>,
    mut talk: Talk,
) {
    let mut failures = 0u32;
    // Whether the server has sent a package as a message above the usual limit.
    let mut sends_large = false;
    let mut endpoint = shared.endpoint.subscribe();
    let (mut told, mut place) = (None, 0);
    // Number of attempts to return to the server's place since the last good session there.
    let mut returns = 0u32;
    loop {
        access.status.connection += 1;
        let begun = Instant::now();
        let room = MessageRoom::of(&access, &shared, sends_large);
        let newest = endpoint.borrow_and_update().clone();
        if newest != told {
            (told, place, returns) = (newest, 0, 0);
        }
        let (there, places) =
            (access.destination(told.as_ref(), place), place_count(told.as_ref()));
        let (at, external) = (access.at(&there), there.external.as_ref());
        let way = access.ways.next(&there.host, there.port, there.is_encrypted, external);
        let session = session(&at, external, way, &shared, &heard, &mut talk, room);
        let ended = tokio::select! {
            // Cancel-safe: no later code uses the future. The broker detects the end of the
            // session.
            ended = session => ended,
            () = moved(&mut endpoint, &access, &there) => Ended::Moved,
            // Cancel-safe: the future only asks questions, and its counter lives outside of the
            // future.
            () = server_elsewhere(&access, &shared, &there, &mut returns), if places > 1 => Ended::Moved,
        };
        let was_up = shared.mqtt_up.send_replace(false);
        shared.mqtt_stores.send_replace(false);
        shared.mqtt_tried.send_replace(true);
        if !was_up {
            shared.find.notify_one();
            place = (place + 1) % places;
            if matches!(ended, Ended::Lost(_) | Ended::Unreachable(_)) {
                access.ways.turn();
            }
        }
        // Tasks that wait for parts need not give up if the next session begins at once.
        shared.listening.session(matches!(ended, Ended::TooNarrow));
        let was_good = begun.elapsed() >= GOOD_SESSION;
        if was_good && place == 0 {
            returns = 0;
        }
        failures = if was_good { 1 } else { failures.saturating_add(1) };
        let (min_ms, max_ms) = match ended {
            Ended::Closed => return,
            Ended::TooNarrow => {
                sends_large = true;
                continue;
            }
            Ended::Moved => {
                access.ways.begin_anew();
                (failures, place) = (0, 0);
                continue;
            }
            Ended::Refused => {
                tracing::warn!("the MQTT broker refuses this robot");
                // The server's own answer over HTTP tells whether the robot was removed.
                shared.poll.notify_one();
                (
                    MIN_REFUSED_BACKOFF_MS + rand::random_range(0..=MIN_REFUSED_BACKOFF_MS / 2),
                    MAX_REFUSED_BACKOFF_MS,
                )
            }
            Ended::Unreachable(error) => {
                tracing::info!(error = %chain(&error), "no MQTT session");
                (0, MAX_BACKOFF_MS)
            }
            Ended::Lost(error) => {
                tracing::info!(%error, "no MQTT session");
                if was_up {
                    shared.meter.reconnected(Instant::now());
                }
                (0, MAX_BACKOFF_MS)
            }
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
            () = shared.shutdown.cancelled() => return,
        }
    }
}

/// Waits until the server names another place than `there` and this robot can reach that place.
/// Until then the session stays up. Each of the earlier `returns` doubles the wait.
async fn server_elsewhere(
    access: &MqttAccess,
    shared: &Shared,
    there: &Destination,
    returns: &mut u32,
) {
    let mut asked = *returns;
    loop {
        let first = named_elsewhere(shared, access, there, &mut asked).await;
        let way =
            access.ways.next(&first.host, first.port, first.is_encrypted, first.external.as_ref());
        match Line::open(&way, CONNECT_TIMEOUT).await {
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
    way: Route,
    shared: &Shared,
    heard: &mpsc::Sender<Heard>,
    talk: &mut Talk,
    room: MessageRoom,
) -> Ended {
    let Talk { requests, messages, lines } = talk;
    let line = match Line::open(&way, CONNECT_TIMEOUT).await {
        Ok(line) => line,
        Err(error) => return Ended::Unreachable(error),
    };
    let options = options(access, external, &line, room);
    let (client, mut event_loop) = AsyncClient::new(options, QUEUED_REQUESTS);
    event_loop.network_options.set_connection_timeout(CONNECT_TIMEOUT.as_secs());
    let (events_in, mut events) = mpsc::channel(QUEUED_EVENTS);
    let (acknowledge, due) = mpsc::channel(QUEUED_ACKNOWLEDGEMENTS);
    let (mut reports, mut wishes) = (shared.reports.subscribe(), shared.listening.changes());
    let (pump, acknowledgements) =
        (pump(&mut event_loop, events_in, room, shared), acknowledge_all(client.clone(), due));
    let carrying = line.carry();
    tokio::pin!(pump, acknowledgements, carrying);
    let mut session = Session {
        access,
        is_external: external.is_some(),
        shared,
        heard,
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
        if room.is_too_narrow(shared) {
            return Ended::TooNarrow;
        }
        let parked = session.parked.as_ref().map(|(way, _)| way.clone());
        tokio::select! {
            // Cancel-safe: the future is pinned outside of the loop and resumes where it stopped.
            ended = &mut pump => return ended,
            // Cancel-safe, for the same reason. Neither future ends before the session.
            () = &mut acknowledgements => {}
            () = &mut carrying => {}
            // Cancel-safe: a message stays in the channel until received.
            Some(event) = events.recv(), if session.parked.is_none() => session.take(event).await,
            // Cancel-safe: a permit that was not taken stays free.
            place = place_for(parked) => session.unpark(place),
            // Cancel-safe: a watch remembers a change.
            Ok(()) = wishes.changed() => session.tune(),
            // Cancel-safe: the timer is recreated on each iteration.
            () = tokio::time::sleep_until(session.subscriptions.next_try()) => session.tune(),
            // Cancel-safe: a watch remembers a change.
            Ok(()) = reports.changed() => session.publish_report(),
            // Cancel-safe: a message stays in the channel until received.
            Some(Message { topic, payload }) = messages.recv(), if session.has_room() => {
                session.publish(topic, payload, Published::Message);
            }
            // Cancel-safe: a message stays in the channel until received.
            Some(payload) = lines.recv(), if session.has_room() && !session.is_under_way(|it| *it == Published::Lines) => {
                session.publish(RobotTopic::Log, payload, Published::Lines);
            }
            // Cancel-safe: a token can be awaited again.
            () = shared.shutdown.cancelled() => {
                // Without a DISCONNECT the broker publishes the will, whose content is correct
                // here.
                return Ended::Closed;
            }
        }
    }
}

/// Drives rumqttc until the session ends. rumqttc's poll must not be dropped midway, so it runs in
/// one future that lives as long as the session.
async fn pump(
    event_loop: &mut EventLoop,
    events: mpsc::Sender<Event>,
    room: MessageRoom,
    shared: &Shared,
) -> Ended {
    loop {
        match event_loop.poll().await {
            Ok(event) => {
                if events.send(event).await.is_err() {
                    return Ended::Closed;
                }
            }
            Err(ConnectionError::ConnectionRefused(
                ConnectReturnCode::BadUserNamePassword
                | ConnectReturnCode::NotAuthorized
                | ConnectReturnCode::BadClientId,
            )) => return Ended::Refused,
            Err(ConnectionError::MqttState(StateError::Deserialization(
                rumqttc::Error::PayloadSizeLimitExceeded(bytes),
            ))) if room.was_too_narrow(bytes, shared) => return Ended::TooNarrow,
            Err(error) => return Ended::Lost(error),
        }
    }
}

/// Sends acknowledgements until all senders are gone.
async fn acknowledge_all(client: AsyncClient, mut due: mpsc::Receiver<Due>) {
    while let Some(due) = due.recv().await {
        // An error means that the session has ended, and the pump reports that.
        let _ = client.ack(&answered(due)).await;
    }
}

struct Session<'a> {
    access: &'a MqttAccess,
    is_external: bool,
    shared: &'a Shared,
    heard: &'a mpsc::Sender<Heard>,
    requests: &'a mpsc::Sender<(Request, Instant)>,
    client: AsyncClient,
    up: bool,
    /// Passed to rumqttc, but without a packet id so far.
    unsent: VecDeque<Published>,
    /// Sent with this packet id.
    sent: VecDeque<(u16, Published)>,
    subscriptions: Subscriptions,
    acknowledge: mpsc::Sender<Due>,
    /// A part that waits for space in its receiver's queue, and that receiver.
    parked: Option<(mpsc::Sender<Arrived>, Arrived)>,
    pinged_at: Option<Instant>,
}

/// Waits for a free slot for the parked part. `None` if its receiver is gone.
async fn place_for(way: Option<mpsc::Sender<Arrived>>) -> Option<mpsc::OwnedPermit<Arrived>> {
    match way {
        Some(way) => way.reserve_owned().await.ok(),
        None => std::future::pending().await,
    }
}

/// A message with the two fields that its acknowledgement needs.
fn answered(due: Due) -> Publish {
    let qos = rumqttc::qos(due.qos).unwrap_or(QoS::AtMostOnce);
    let mut message = Publish::new("", qos, Vec::new());
    message.pkid = due.packet_id;
    message
}

impl Session<'_> {
    async fn take(&mut self, event: Event) {
        match event {
            Event::Incoming(Packet::ConnAck(_)) => self.begin(),
            Event::Incoming(Packet::Publish(message)) => self.hear(message).await,
            Event::Incoming(Packet::PubAck(ack)) => self.confirm(ack.pkid).await,
            Event::Incoming(Packet::SubAck(answer)) => {
                if let Some(took) = self.subscriptions.answered(&answer, &self.shared.listening) {
                    self.shared.meter.round_trip(took);
                }
            }
            Event::Incoming(Packet::PingResp) => {
                if let Some(pinged_at) = self.pinged_at.take() {
                    self.shared.meter.round_trip(pinged_at.elapsed());
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

    fn begin(&mut self) {
        self.up = true;
        self.shared.mqtt_up.send_replace(true);
        self.shared.mqtt_stores.send_replace(!self.is_external);
        self.shared.mqtt_tried.send_replace(true);
        tracing::info!(host = self.access.host, port = self.access.port, "connected to MQTT");
        for topic in [RobotTopic::Desired, RobotTopic::Request] {
            // The queue is empty at the start of a session, and the pump detects a lost session.
            if self.client.try_subscribe(topic_name(self.access, topic), QoS::AtLeastOnce).is_ok() {
                self.subscriptions.asked_for_own();
            }
        }
        self.shared.listening.session(true);
        self.publish(RobotTopic::Status, status_payload(self.access, true), Published::Status);
        self.publish_report();
    }

    /// Subscribes to wanted contents, and unsubscribes from contents that are no longer wanted.
    fn tune(&mut self) {
        if self.up {
            self.subscriptions.tune(&self.client, &self.access.prefix, &self.shared.listening);
        }
    }

    async fn hear(&mut self, message: Publish) {
        let acknowledgement = Acknowledgement::new(
            Due { packet_id: message.pkid, qos: message.qos as u8 },
            self.acknowledge.clone(),
        );
        match self.access.prefix.parse(&message.topic) {
            Some(Topic::Package(digest)) => {
                if let Some(way) = self.shared.listening.way_to(&digest) {
                    self.pass_on(way, Arrived { message: message.payload, acknowledgement });
                }
            }
            Some(Topic::Robot(robot, RobotTopic::Request)) if robot == self.access.robot => {
                self.hear_request(&message.payload);
            }
            Some(Topic::Robot(robot, RobotTopic::Desired)) if robot == self.access.robot => {
                self.hear_desired(&message.payload).await;
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

    fn pass_on(&mut self, way: mpsc::Sender<Arrived>, part: Arrived) {
        match way.try_send(part) {
            Err(mpsc::error::TrySendError::Full(part)) => self.parked = Some((way, part)),
            // The receiver is gone: dropping the part acknowledges it.
            Ok(()) | Err(mpsc::error::TrySendError::Closed(_)) => {}
        }
    }

    fn unpark(&mut self, place: Option<mpsc::OwnedPermit<Arrived>>) {
        if let (Some((_, part)), Some(place)) = (self.parked.take(), place) {
            place.send(part);
        }
    }

    async fn hear_desired(&self, payload: &[u8]) {
        if payload.len() > MAX_DOORBELL_BYTES {
            tracing::warn!(bytes = payload.len(), "a desired state is too large for a message");
            return self.shared.poll.notify_one();
        }
        match serde_json::from_slice::<Doorbell>(payload) {
            Ok(Doorbell::State { envelope, inline }) => {
                // The driver ends before this task, and the channel closes only when the agent
                // ends.
                let heard =
                    Heard::Desired { envelope: Box::new(envelope), inline, was_asked_for: false };
                let _ = self.heard.send(heard).await;
            }
            Ok(Doorbell::Notice { .. }) => self.shared.poll.notify_one(),
            Err(error) => tracing::warn!(%error, "the desired topic holds something else"),
        }
    }

    fn hear_request(&self, payload: &[u8]) {
        match serde_json::from_slice::<Request>(payload) {
            // Requesters wait only for a limited time. A request that finds the queue full may be
            // repeated.
            Ok(request) => {
                if self.requests.try_send((request, Instant::now())).is_err() {
                    tracing::warn!("too many questions at a time");
                }
            }
            Err(error) => tracing::warn!(%error, "the request topic holds something else"),
        }
    }

    async fn confirm(&mut self, id: u16) {
        let Some(at) = self.sent.iter().position(|(sent, _)| *sent == id) else { return };
        if let Some((_, Published::Report { seq })) = self.sent.remove(at) {
            let _ = self.heard.send(Heard::Confirmed { seq, reply: None }).await;
            self.shared.confirmed.send_if_modified(|confirmed| {
                let newer = seq > *confirmed;
                *confirmed = (*confirmed).max(seq);
                newer
            });
            self.publish_report();
        }
    }

    /// Whether the queue has space for a message other than a report.
    fn has_room(&self) -> bool {
        self.up && self.unsent.len() < QUEUED_REQUESTS / 2
    }

    fn is_under_way(&self, kind: impl Fn(&Published) -> bool) -> bool {
        self.unsent.iter().any(&kind) || self.sent.iter().any(|(_, published)| kind(published))
    }

    /// Publishes the newest report, unless one is in flight. The acknowledgement of that one calls
    /// this function again.
    fn publish_report(&mut self) {
        let busy = self.is_under_way(|published| matches!(published, Published::Report { .. }));
        let Some(report) = self.shared.reports.borrow().clone() else { return };
        if !self.up || self.is_external || busy || report.seq <= *self.shared.confirmed.borrow() {
            return;
        }
        match serde_json::to_vec(&*report) {
            // The server would disconnect the robot for this message. Over HTTP the server returns
            // an error, and the session stays.
            Ok(payload) if payload.len() > MAX_REPORT_BYTES => self.shared.post.notify_one(),
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
    line: &Line,
    room: MessageRoom,
) -> MqttOptions {
    let client_id = external
        .and_then(|external| external.client_id.as_deref())
        .unwrap_or(access.robot.as_str());
    let mut options = MqttOptions::new(client_id, line.name(), access.port);
    options.set_transport(Transport::Unix);
    let password =
        external.map_or_else(|| access.token.current(), |external| external.password.clone());
    options.set_credentials(access.robot.as_str(), password);
    options.set_clean_session(true);
    options.set_keep_alive(KEEP_ALIVE);
    options.set_manual_acks(true);
    options.set_max_packet_size(room.bytes, MAX_SENT_BYTES);
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
