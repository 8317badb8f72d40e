//! The link to the server: reports out, desired states in, over MQTT while it is up and over HTTP
//! otherwise. Polling never stops, it only gets slow, so that a broker that loses messages costs
//! time and nothing else. It verifies nothing and decides nothing: the driver does.

use std::sync::Arc;
use std::time::Duration;

use task_proto::api::{MqttEndpoint, ReportReply};
use task_proto::desired::Inline;
use task_proto::envelope::Envelope;
use task_proto::report::Report;
use task_proto::request::Request;
use task_proto::topic::RobotTopic;
use tokio::sync::{Notify, mpsc, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::system::error_chain::chain;
use crate::task::plan::backoff_ms;
use crate::transfer::link_meter::LinkMeter;
use crate::transfer::parts::Listening;
use crate::transfer::server::{Sent, Server, ServerError};

/// The longest wait before a report is posted again.
const MAX_POST_BACKOFF_MS: u64 = 60 * 1000;
/// Within this time a robot whose session takes its reports also posts one, for the name and labels
/// that only an answer brings. A fleet that starts at once spreads over it.
const FIRST_POST: Duration = Duration::from_secs(15);
/// The longest wait between polls while the server refuses the token.
pub(crate) const REFUSED_POLL: Duration = Duration::from_secs(300);

/// What the link tells the driver.
#[derive(Debug)]
pub enum Heard {
    /// A desired state, not verified.
    Desired {
        /// As it was signed.
        envelope: Box<Envelope>,
        /// Blobs that came along, only reached by the digests it names.
        inline: Inline,
        /// Whether it is the server's answer to this robot; what a broker brings may be anybody's.
        was_asked_for: bool,
    },
    /// The server has nothing newer.
    Unchanged,
    /// A report is stored.
    Confirmed {
        /// Which.
        seq: u64,
        /// What the server said, if it was asked over HTTP.
        reply: Option<ReportReply>,
    },
    /// The server does not accept this robot's token, for the reason that it gives.
    TokenRefused(String),
    /// The server knows the robot and sends it no state now.
    Withheld {
        /// The server's code.
        code: String,
        /// Its text.
        text: String,
    },
}

/// What driver and link share. The driver writes reports and whether it keeps to its state, the
/// link the rest.
#[derive(Clone)]
pub struct Shared {
    /// The newest report.
    pub reports: watch::Sender<Option<Arc<Report>>>,
    /// The sequence number of the newest report that is stored.
    pub confirmed: watch::Sender<u64>,
    /// Whether the robot keeps to the state it has for some time; otherwise the server is asked for
    /// all of it again.
    pub settled: watch::Sender<bool>,
    /// Where the MQTT session goes; `None`: where whoever keeps it was told at first.
    pub endpoint: watch::Sender<Option<MqttEndpoint>>,
    /// How often the server has answered where it goes, with something new or not.
    pub endpoint_answers: watch::Sender<u64>,
    /// Asks the server where it goes.
    pub find: Arc<Notify>,
    /// Whether a session is up.
    pub mqtt_up: watch::Sender<bool>,
    /// Whether the first try to get one is over.
    pub mqtt_tried: watch::Sender<bool>,
    /// Whether one is up whose acknowledgements come from the server itself: then it takes reports.
    pub mqtt_stores: watch::Sender<bool>,
    /// Says that the server did not accept the token.
    pub token_refused: Arc<Notify>,
    /// Asks for a poll now.
    pub poll: Arc<Notify>,
    /// Asks for a report over HTTP now, whether MQTT is up or not.
    pub post: Arc<Notify>,
    /// Whose parts are wanted.
    pub listening: Listening,
    /// What is measured of the link.
    pub meter: LinkMeter,
    /// The agent ends.
    pub shutdown: CancellationToken,
}

/// What goes between an MQTT session and those in the agent who answer and tell. Both ways are
/// bounded and lossy: nothing in them outlives its moment.
pub struct Talk {
    /// Where questions that came in go, each with when it came.
    pub requests: mpsc::Sender<(Request, Instant)>,
    /// What is to be published.
    pub messages: mpsc::Receiver<Message>,
    /// Log lines to be published, a batch at a time: the next is taken when the one before has
    /// arrived.
    pub lines: mpsc::Receiver<Vec<u8>>,
}

/// Something a robot says that is neither report nor status.
#[derive(Debug)]
pub struct Message {
    /// On which of its topics.
    pub topic: RobotTopic,
    /// The bytes.
    pub payload: Vec<u8>,
}

/// How often to poll.
#[derive(Debug, Clone, Copy)]
pub struct Intervals {
    /// While MQTT is up.
    pub slow: Duration,
    /// While it is not.
    pub fast: Duration,
}

impl Shared {
    /// Nothing said yet.
    pub fn new(shutdown: CancellationToken) -> Self {
        Self {
            reports: watch::Sender::new(None),
            confirmed: watch::Sender::new(0),
            settled: watch::Sender::new(false),
            endpoint: watch::Sender::new(None),
            endpoint_answers: watch::Sender::new(0),
            find: Arc::default(),
            mqtt_up: watch::Sender::new(false),
            mqtt_tried: watch::Sender::new(false),
            mqtt_stores: watch::Sender::new(false),
            token_refused: Arc::default(),
            poll: Arc::default(),
            post: Arc::default(),
            listening: Listening::default(),
            meter: LinkMeter::default(),
            shutdown,
        }
    }
}

/// The link's half over HTTP, until the agent ends. MQTT goes first, for as long as a try may take:
/// a session brings the same with less, above all where a whole fleet starts at once.
pub async fn over_http(
    server: Server,
    shared: Shared,
    intervals: Intervals,
    heard: mpsc::Sender<Heard>,
) {
    let mut tried = shared.mqtt_tried.subscribe();
    tokio::select! {
        // Cancel-safe: a watch remembers what it holds, a token can be awaited again.
        _ = tried.wait_for(|tried| *tried) => {}
        () = shared.shutdown.cancelled() => return,
    }
    let polling = poll(server.clone(), shared.clone(), intervals, heard.clone());
    let stores = *shared.mqtt_stores.borrow();
    let asking = async {
        if !stores {
            return;
        }
        tokio::time::sleep(FIRST_POST.mul_f64(rand::random())).await;
        shared.post.notify_one();
    };
    tokio::join!(polling, post(server, shared.clone(), heard), asking);
}

/// Polls for the desired state, until the agent ends: at once, unless a session is up, which is
/// told it without asking.
pub async fn poll(
    server: Server,
    shared: Shared,
    intervals: Intervals,
    heard: mpsc::Sender<Heard>,
) {
    let mut tag = None;
    if *shared.mqtt_up.borrow() && !next_poll(&shared, intervals, Duration::ZERO).await {
        return;
    }
    loop {
        let known = tag.as_ref().filter(|_| *shared.settled.borrow());
        let begun = Instant::now();
        let outcome = server.desired(known).await;
        // An MQTT session measures more often and without a connection to be made first.
        if outcome.is_ok() && !*shared.mqtt_up.borrow() {
            shared.meter.round_trip(begun.elapsed());
        }
        let least = match &outcome {
            // Spread like all else: whoever was put out together does not ask together.
            Err(ServerError::TokenRefused(_)) => REFUSED_POLL.min(intervals.slow).mul_f64(spread()),
            Err(ServerError::Busy { retry_after: Some(wait), .. }) => (*wait).min(intervals.slow),
            _ => Duration::ZERO,
        };
        if let Ok(Some(sent)) = &outcome {
            tag.clone_from(&sent.tag);
        }
        if matches!(outcome, Err(ServerError::TokenRefused(_))) {
            shared.token_refused.notify_one();
        }
        if heard.send(heard_of(outcome)).await.is_err()
            || !next_poll(&shared, intervals, least).await
        {
            return;
        }
    }
}

/// Waits until it is time to poll, at least for `least`; false if the agent ends.
async fn next_poll(shared: &Shared, intervals: Intervals, least: Duration) -> bool {
    let mut mqtt_up = shared.mqtt_up.subscribe();
    let (asked_at, spread) = (Instant::now(), spread());
    loop {
        let up = *mqtt_up.borrow_and_update();
        let interval =
            (if up { intervals.slow } else { intervals.fast }).mul_f64(spread).max(least);
        tokio::select! {
            // Cancel-safe: a timer that is made anew for the same time, so that a session that
            // comes and goes does not put polling off for ever.
            () = tokio::time::sleep_until(asked_at + interval) => {
                // A report over HTTP brings the name and labels the server holds, which MQTT does
                // not.
                shared.post.notify_one();
                return true;
            }
            // Cancel-safe: a permit that was not taken stays.
            () = shared.poll.notified() => return true,
            // Cancel-safe: a watch remembers that it changed. The other interval holds from now on.
            Ok(()) = mqtt_up.changed() => {}
            // Cancel-safe: a token can be awaited again.
            () = shared.shutdown.cancelled() => return false,
        }
    }
}

fn heard_of(outcome: Result<Option<Sent>, ServerError>) -> Heard {
    match outcome {
        Ok(Some(sent)) => Heard::Desired {
            envelope: Box::new(sent.envelope),
            inline: Inline::default(),
            was_asked_for: true,
        },
        Ok(None) => Heard::Unchanged,
        Err(ServerError::TokenRefused(why)) => Heard::TokenRefused(why),
        Err(ServerError::Refused { code, message }) => Heard::Withheld { code, text: message },
        Err(error) => {
            tracing::info!(error = %chain(&error), "no desired state over HTTP");
            Heard::Withheld { code: "server_unreachable".to_owned(), text: chain(&error) }
        }
    }
}

/// Delivers reports over HTTP while no MQTT session stores them, and when it is asked to while one
/// does, until the agent ends.
pub async fn post(server: Server, shared: Shared, heard: mpsc::Sender<Heard>) {
    let (mut reports, mut mqtt_stores) =
        (shared.reports.subscribe(), shared.mqtt_stores.subscribe());
    let mut asked = !*mqtt_stores.borrow();
    let mut failures = 0;
    loop {
        let newest = reports.borrow_and_update().clone();
        let stores = *mqtt_stores.borrow_and_update();
        let due =
            newest.filter(|report| asked || (!stores && report.seq > *shared.confirmed.borrow()));
        let mut retry = Duration::MAX;
        if let Some(report) = due {
            match server.report(&report).await {
                Ok(reply) => {
                    (asked, failures) = (false, 0);
                    shared
                        .confirmed
                        .send_modify(|confirmed| *confirmed = (*confirmed).max(report.seq));
                    // A broker that is not the server's may have lost the doorbell.
                    if !stores
                        && *shared.mqtt_up.borrow()
                        && reply.generation > report.observed_generation
                    {
                        shared.poll.notify_one();
                    }
                    if heard
                        .send(Heard::Confirmed { seq: report.seq, reply: Some(reply) })
                        .await
                        .is_err()
                    {
                        return;
                    }
                    continue;
                }
                Err(error) => {
                    tracing::info!(error = %chain(&error), "no report over HTTP");
                    failures += 1;
                    retry = Duration::from_millis(
                        backoff_ms(failures, MAX_POST_BACKOFF_MS, rand::random()).max(100),
                    );
                    match error {
                        ServerError::Busy { retry_after: Some(wait), .. } => {
                            retry = retry.max(wait.min(REFUSED_POLL))
                        }
                        ServerError::TokenRefused(why) => {
                            // What changes that is noticed by polling.
                            retry = REFUSED_POLL.mul_f64(spread());
                            if heard.send(Heard::TokenRefused(why)).await.is_err() {
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
                // Nothing failed: a new report goes out at once.
                let _ = reports.changed().await;
            } else {
                tokio::time::sleep(retry).await;
            }
        };
        tokio::select! {
            // Cancel-safe: a watch remembers that it changed, a timer is made anew.
            () = newer => {}
            // Cancel-safe: a watch remembers that it changed.
            Ok(()) = mqtt_stores.changed() => {}
            // Cancel-safe: a permit that was not taken stays.
            () = shared.post.notified() => asked = true,
            // Cancel-safe: a token can be awaited again.
            () = shared.shutdown.cancelled() => return,
        }
    }
}

/// Between half and one and a half, so that a fleet that began together does not poll together.
pub(crate) fn spread() -> f64 {
    0.5 + rand::random::<f64>()
}
