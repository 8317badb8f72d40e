//! Determines the level, node and text of a stored line. Nodes send most messages twice, on
//! `/rosout` and on their standard error; the second is recognized by the node's own time. This
//! module reads no file.

use std::path::PathBuf;

use task_proto::TaskName;
use task_proto::telemetry::log::{LogLine, LogSource};

use super::console;
use super::record::Record;
use crate::system::recent_set::RecentSet;

/// Number of lines among which the second of two is searched.
const DEDUPLICATION_WINDOW: usize = 4096;
/// A node's time is accepted only within this distance of the robot's time: it may be a simulated
/// one.
const MAX_SKEW_MS: u64 = 5 * 60 * 1000;

/// A file of stored lines; older ones may be beside it with `.1`, `.2`, … added.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogFile {
    /// Path of the newest file.
    pub path: PathBuf,
    /// The task of the log; `None`: none of our tasks.
    pub task: Option<TaskName>,
    /// Source of lines that name none.
    pub unmarked: LogSource,
}

/// A line as shown to users, with the key that its duplicate would have.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    pub line: LogLine,
    key: Option<MessageKey>,
}

/// Fields that both forms of a node's message share: the sender, and the millisecond by the node's
/// clock.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct MessageKey {
    logger: String,
    stamp: String,
}

/// The recent messages of nodes.
#[derive(Debug, Default)]
pub struct Deduplicator(RecentSet<(MessageKey, LogSource), DEDUPLICATION_WINDOW>);

impl Entry {
    /// The entry for `record` of `file`; `None` if it has no text. `at_ms` is for a record without
    /// a time.
    pub fn of(record: &Record, file: &LogFile, at_ms: u64) -> Option<Self> {
        let at_ms = record.at_ms.unwrap_or(at_ms);
        let source = record.source.unwrap_or(file.unmarked);
        let text = console::printable(record.text);
        let parsed = console::parse(&text);
        let level = parsed.map_or_else(|| Record::level_of_source(source), |parsed| parsed.level);
        let logger = parsed.and_then(|parsed| parsed.logger);
        let node = logger.and_then(console::node_of);
        let stamp = parsed.and_then(|parsed| parsed.stamp);
        let key = logger.zip(stamp).map(|(logger, stamp)| MessageKey::new(logger, stamp));
        let shown = match parsed {
            // A logger name that belongs to no node stays in the text.
            Some(parsed) if logger.is_some() == node.is_some() => parsed.text,
            _ => &text,
        };
        let line = LogLine {
            at_ms: stamp
                .and_then(millis)
                .filter(|ms| ms.abs_diff(at_ms) < MAX_SKEW_MS)
                .unwrap_or(at_ms),
            level,
            source,
            task: file.task.clone(),
            node,
            text: shown.to_owned(),
        };
        (!line.text.is_empty()).then_some(Self { line, key })
    }
}

impl MessageKey {
    fn new(logger: &str, stamp: &str) -> Self {
        // The console shows nanoseconds; stored lines of the topic have milliseconds.
        let (seconds, fraction) = stamp.split_once('.').unwrap_or((stamp, ""));
        let stamp = format!("{seconds}.{:0<3.3}", fraction);
        Self { logger: logger.to_owned(), stamp }
    }
}

/// The milliseconds since the Unix epoch that a node wrote as `1700000000.123456789`; of several
/// times, the first.
fn millis(stamp: &str) -> Option<u64> {
    let (seconds, fraction) = stamp.split(',').next()?.trim().split_once('.')?;
    let fraction: u64 = format!("{fraction:0<3.3}").parse().ok()?;
    seconds.parse::<u64>().ok()?.checked_mul(1000)?.checked_add(fraction)
}

impl Deduplicator {
    /// Whether the same message came before by another way.
    pub fn is_duplicate(&mut self, entry: &Entry) -> bool {
        let Some(key) = &entry.key else { return false };
        let others = [LogSource::Stdout, LogSource::Stderr, LogSource::Rosout].into_iter();
        let mut others = others.filter(|source| *source != entry.line.source);
        if others.any(|source| self.0.contains(&(key.clone(), source))) {
            return true;
        }
        self.0.insert((key.clone(), entry.line.source));
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::telemetry::log::LogLevel;

    fn entry(line: &str) -> Option<Entry> {
        let file = LogFile {
            path: PathBuf::new(),
            task: Some("talker".parse().unwrap()),
            unmarked: LogSource::Stdout,
        };
        Entry::of(&Record::parse(line.as_bytes()), &file, 7)
    }

    #[test]
    fn line_is_shown_without_its_parsed_fields() {
        let line = entry("2026-11-21T10:00:00.123Z E [ERROR] [1.5] [robot.talker]: no \x1b[31mway")
            .unwrap()
            .line;
        assert_eq!(
            (line.level, line.source, line.text.as_str()),
            (LogLevel::Error, LogSource::Stderr, "no way")
        );
        assert_eq!(line.node.unwrap().as_str(), "/robot/talker");
        let at_ms = |line: &str| entry(line).unwrap().line.at_ms;
        assert_eq!(
            at_ms("1970-01-01T00:00:07.500Z O [INFO] [7.123456789] [n]: x"),
            7123,
            "by the node's own clock"
        );
        assert_eq!(
            at_ms("1970-01-01T01:00:00.000Z O [INFO] [7.1, 3.0]: x"),
            3_600_000,
            "but not by a simulated one"
        );
        let line = entry("[INFO] [1.5] [talker-1]: up").unwrap().line;
        assert_eq!((line.at_ms, line.source, line.node), (1500, LogSource::Stdout, None));
        assert_eq!(line.text, "[INFO] [1.5] [talker-1]: up");
        assert_eq!(entry(""), None);
        assert_eq!(entry("2026-11-21T10:00:00.123Z O \x1b[0m"), None);
    }

    #[test]
    fn duplicate_message_is_shown_once_but_repeats_are_kept() {
        let console = entry("2026-11-21T10:00:00.123Z E [INFO] [1.5] [talker]: tick").unwrap();
        let rosout = entry("2026-11-21T10:00:00.120Z R [INFO] [1.5] [talker]: tick").unwrap();
        let other = entry("2026-11-21T10:00:00.120Z R [INFO] [1.6] [talker]: tick").unwrap();
        for (first, second) in [(&console, &rosout), (&rosout, &console)] {
            let mut deduplicator = Deduplicator::default();
            assert!(
                !deduplicator.is_duplicate(first) && !deduplicator.is_duplicate(first),
                "two messages in one nanosecond"
            );
            assert!(deduplicator.is_duplicate(second) && !deduplicator.is_duplicate(&other));
        }
    }
}
