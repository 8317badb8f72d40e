//! The link to the server: sends reports and receives desired states, over MQTT while a session is
//! up and over HTTP otherwise. Polling never stops but becomes slow, so that a broker that loses
//! messages only causes delay. The link verifies and decides nothing: the driver does.

use std::sync::Arc;
use std::time::Duration;

use task_proto::api::{MqttEndpoint, ReportReply};
use task_proto::desired::Inline;
use task_proto::error_chain::chain;
use task_proto::messages::report::Report;
use task_proto::messages::request::Request;
use task_proto::messages::topic::RobotTopic;
use task_proto::trust::envelope::Envelope;
use tokio::sync::{Notify, mpsc, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::task::timing::backoff_ms;
use crate::transfer::link_meter::LinkMeter;
use crate::transfer::parts::PartSubscriptions;
use crate::transfer::server::{DesiredResponse, Server, ServerError};

/// Longest wait before a report is posted again.
const MAX_POST_BACKOFF_MS: u64 = 60 * 1000;
/// Even if its session accepts reports, a robot also posts one within this time, because only an
/// HTTP answer carries its name and labels. The robots of a fleet that starts at once spread over
/// this time.
const FIRST_POST: Duration = Duration::from_secs(15);
/// Longest wait between polls while the server refuses the token.
pub(crate) const REFUSED_POLL: Duration = Duration::from_secs(300);

/// Messages from the link to the driver.
#[derive(Debug)]
pub enum ServerMessage {
    /// A desired state with an unverified signature.
    Desired {
        envelope: Box<Envelope>,
        /// Blobs delivered with the state. They are accessible only by the digests that the state
        /// names.
        inline: Inline,
        /// Whether this is the server's answer to this robot's request. A message from a broker may
        /// come from any sender.
        was_asked_for: bool,
    },
    /// The server has no newer state.
    Unchanged,
    /// The server has stored a report.
    Confirmed {
        /// Sequence number of the report.
        seq: u64,
        /// The server's answer, if the report went over HTTP.
        reply: Option<ReportReply>,
    },
    /// The server refuses this robot's token, for the given reason.
    TokenRefused(String),
    /// The server knows the robot but sends no state now.
    StateUnavailable {
        /// The server's error code.
        code: String,
        /// The server's error text.
        text: String,
    },
}

/// State shared by the driver and the link. The driver writes `reports` and `settled`; the link
/// writes the rest.
#[derive(Clone)]
pub struct LinkState {
    pub reports: watch::Sender<Option<Arc<Report>>>,
    /// Sequence number of the newest stored report.
    pub confirmed: watch::Sender<u64>,
    /// Whether the robot will keep its current state for some time. Otherwise the full state is
    /// requested again.
    pub settled: watch::Sender<bool>,
    /// Endpoint of the MQTT session. `None` selects the session's initial address.
    pub endpoint: watch::Sender<Option<MqttEndpoint>>,
    /// Number of the server's answers about the endpoint, changed or not.
    pub endpoint_answers: watch::Sender<u64>,
    /// Requests the endpoint from the server.
    pub refresh_endpoint: Arc<Notify>,
    pub mqtt: watch::Sender<MqttState>,
    /// Signals that the server refused the token.
    pub token_refused: Arc<Notify>,
    /// Requests a poll now.
    pub poll: Arc<Notify>,
    /// Requests a report over HTTP now, even while MQTT is up.
    pub post: Arc<Notify>,
    /// Contents with wanted parts.
    pub part_subscriptions: PartSubscriptions,
    /// Measurements of the link.
    pub meter: LinkMeter,
    /// Cancelled when the agent ends.
    pub shutdown: CancellationToken,
}

/// The state of the MQTT session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MqttState {
    /// The first attempt to open a session has not ended yet.
    FirstAttempt,
    /// No session is up.
    Down,
    /// A session is up at an external broker. Its acknowledgements say nothing about the server, so
    /// it accepts no reports.
    UpAtExternalBroker,
    /// A session is up at the server itself, which acknowledges a report once it is stored.
    UpAtServer,
}

impl MqttState {
    /// Whether a session is up.
    pub fn is_up(self) -> bool {
        matches!(self, Self::UpAtExternalBroker | Self::UpAtServer)
    }

    /// Whether a session is up that accepts reports.
    pub fn accepts_reports(self) -> bool {
        self == Self::UpAtServer
    }

    /// Whether the first attempt to open a session has ended.
    pub fn was_tried(self) -> bool {
        self != Self::FirstAttempt
    }
}

/// Channels between an MQTT session and the agent's tasks that answer requests and publish
/// messages. Both directions are bounded and lossy, because their messages are useful only at the
/// moment.
pub struct MqttChannels {
    /// Incoming requests, each with its time of arrival.
    pub requests: mpsc::Sender<(Request, Instant)>,
    pub messages: mpsc::Receiver<Message>,
    /// Batches of log lines to publish. The next batch is taken after the acknowledgement of the
    /// last.
    pub lines: mpsc::Receiver<Vec<u8>>,
}

/// A message from the robot other than a report or a status.
#[derive(Debug)]
pub struct Message {
    /// Topic of the message.
    pub topic: RobotTopic,
    /// Payload of the message.
    pub payload: Vec<u8>,
}

#[derive(Debug, Clone, Copy)]
pub struct PollIntervals {
    /// Interval while MQTT is up.
    pub slow: Duration,
    /// Interval while MQTT is down.
    pub fast: Duration,
}

impl LinkState {
    /// Initial state, before any message.
    pub fn new(shutdown: CancellationToken) -> Self {
        Self {
            reports: watch::Sender::new(None),
            confirmed: watch::Sender::new(0),
            settled: watch::Sender::new(false),
            endpoint: watch::Sender::new(None),
            endpoint_answers: watch::Sender::new(0),
            refresh_endpoint: Arc::default(),
            mqtt: watch::Sender::new(MqttState::FirstAttempt),
            token_refused: Arc::default(),
            poll: Arc::default(),
            post: Arc::default(),
            part_subscriptions: PartSubscriptions::default(),
            meter: LinkMeter::default(),
            shutdown,
        }
    }

    /// The state of the MQTT session now.
    pub fn mqtt_now(&self) -> MqttState {
        *self.mqtt.borrow()
    }

    /// Waits for the end of the first attempt to open a session. Returns false if the agent ends.
    pub async fn first_attempt_ended(&self) -> bool {
        let mut mqtt = self.mqtt.subscribe();
        tokio::select! {
            // Cancel-safe: a watch remembers its value, and a token can be awaited again.
            _ = mqtt.wait_for(|mqtt| mqtt.was_tried()) => true,
            () = self.shutdown.cancelled() => false,
        }
    }
}

/// Runs the HTTP half of the link until the agent ends. It first waits for the end of the first
/// MQTT attempt: a session delivers the same data at less cost, above all when a whole fleet starts
/// at once.
pub async fn run_http(
    server: Server,
    link_state: LinkState,
    intervals: PollIntervals,
    server_messages: mpsc::Sender<ServerMessage>,
) {
    if !link_state.first_attempt_ended().await {
        return;
    }
    let polling = poll(server.clone(), link_state.clone(), intervals, server_messages.clone());
    let accepts_reports = link_state.mqtt_now().accepts_reports();
    let asking = async {
        if !accepts_reports {
            return;
        }
        tokio::time::sleep(FIRST_POST.mul_f64(rand::random())).await;
        link_state.post.notify_one();
    };
    tokio::join!(polling, post(server, link_state.clone(), server_messages), asking);
}

/// Polls for the desired state until the agent ends. The first poll is immediate, unless a session
/// is up, which receives the state without a request.
pub async fn poll(
    server: Server,
    link_state: LinkState,
    intervals: PollIntervals,
    server_messages: mpsc::Sender<ServerMessage>,
) {
    let mut tag = None;
    if link_state.mqtt_now().is_up() && !next_poll(&link_state, intervals, Duration::ZERO).await {
        return;
    }
    loop {
        let known = tag.as_ref().filter(|_| *link_state.settled.borrow());
        let begun = Instant::now();
        let outcome = server.desired(known).await;
        // An MQTT session measures more often and without the cost of a new connection.
        if outcome.is_ok() && !link_state.mqtt_now().is_up() {
            link_state.meter.round_trip(begun.elapsed());
        }
        let least = match &outcome {
            // Spread like all other waits: robots that were refused together must not poll
            // together.
            Err(ServerError::TokenRefused(_)) => REFUSED_POLL.min(intervals.slow).mul_f64(spread()),
            Err(ServerError::Busy { retry_after: Some(wait), .. }) => (*wait).min(intervals.slow),
            _ => Duration::ZERO,
        };
        if let Ok(Some(sent)) = &outcome {
            tag.clone_from(&sent.tag);
        }
        if matches!(outcome, Err(ServerError::TokenRefused(_))) {
            link_state.token_refused.notify_one();
        }
        if server_messages.send(server_message(outcome)).await.is_err()
            || !next_poll(&link_state, intervals, least).await
        {
            return;
        }
    }
}

/// Waits until the next poll is due, at least for `least`. Returns false if the agent ends.
async fn next_poll(link_state: &LinkState, intervals: PollIntervals, least: Duration) -> bool {
    let mut mqtt = link_state.mqtt.subscribe();
    let (asked_at, spread) = (Instant::now(), spread());
    loop {
        let up = mqtt.borrow_and_update().is_up();
        let interval =
            (if up { intervals.slow } else { intervals.fast }).mul_f64(spread).max(least);
        tokio::select! {
            // Cancel-safe: the timer is recreated for the same time, so that a flapping session
            // does not postpone polling forever.
            () = tokio::time::sleep_until(asked_at + interval) => {
                // A report over HTTP returns the name and labels that the server holds. MQTT does
                // not.
                link_state.post.notify_one();
                return true;
            }
            // Cancel-safe: a permit that was not taken stays.
            () = link_state.poll.notified() => return true,
            // Cancel-safe: a watch remembers a change. The other interval applies from now on.
            Ok(()) = mqtt.changed() => {}
            // Cancel-safe: a token can be awaited again.
            () = link_state.shutdown.cancelled() => return false,
        }
    }
}

fn server_message(outcome: Result<Option<DesiredResponse>, ServerError>) -> ServerMessage {
    match outcome {
        Ok(Some(sent)) => ServerMessage::Desired {
            envelope: Box::new(sent.envelope),
            inline: Inline::default(),
            was_asked_for: true,
        },
        Ok(None) => ServerMessage::Unchanged,
        Err(ServerError::TokenRefused(why)) => ServerMessage::TokenRefused(why),
        Err(ServerError::Refused { code, message }) => {
            ServerMessage::StateUnavailable { code, text: message }
        }
        Err(error) => {
            tracing::info!(error = %chain(&error), "cannot fetch the desired state over HTTP");
            ServerMessage::StateUnavailable {
                code: "server_unreachable".to_owned(),
                text: chain(&error),
            }
        }
    }
}

/// Posts reports over HTTP while no MQTT session stores them, and on request while one does, until
/// the agent ends.
pub async fn post(
    server: Server,
    link_state: LinkState,
    server_messages: mpsc::Sender<ServerMessage>,
) {
    let (mut reports, mut mqtt) = (link_state.reports.subscribe(), link_state.mqtt.subscribe());
    let mut asked = !mqtt.borrow().accepts_reports();
    let mut failures = 0;
    loop {
        let newest = reports.borrow_and_update().clone();
        let mqtt_then = *mqtt.borrow_and_update();
        let due = newest.filter(|report| {
            asked || (!mqtt_then.accepts_reports() && report.seq > *link_state.confirmed.borrow())
        });
        let mut retry = Duration::MAX;
        if let Some(report) = due {
            match server.report(&report).await {
                Ok(reply) => {
                    (asked, failures) = (false, 0);
                    link_state
                        .confirmed
                        .send_modify(|confirmed| *confirmed = (*confirmed).max(report.seq));
                    // An external broker may have lost the notice.
                    if !mqtt_then.accepts_reports()
                        && link_state.mqtt_now().is_up()
                        && reply.generation > report.observed_generation
                    {
                        link_state.poll.notify_one();
                    }
                    if server_messages
                        .send(ServerMessage::Confirmed { seq: report.seq, reply: Some(reply) })
                        .await
                        .is_err()
                    {
                        return;
                    }
                    continue;
                }
                Err(error) => {
                    tracing::info!(error = %chain(&error), "cannot send the report over HTTP");
                    failures += 1;
                    retry = Duration::from_millis(
                        backoff_ms(failures, MAX_POST_BACKOFF_MS, rand::random()).max(100),
                    );
                    match error {
                        ServerError::Busy { retry_after: Some(wait), .. } => {
                            retry = retry.max(wait.min(REFUSED_POLL))
                        }
                        ServerError::TokenRefused(why) => {
                            // Polling detects when the token is accepted again.
                            retry = REFUSED_POLL.mul_f64(spread());
                            if server_messages.send(ServerMessage::TokenRefused(why)).await.is_err()
                            {
                                return;
                            }
                        }
                        _ => {}
                    }
                }
            }
        }
        let newer = async {
            if retry == Duration::MAX {
                // No failure: a new report is sent at once.
                let _ = reports.changed().await;
            } else {
                tokio::time::sleep(retry).await;
            }
        };
        tokio::select! {
            // Cancel-safe: a watch remembers a change, and the timer is recreated.
            () = newer => {}
            // Cancel-safe: a watch remembers a change.
            Ok(()) = mqtt.changed() => {}
            // Cancel-safe: a permit that was not taken stays.
            () = link_state.post.notified() => asked = true,
            // Cancel-safe: a token can be awaited again.
            () = link_state.shutdown.cancelled() => return,
        }
    }
}

/// Random factor from 0.5 to 1.5, so that robots that started together do not poll together.
pub(crate) fn spread() -> f64 {
    0.5 + rand::random::<f64>()
}
