//! Publishes log lines as they are written: normally only the important ones, more while a client
//! follows, and never more than the link can carry. Excess lines are counted and stay in the log
//! files. The files are the queue: no lines wait in memory while the server can't be reached, and a
//! batch is only made when the link has room for it.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use task_proto::telemetry::log::{LogBatch, LogLevel, LogLine, MAX_BATCH_LINES};
use task_proto::{RobotId, TaskName};
use tokio::sync::{mpsc, watch};

use super::line::{Deduplicator, Entry, LogFile};
use super::record::Record;
use super::tail::Tail;
use super::{Following, files};
use crate::system::clock;
use crate::system::layout::DataDir;

/// Selection of the log lines that go to the server while no client follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ForwardSettings {
    /// Only lines of this level and more serious ones.
    pub level: LogLevel,
    /// Maximum lines a second for each task.
    pub lines_per_s: u32,
}

/// Interval between two looks at the files.
const PAUSE: Duration = Duration::from_millis(500);
/// Interval between two looks at the files while a client follows.
const FOLLOWED_PAUSE: Duration = Duration::from_millis(200);
/// Maximum lines a second for each task while a client follows.
const FOLLOWED_LINES_PER_S: u32 = 200;
/// Burst limit: the lines of this many seconds may come at once.
const BURST_S: u32 = 10;
/// Approximate maximum size of a batch, because a report may wait behind it on a slow link.
const BATCH_BYTES: usize = 32 * 1024;
/// Maximum bytes of all files that are examined in one pass.
const MAX_PASS_BYTES: usize = 4 * 1024 * 1024;
/// Maximum bytes of a log written without a link that are published afterwards.
const MISSED_BYTES: u64 = 64 * 1024;
/// Interval at which a count is published when no line is.
const COUNT_INTERVAL: Duration = Duration::from_secs(5);

/// Publishes lines until the agent ends.
pub struct Forwarder {
    settings: watch::Receiver<ForwardSettings>,
    following: watch::Receiver<Option<Following>>,
    builder: BatchBuilder,
}

impl Forwarder {
    /// A forwarder of the lines that are added to the logs of `data` from now on.
    pub fn new(
        robot_id: RobotId,
        data: DataDir,
        settings: watch::Receiver<ForwardSettings>,
        following: watch::Receiver<Option<Following>>,
    ) -> Self {
        let mut builder = BatchBuilder::new(robot_id, data);
        builder.skip(0);
        Self { settings, following, builder }
    }

    /// Puts batches, as JSON, into `batches` while a session is up and accepts them.
    pub async fn run<S: Copy>(
        mut self,
        mut session: watch::Receiver<S>,
        is_up: impl Fn(S) -> bool,
        batches: mpsc::Sender<Vec<u8>>,
    ) {
        loop {
            let was_up = is_up(*session.borrow());
            if session.wait_for(|session| is_up(*session)).await.is_err() {
                return;
            }
            let Ok(room) = batches.reserve().await else { return };
            let filter = LineFilter::new(
                *self.settings.borrow(),
                *self.following.borrow_and_update(),
                Instant::now(),
            );
            let mut builder = self.builder;
            let built = tokio::task::spawn_blocking(move || {
                if !was_up {
                    builder.skip(MISSED_BYTES);
                }
                let batch = builder.next_batch(&filter, Instant::now());
                (builder, batch)
            });
            let Ok((builder, batch)) = built.await else { return };
            self.builder = builder;
            match batch.as_ref().map(serde_json::to_vec) {
                Some(Ok(payload)) => room.send(payload),
                Some(Err(error)) => tracing::error!(%error, "log lines can't be written as JSON"),
                None => drop(room),
            }
            let pause = if self.builder.has_more { Duration::ZERO } else { filter.pause };
            tokio::select! {
                // Cancel-safe: a timer that is made anew each time.
                () = tokio::time::sleep(pause) => {}
                // Cancel-safe: a watch remembers that it changed. Without a sender no client will
                // follow.
                Ok(()) = self.following.changed() => {}
            }
        }
    }
}

/// Selection of the lines that are published now.
#[derive(Debug, Clone, Copy)]
struct LineFilter {
    level: LogLevel,
    lines_per_s: u32,
    /// Whether to include lines that belong to none of our tasks.
    others: bool,
    pause: Duration,
}

impl LineFilter {
    fn new(settings: ForwardSettings, following: Option<Following>, now: Instant) -> Self {
        let ForwardSettings { level, lines_per_s } = settings;
        match following.filter(|following| now < following.until) {
            None => Self { level, lines_per_s, others: false, pause: PAUSE },
            Some(following) => Self {
                level: level.min(following.level),
                lines_per_s: lines_per_s.max(FOLLOWED_LINES_PER_S),
                others: true,
                pause: FOLLOWED_PAUSE,
            },
        }
    }
}

/// Read position of each log, and counts of the lines left out.
struct BatchBuilder {
    robot_id: RobotId,
    data: DataDir,
    tails: BTreeMap<PathBuf, Tail>,
    budgets: BTreeMap<Option<TaskName>, Budget>,
    deduplicator: Deduplicator,
    suppressed: u64,
    counted_at: Option<Instant>,
    has_more: bool,
    /// Index of the file that comes first in the next batch.
    next: usize,
}

/// Remaining line budget of a task.
#[derive(Debug)]
struct Budget {
    lines: f64,
    at: Instant,
}

impl BatchBuilder {
    fn new(robot_id: RobotId, data: DataDir) -> Self {
        Self {
            robot_id,
            data,
            tails: BTreeMap::new(),
            budgets: BTreeMap::new(),
            deduplicator: Deduplicator::default(),
            suppressed: 0,
            counted_at: None,
            has_more: false,
            next: 0,
        }
    }

    /// Moves each log's position to at most `bytes` before its end.
    fn skip(&mut self, bytes: u64) {
        for file in files(&self.data) {
            self.tails.entry(file.path.clone()).or_default().skip(&file.path, bytes);
        }
    }

    /// The next batch, if there are lines or counts to publish.
    fn next_batch(&mut self, filter: &LineFilter, now: Instant) -> Option<LogBatch> {
        let mut files = files(&self.data);
        self.tails.retain(|path, _| files.iter().any(|file| file.path == *path));
        self.budgets.retain(|task, _| files.iter().any(|file| file.task == *task));
        let mut batch = PartialBatch::default();
        let mut room = MAX_PASS_BYTES;
        // A file with more lines than fit into a batch leaves the next batch to the files after it.
        let first = std::mem::take(&mut self.next).checked_rem(files.len()).unwrap_or_default();
        files.rotate_left(first);
        self.has_more = false;
        for (index, file) in files.iter().enumerate() {
            if file.task.is_none() && !filter.others {
                self.tails.entry(file.path.clone()).or_default().skip(&file.path, 0);
            } else if !self.has_more {
                self.read(file, filter, now, &mut batch, &mut room);
                self.has_more = batch.is_full() || room == 0;
                self.next = if self.has_more { first + index + 1 } else { 0 };
            }
        }
        let is_due = || self.counted_at.is_none_or(|at| now.duration_since(at) >= COUNT_INTERVAL);
        if batch.lines.is_empty() && (self.suppressed == 0 || !is_due()) {
            return None;
        }
        self.counted_at = Some(now);
        batch.lines.sort_by_key(|line| line.at_ms);
        let suppressed = std::mem::take(&mut self.suppressed);
        Some(LogBatch {
            robot_id: self.robot_id.clone(),
            now_ms: clock::wall_ms(),
            lines: batch.lines,
            suppressed,
        })
    }

    fn read(
        &mut self,
        file: &LogFile,
        filter: &LineFilter,
        now: Instant,
        batch: &mut PartialBatch,
        room: &mut usize,
    ) {
        let Self { tails, budgets, deduplicator, suppressed, .. } = self;
        let burst = filter.lines_per_s.saturating_mul(BURST_S);
        let budget =
            budgets.entry(file.task.clone()).or_insert(Budget { lines: f64::from(burst), at: now });
        budget.refill(filter.lines_per_s, now);
        let each = |line: &[u8]| {
            let record = Record::parse(line);
            if record.level(file.unmarked) < filter.level {
                return true;
            }
            if budget.lines < 1.0 {
                // Telling whether the line is the second of two is not worth the cost.
                *suppressed += 1;
                return true;
            }
            let Some(entry) = Entry::of(&record, file, clock::wall_ms()) else { return true };
            if deduplicator.is_duplicate(&entry) {
                return true;
            }
            budget.lines -= 1.0;
            batch.add(entry.line);
            !batch.is_full()
        };
        if let Err(error) = tails.entry(file.path.clone()).or_default().read(&file.path, room, each)
        {
            tracing::debug!(path = %file.path.display(), %error, "a log can't be read");
        }
    }
}

impl Budget {
    fn refill(&mut self, lines_per_s: u32, now: Instant) {
        let earned = now.duration_since(self.at).as_secs_f64() * f64::from(lines_per_s);
        self.lines = (self.lines + earned).min(f64::from(lines_per_s.saturating_mul(BURST_S)));
        self.at = now;
    }
}

/// A batch under construction.
#[derive(Default)]
struct PartialBatch {
    lines: Vec<LogLine>,
    bytes: usize,
}

impl PartialBatch {
    fn add(&mut self, line: LogLine) {
        self.bytes += serde_json::to_vec(&line).map_or(0, |json| json.len() + 1);
        self.lines.push(line);
    }

    fn is_full(&self) -> bool {
        self.lines.len() >= MAX_BATCH_LINES || self.bytes >= BATCH_BYTES
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use task_proto::telemetry::log::LogSource;
    use task_proto::time::timestamp;

    use super::*;
    use crate::logs::record;

    const QUIET: ForwardSettings = ForwardSettings { level: LogLevel::Warn, lines_per_s: 10 };

    struct Bench {
        _temp: tempfile::TempDir,
        data: DataDir,
        builder: BatchBuilder,
        now: Instant,
    }

    impl Bench {
        fn new() -> Self {
            let temp = tempfile::tempdir().unwrap();
            let data = DataDir::new(temp.path()).unwrap();
            let builder = BatchBuilder::new("r00000000000000a1".parse().unwrap(), data.clone());
            Self { _temp: temp, data, builder, now: Instant::now() }
        }

        fn say(&self, task: &str, source: LogSource, lines: impl IntoIterator<Item = String>) {
            let task = self.data.task(&task.parse().unwrap());
            std::fs::create_dir_all(task.logs()).unwrap();
            let mut log = Vec::new();
            for line in lines {
                record::write(
                    &mut log,
                    &timestamp(clock::wall_ms()),
                    source,
                    false,
                    line.as_bytes(),
                );
            }
            let path = if source == LogSource::Rosout { task.ros_log() } else { task.output_log() };
            std::fs::OpenOptions::new()
                .append(true)
                .create(true)
                .open(path)
                .unwrap()
                .write_all(&log)
                .unwrap();
        }

        /// The batch published `later` than the last one: the texts, and the number of lines left
        /// out.
        fn next_batch(
            &mut self,
            later: Duration,
            following: Option<LogLevel>,
        ) -> (Vec<String>, u64) {
            self.now += later;
            let following = following
                .map(|level| Following { level, until: self.now + Duration::from_secs(1) });
            let filter = LineFilter::new(QUIET, following, self.now);
            let batch = self.builder.next_batch(&filter, self.now);
            batch.map_or_else(Default::default, |batch| {
                (batch.lines.into_iter().map(|line| line.text).collect(), batch.suppressed)
            })
        }
    }

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn warnings_are_published_and_more_while_a_client_follows() {
        let mut bench = Bench::new();
        bench.say("one", LogSource::Stdout, ["info".to_owned()]);
        bench.say(
            "one",
            LogSource::Stderr,
            ["warn".to_owned(), "[DEBUG] [1.0] [n]: debug".to_owned()],
        );
        assert_eq!(bench.next_batch(SECOND, None), (vec!["warn".to_owned()], 0));
        assert_eq!(
            bench.next_batch(SECOND, Some(LogLevel::Debug)),
            (vec![], 0),
            "skipped lines are kept, not sent"
        );
        bench.say("one", LogSource::Stdout, ["more".to_owned()]);
        assert_eq!(bench.next_batch(SECOND, Some(LogLevel::Info)), (vec!["more".to_owned()], 0));
    }

    #[test]
    fn flood_of_one_task_is_counted_and_suppresses_no_other() {
        let mut bench = Bench::new();
        bench.say("loud", LogSource::Stderr, (0..100_000).map(|number| format!("line {number}")));
        bench.say("quiet", LogSource::Stderr, ["help".to_owned()]);
        let mut sent = Vec::new();
        let mut left_out = 0;
        loop {
            let (lines, suppressed) = bench.next_batch(Duration::ZERO, None);
            sent.extend(lines);
            left_out += suppressed;
            if !bench.builder.has_more {
                break;
            }
        }
        assert_eq!(sent.len(), 101, "a burst of one task, and the other's line");
        assert!(sent.contains(&"help".to_owned()));
        let (lines, suppressed) = bench.next_batch(COUNT_INTERVAL, None);
        assert_eq!((lines, left_out + suppressed), (vec![], 99_900));
        bench.say("loud", LogSource::Stderr, (0..100).map(|number| format!("later {number}")));
        let (lines, suppressed) = bench.next_batch(Duration::ZERO, None);
        assert_eq!((lines.len(), suppressed), (50, 50), "ten lines for each second that passed");
    }

    #[test]
    fn task_that_fills_every_batch_does_not_starve_others() {
        let mut bench = Bench::new();
        let long = "x".repeat(3000);
        for task in ["one", "two"] {
            bench.say(
                task,
                LogSource::Stderr,
                (0..60).map(|number| format!("{task} {number} {long}")),
            );
        }
        let first_of_both: String =
            (0..2).map(|_| bench.next_batch(Duration::ZERO, None).0.remove(0)).collect();
        assert!(
            first_of_both.contains("one 0") && first_of_both.contains("two 0"),
            "{first_of_both:.40}"
        );
    }

    #[test]
    fn large_output_is_split_into_small_batches() {
        let mut bench = Bench::new();
        let long = "x".repeat(3000);
        bench.say("one", LogSource::Stderr, (0..60).map(|number| format!("{number} {long}")));
        let (first, _) = bench.next_batch(Duration::ZERO, None);
        assert!(bench.builder.has_more && first.len() < 15, "{}", first.len());
        let mut all = first;
        while bench.builder.has_more {
            all.extend(bench.next_batch(Duration::ZERO, None).0);
        }
        assert_eq!(all.len(), 60);
        assert!(
            all.iter().enumerate().all(|(number, line)| line.starts_with(&format!("{number} ")))
        );
    }

    #[test]
    fn message_on_console_and_rosout_is_published_once() {
        let mut bench = Bench::new();
        bench.say("one", LogSource::Stderr, ["[WARN] [1.123456789] [n]: low".to_owned()]);
        bench.say(
            "one",
            LogSource::Rosout,
            ["[WARN] [1.123] [n]: low".to_owned(), "[WARN] [2.000] [n]: only here".to_owned()],
        );
        assert_eq!(
            bench.next_batch(SECOND, None),
            (vec!["low".to_owned(), "only here".to_owned()], 0)
        );
    }

    #[test]
    fn only_the_last_lines_are_published_after_a_lost_link() {
        let mut bench = Bench::new();
        bench.builder.skip(0);
        bench.say("one", LogSource::Stderr, (0..10_000).map(|number| format!("line {number}")));
        bench.builder.skip(MISSED_BYTES);
        let (lines, suppressed) = bench.next_batch(Duration::ZERO, None);
        assert_eq!(lines.len(), 100);
        assert!((1000..3000).contains(&suppressed), "{suppressed}");
    }
}
