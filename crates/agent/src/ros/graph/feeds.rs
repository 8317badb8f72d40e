//! Feeds of messages from all nodes: log lines on `/rosout` and statuses on `/diagnostics`. Each
//! topic is read once, from the first subscription on, and forwarded to all subscribers. A
//! subscriber that is too slow is told how many messages it missed.

use std::collections::BTreeMap;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};

use futures_util::StreamExt;
use ros2_client::Log;
use ros2_client::builtin_interfaces::Time;
use serde::{Deserialize, Serialize};
use task_proto::telemetry::log::LogLevel;
use task_proto::telemetry::ros::GraphName;
use tokio::sync::{broadcast, watch};
use tokio_util::sync::CancellationToken;

use super::{EndpointId, GraphError, ParticipantId, Snapshot};
use crate::ros::graph::dds::endpoint::{Cdr, Delivery, Endpoints, Reader, Sample};
use crate::ros::graph::dds::names::{self, Role};

/// Maximum number of messages that wait for a slow subscriber.
pub const CAPACITY: usize = 1024;
/// Maximum length of a message's text in bytes; a longer one is cut.
pub const MAX_TEXT_BYTES: usize = 8 * 1024;
/// Maximum number of statuses in one message on `/diagnostics`, and of values in one status.
pub const MAX_STATUSES: usize = 256;
/// Maximum total size of the values of one status, in bytes: many statuses may wait for a slow
/// subscriber.
const MAX_VALUES_BYTES: usize = 16 * 1024;
/// Maximum number of writers with a remembered sequence number.
const MAX_WRITERS: usize = 4096;

/// A log line of a node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RosoutLine {
    /// Time of the line by the node's clock: milliseconds since the Unix epoch.
    pub at_ms: u64,
    /// Severity of the line.
    pub level: LogLevel,
    /// The node, if the logger belongs to one.
    pub node: Option<GraphName>,
    /// The logger's name: the node's name with dots, possibly with a suffix.
    pub logger: String,
    /// Text of the line.
    pub text: String,
    /// Source file of the log statement.
    pub file: String,
    /// Line number in the source file.
    pub line: u32,
    /// The participant that sent the line.
    pub participant: ParticipantId,
    /// Number of messages of the same writer that were lost right before this one.
    pub lost: u64,
}

/// Condition of a part of the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DiagnosticLevel {
    /// The part is in order.
    Ok,
    /// The part reports a warning.
    Warn,
    /// The part reports an error.
    Error,
    /// No data about the part has come, or the level is unknown to this version.
    #[serde(other)]
    Stale,
}

/// A status on `/diagnostics`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiagnosticStatus {
    /// Time of the status by the node's clock: milliseconds since the Unix epoch.
    pub at_ms: u64,
    /// Condition of the part.
    pub level: DiagnosticLevel,
    /// Subject of the status.
    pub name: String,
    /// Description of the condition.
    pub message: String,
    /// Id of the part.
    pub hardware_id: String,
    /// Values with their names.
    pub values: Vec<(String, String)>,
    /// The participant that sent the status.
    pub participant: ParticipantId,
}

#[derive(Deserialize)]
struct DiagnosticArray {
    stamp: Time,
    #[expect(dead_code, reason = "part of the message's form")]
    frame_id: String,
    status: Vec<Status>,
}

#[derive(Deserialize)]
struct Status {
    level: u8,
    name: String,
    message: String,
    hardware_id: String,
    values: Vec<(String, String)>,
}

/// The feeds with at least one subscriber.
#[derive(Default)]
pub struct Feeds {
    rosout: Mutex<Option<broadcast::Sender<Arc<RosoutLine>>>>,
    diagnostics: Mutex<Option<broadcast::Sender<Arc<DiagnosticStatus>>>>,
}

/// A task to spawn.
type FeedTask = std::pin::Pin<Box<dyn Future<Output = ()> + Send>>;

impl Feeds {
    /// A subscription to `/rosout`, and the reading task if there was none. The first subscriber
    /// gets the last lines from before.
    pub fn rosout(
        &self,
        endpoints: &Endpoints,
        snapshot: watch::Receiver<Arc<Snapshot>>,
        closing: &CancellationToken,
    ) -> Result<(broadcast::Receiver<Arc<RosoutLine>>, Option<FeedTask>), GraphError> {
        let read = || {
            let delivery = Delivery::Lasting { depth: 500 };
            let reader = reader(endpoints, "/rosout", "rcl_interfaces/msg/Log", delivery)?;
            let mut gaps = GapCounter::default();
            let lines = move |sample: Sample<Cdr>| {
                let log: Log = sample.message.value(0)?;
                let lost = gaps.count_missing(sample.writer, sample.number);
                Some(vec![RosoutLine::of(
                    log,
                    sample.writer.participant(),
                    lost,
                    &snapshot.borrow(),
                )])
            };
            Ok((reader, lines))
        };
        subscribe(&self.rosout, closing, read)
    }

    /// A subscription to `/diagnostics`, and the reading task if there was none.
    pub fn diagnostics(
        &self,
        endpoints: &Endpoints,
        closing: &CancellationToken,
    ) -> Result<(broadcast::Receiver<Arc<DiagnosticStatus>>, Option<FeedTask>), GraphError> {
        let read = || {
            let delivery = Delivery::Reliable { depth: 100 };
            let reader =
                reader(endpoints, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", delivery)?;
            let statuses = |sample: Sample<Cdr>| {
                let array: DiagnosticArray = sample.message.value(0)?;
                let stamp = array.stamp;
                let participant = sample.writer.participant();
                let statuses = array.status.into_iter().take(MAX_STATUSES);
                Some(
                    statuses
                        .map(|status| DiagnosticStatus::of(status, stamp, participant))
                        .collect(),
                )
            };
            Ok((reader, statuses))
        };
        subscribe(&self.diagnostics, closing, read)
    }
}

fn reader(
    endpoints: &Endpoints,
    topic: &str,
    kind: &str,
    delivery: Delivery,
) -> Result<Reader<Cdr>, GraphError> {
    let invalid = || GraphError::Kind(kind.to_owned());
    let topic = topic.parse().map_err(|_| invalid())?;
    let kind = names::type_to_dds(Role::Topic, kind).ok_or_else(invalid)?;
    endpoints.reader(&names::to_dds(Role::Topic, &topic), &kind, delivery)
}

/// Joins the feed that is being read, or starts one.
fn subscribe<T, M>(
    feed: &Mutex<Option<broadcast::Sender<Arc<T>>>>,
    closing: &CancellationToken,
    read: impl FnOnce() -> Result<(Reader<Cdr>, M), GraphError>,
) -> Result<(broadcast::Receiver<Arc<T>>, Option<FeedTask>), GraphError>
where
    T: Send + Sync + 'static,
    M: FnMut(Sample<Cdr>) -> Option<Vec<T>> + Send + 'static,
{
    let mut feed = feed.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(sender) = &*feed {
        return Ok((sender.subscribe(), None));
    }
    let (reader, mut messages) = read()?;
    let (sender, receiver) = broadcast::channel(CAPACITY);
    *feed = Some(sender.clone());
    let closing = closing.clone();
    let task = async move {
        let mut samples = pin!(reader.samples());
        while let Some(Some(sample)) = closing.run_until_cancelled(samples.next()).await {
            for message in messages(sample).into_iter().flatten() {
                // Without a current subscriber the message is dropped, not kept for later.
                let _ = sender.send(Arc::new(message));
            }
        }
    };
    Ok((receiver, Some(Box::pin(task))))
}

/// Finds gaps in writers' sequence numbers.
#[derive(Default)]
struct GapCounter {
    last: BTreeMap<EndpointId, i64>,
}

impl GapCounter {
    fn count_missing(&mut self, writer: EndpointId, number: i64) -> u64 {
        if self.last.len() >= MAX_WRITERS && !self.last.contains_key(&writer) {
            self.last.clear();
        }
        let last = self.last.insert(writer, number);
        last.map_or(0, |last| {
            u64::try_from(number.saturating_sub(last).saturating_sub(1)).unwrap_or(0)
        })
    }
}

impl RosoutLine {
    fn of(log: Log, participant: ParticipantId, lost: u64, snapshot: &Snapshot) -> Self {
        let level = match log.level {
            0..=10 => LogLevel::Debug,
            11..=20 => LogLevel::Info,
            21..=30 => LogLevel::Warn,
            31..=40 => LogLevel::Error,
            _ => LogLevel::Fatal,
        };
        Self {
            at_ms: millis(log.stamp),
            level,
            node: node_of(&log.name, participant, snapshot),
            logger: cut(log.name),
            text: cut(log.msg),
            file: cut(log.file),
            line: log.line,
            participant,
            lost,
        }
    }
}

impl DiagnosticStatus {
    fn of(status: Status, stamp: Time, participant: ParticipantId) -> Self {
        let level = match status.level {
            0 => DiagnosticLevel::Ok,
            1 => DiagnosticLevel::Warn,
            2 => DiagnosticLevel::Error,
            _ => DiagnosticLevel::Stale,
        };
        let mut left = MAX_VALUES_BYTES;
        let values = status
            .values
            .into_iter()
            .take(MAX_STATUSES)
            .map(|(name, value)| (cut(name), cut(value)));
        let values = values.take_while(|(name, value)| {
            let fits = name.len() + value.len() <= left;
            left = left.saturating_sub(name.len() + value.len());
            fits
        });
        Self {
            at_ms: millis(stamp),
            level,
            name: cut(status.name),
            message: cut(status.message),
            hardware_id: cut(status.hardware_id),
            values: values.collect(),
            participant,
        }
    }
}

/// The participant's node that owns this logger: `/robot/talker` owns `robot.talker`, and all
/// loggers below it.
fn node_of(logger: &str, participant: ParticipantId, snapshot: &Snapshot) -> Option<GraphName> {
    let is_of = |node: &GraphName| {
        let name = node.as_str().trim_start_matches('/').replace('/', ".");
        logger.strip_prefix(&name).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    let nodes =
        snapshot.nodes.iter().filter(|node| node.participant == participant && is_of(&node.name));
    // A line may come before its node is known; a logger that looks like a whole node name counts
    // as one.
    let known = nodes.map(|node| node.name.clone()).max_by_key(|name| name.as_str().len());
    known.or_else(|| format!("/{}", logger.replace('.', "/")).parse().ok())
}

fn millis(stamp: Time) -> u64 {
    u64::try_from(stamp.to_nanos() / 1_000_000).unwrap_or(0)
}

fn cut(mut text: String) -> String {
    text.truncate(text.floor_char_boundary(MAX_TEXT_BYTES));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_in_numbers_are_lost_messages() {
        let mut gaps = GapCounter::default();
        let one = EndpointId([1; 16]);
        let two = EndpointId([2; 16]);
        let found = [
            (one, 7),
            (two, 1),
            (one, 8),
            (one, 12),
            (two, 2),
            (one, 3),
            (one, i64::MAX),
            (one, i64::MIN),
        ]
        .map(|(writer, number)| gaps.count_missing(writer, number));
        assert_eq!(found[..6], [0, 0, 0, 3, 0, 0]);
        assert_eq!(found[7], 0);
    }

    #[test]
    fn long_texts_are_cut_between_characters() {
        let text = cut("\u{20ac}".repeat(MAX_TEXT_BYTES));
        assert!(text.len() <= MAX_TEXT_BYTES && text.len() > MAX_TEXT_BYTES - 3);
        assert_eq!(cut("short".to_owned()), "short");
    }

    #[test]
    fn logger_belongs_to_its_node() {
        let mut snapshot = Snapshot::empty(std::time::Instant::now());
        let participant = ParticipantId([1; 12]);
        for name in ["/robot/talker", "/robot/talker/inner", "/other"] {
            let (publishers, subscriptions, services, clients) = Default::default();
            let name = name.parse().expect("name");
            let node = super::super::Node {
                name,
                participant,
                publishers,
                subscriptions,
                services,
                clients,
            };
            snapshot.nodes.push(node);
        }
        let found = |logger| node_of(logger, participant, &snapshot).map(|name| name.to_string());
        assert_eq!(found("robot.talker").as_deref(), Some("/robot/talker"));
        assert_eq!(found("robot.talker.child").as_deref(), Some("/robot/talker"));
        assert_eq!(found("robot.talker.inner.x").as_deref(), Some("/robot/talker/inner"));
        assert_eq!(found("robot.talkers").as_deref(), Some("/robot/talkers"));
        assert_eq!(found("not a name"), None);
    }
}
