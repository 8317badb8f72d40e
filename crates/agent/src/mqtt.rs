//! The MQTT half of the link, and the only place that names rumqttc: one session after another, each with a last will;
//! the doorbell and questions in, status, the newest report, answers and log lines out. A report is confirmed by its
//! PUBACK, which the server sends once the report is stored. It never decides what to do with what it hears.

use std::collections::VecDeque;
use std::time::Duration;

use rumqttc::{AsyncClient, ConnectReturnCode, ConnectionError, Event, LastWill, MqttOptions, Outgoing, Packet, QoS};
use task_proto::RobotId;
use task_proto::desired::{Doorbell, MAX_DOORBELL_BYTES};
use task_proto::report::Status;
use task_proto::request::Request;
use task_proto::topic::{RobotTopic, Topic, TopicPrefix};
use tokio::sync::mpsc;
use tokio::time::Instant;

use crate::credential::Credential;
use crate::link::{Heard, Message, Shared, Talk};
use crate::plan::backoff_ms;

/// How often the broker hears from an idle robot.
const KEEP_ALIVE: Duration = Duration::from_secs(20);
/// How long connecting may take.
const CONNECT_TIMEOUT_S: u64 = 10;
/// The longest wait between two tries to connect.
const MAX_BACKOFF_MS: u64 = 60 * 1000;
/// The longest wait after the broker refused this robot.
const MAX_REFUSED_BACKOFF_MS: u64 = 5 * 60 * 1000;
/// A session that lasted this long shows that the way is good: the backoff begins anew.
const GOOD_SESSION: Duration = Duration::from_secs(60);
/// Requests between this task and rumqttc.
const QUEUED_REQUESTS: usize = 16;
/// The largest packet that is sent: a report of very many tasks.
const MAX_SENT_BYTES: usize = 8 * 1024 * 1024;

/// Where and as whom to connect.
#[derive(Clone)]
pub struct MqttAccess {
    /// Host name or address.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// What all topics start with.
    pub prefix: TopicPrefix,
    /// Client id and user name.
    pub robot: RobotId,
    /// The password.
    pub token: Credential,
    /// What every status says; `connection` counts up from it.
    pub status: Status,
}

/// Why a session ended.
enum Ended {
    /// The broker does not accept this robot.
    Refused,
    /// Anything else.
    Lost(ConnectionError),
    /// The agent ends.
    Closed,
}

/// Keeps a session up until the agent ends; after each end it waits with full jitter.
pub async fn run(mut access: MqttAccess, shared: Shared, heard: mpsc::Sender<Heard>, mut talk: Talk) {
    let mut failures = 0u32;
    loop {
        access.status.connection += 1;
        let begun = Instant::now();
        let ended = session(&access, &shared, &heard, &mut talk).await;
        shared.mqtt_up.send_replace(false);
        failures = if begun.elapsed() >= GOOD_SESSION { 1 } else { failures.saturating_add(1) };
        let max_ms = match ended {
            Ended::Closed => return,
            Ended::Refused => {
                tracing::warn!("the MQTT broker refuses this robot");
                // Whether the robot was removed is asked over HTTP, whose answer is the server's own.
                shared.poll.notify_one();
                MAX_REFUSED_BACKOFF_MS
            }
            Ended::Lost(error) => {
                tracing::info!(%error, "no MQTT session");
                MAX_BACKOFF_MS
            }
        };
        let wait = Duration::from_millis(backoff_ms(failures, max_ms, rand::random()));
        tokio::select! {
            // Cancel-safe: a timer that is made anew each time.
            () = tokio::time::sleep(wait) => {}
            // Cancel-safe: a token can be awaited again.
            () = shared.shutdown.cancelled() => return,
        }
    }
}

/// What was published and is not acknowledged, the first one first.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Published {
    Status,
    Report { seq: u64 },
    Message,
    Lines,
}

async fn session(access: &MqttAccess, shared: &Shared, heard: &mpsc::Sender<Heard>, talk: &mut Talk) -> Ended {
    let Talk { requests, messages, lines } = talk;
    let (client, mut event_loop) = AsyncClient::new(options(access), QUEUED_REQUESTS);
    event_loop.network_options.set_connection_timeout(CONNECT_TIMEOUT_S);
    let (events_in, mut events) = mpsc::channel(QUEUED_REQUESTS);
    let mut reports = shared.reports.subscribe();
    // rumqttc's poll must not be dropped half way, so it runs in one future that lives as long as the session.
    let pump = async {
        loop {
            match event_loop.poll().await {
                Ok(event) => {
                    if events_in.send(event).await.is_err() {
                        return Ended::Closed;
                    }
                }
                Err(ConnectionError::ConnectionRefused(
                    ConnectReturnCode::BadUserNamePassword | ConnectReturnCode::NotAuthorized,
                )) => return Ended::Refused,
                Err(error) => return Ended::Lost(error),
            }
        }
    };
    tokio::pin!(pump);
    let mut session =
        Session { access, shared, heard, requests, client, up: false, unsent: VecDeque::new(), sent: VecDeque::new() };
    loop {
        tokio::select! {
            // Cancel-safe: the future is pinned outside of the loop and goes on where it was.
            ended = &mut pump => return ended,
            // Cancel-safe: a message stays in the channel until it is received.
            Some(event) = events.recv() => session.take(event).await,
            // Cancel-safe: a watch remembers that it changed.
            Ok(()) = reports.changed() => session.publish_report(),
            // Cancel-safe: a message stays in the channel until it is received.
            Some(Message { topic, payload }) = messages.recv(), if session.has_room() => {
                session.publish(topic, payload, Published::Message);
            }
            // Cancel-safe, likewise.
            Some(payload) = lines.recv(), if session.has_room() && !session.is_under_way(|it| *it == Published::Lines) => {
                session.publish(RobotTopic::Log, payload, Published::Lines);
            }
            // Cancel-safe: a token can be awaited again.
            () = shared.shutdown.cancelled() => {
                // Without DISCONNECT the broker publishes the will, which says just what is true.
                return Ended::Closed;
            }
        }
    }
}

struct Session<'a> {
    access: &'a MqttAccess,
    shared: &'a Shared,
    heard: &'a mpsc::Sender<Heard>,
    requests: &'a mpsc::Sender<Request>,
    client: AsyncClient,
    up: bool,
    /// Handed to rumqttc, which has not given them a packet id yet.
    unsent: VecDeque<Published>,
    /// Sent under this packet id.
    sent: VecDeque<(u16, Published)>,
}

impl Session<'_> {
    async fn take(&mut self, event: Event) {
        match event {
            Event::Incoming(Packet::ConnAck(_)) => self.begin(),
            Event::Incoming(Packet::Publish(message)) => self.hear(&message.topic, &message.payload).await,
            Event::Incoming(Packet::PubAck(ack)) => self.confirm(ack.pkid).await,
            Event::Outgoing(Outgoing::Publish(id)) => {
                if let Some(published) = self.unsent.pop_front() {
                    self.sent.push_back((id, published));
                }
            }
            _ => {}
        }
    }

    fn begin(&mut self) {
        self.up = true;
        self.shared.mqtt_up.send_replace(true);
        tracing::info!(host = self.access.host, port = self.access.port, "connected to MQTT");
        for topic in [RobotTopic::Desired, RobotTopic::Request] {
            // The queue is empty at the start of a session, and a lost session is noticed by the pump.
            let _ = self.client.try_subscribe(topic_name(self.access, topic), QoS::AtLeastOnce);
        }
        self.publish(RobotTopic::Status, status_payload(self.access, true), Published::Status);
        self.publish_report();
    }

    async fn hear(&self, topic: &str, payload: &[u8]) {
        if topic == topic_name(self.access, RobotTopic::Request) {
            return self.hear_request(payload);
        }
        if topic != topic_name(self.access, RobotTopic::Desired) {
            return;
        }
        match serde_json::from_slice::<Doorbell>(payload) {
            Ok(Doorbell::State { envelope, .. }) => {
                // The driver ends before this task: nobody listens only when the agent ends.
                let _ = self.heard.send(Heard::Desired(Box::new(envelope))).await;
            }
            Ok(Doorbell::Notice { .. }) => self.shared.poll.notify_one(),
            Err(error) => tracing::warn!(%error, "the desired topic holds something else"),
        }
    }

    fn hear_request(&self, payload: &[u8]) {
        match serde_json::from_slice::<Request>(payload) {
            // Who asks waits only so long; a question that finds no room may be asked again.
            Ok(request) => {
                if self.requests.try_send(request).is_err() {
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

    /// Whether something may be published without taking a report's place.
    fn has_room(&self) -> bool {
        self.up && self.unsent.len() < QUEUED_REQUESTS / 2
    }

    fn is_under_way(&self, kind: impl Fn(&Published) -> bool) -> bool {
        self.unsent.iter().any(&kind) || self.sent.iter().any(|(_, published)| kind(published))
    }

    /// Publishes the newest report, unless one is under way: its acknowledgement calls this again.
    fn publish_report(&mut self) {
        let busy = self.is_under_way(|published| matches!(published, Published::Report { .. }));
        let Some(report) = self.shared.reports.borrow().clone() else { return };
        if !self.up || busy || report.seq <= *self.shared.confirmed.borrow() {
            return;
        }
        match serde_json::to_vec(&*report) {
            Ok(payload) => self.publish(RobotTopic::Report, payload, Published::Report { seq: report.seq }),
            Err(error) => tracing::error!(%error, "a report can't be written as JSON"),
        }
    }

    fn publish(&mut self, topic: RobotTopic, payload: Vec<u8>, published: Published) {
        let name = topic_name(self.access, topic);
        if self.client.try_publish(name, QoS::AtLeastOnce, false, payload).is_ok() {
            self.unsent.push_back(published);
        }
    }
}

fn options(access: &MqttAccess) -> MqttOptions {
    let mut options = MqttOptions::new(access.robot.as_str(), &access.host, access.port);
    options.set_credentials(access.robot.as_str(), access.token.current());
    options.set_clean_session(true);
    options.set_keep_alive(KEEP_ALIVE);
    // Base64 and JSON around the payload are counted in the limit, topic and header are not.
    options.set_max_packet_size(MAX_DOORBELL_BYTES + 4096, MAX_SENT_BYTES);
    let will = status_payload(access, false);
    options.set_last_will(LastWill::new(topic_name(access, RobotTopic::Status), will, QoS::AtLeastOnce, false));
    options
}

fn topic_name(access: &MqttAccess, topic: RobotTopic) -> String {
    access.prefix.format(&Topic::Robot(access.robot.clone(), topic))
}

fn status_payload(access: &MqttAccess, online: bool) -> Vec<u8> {
    // A status is plain numbers and texts: it can always be written.
    serde_json::to_vec(&Status { online, ..access.status.clone() }).unwrap_or_default()
}
