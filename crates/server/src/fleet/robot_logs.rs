//! The last log lines of each robot, and the robot's followers. In memory only: lines that a robot
//! published by itself stay until newer lines replace them; the full log is on the robot. This
//! module never sends requests to a robot.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::RobotId;
use task_proto::telemetry::log::{LogBatch, LogLevel, LogLine, MAX_BATCH_LINES, MAX_LINE_BYTES};
use tokio::sync::{Notify, broadcast};

/// Maximum lines in memory for one robot.
const MAX_ROBOT_LINES: usize = 200;
/// Maximum bytes in memory for all robots; each has an equal share, if needed.
const MAX_BYTES: usize = 64 * 1024 * 1024;
/// Memory of a line besides its texts.
const LINE_OVERHEAD_BYTES: usize = 160;
/// A robot's publishing limit per second, and its burst.
const BYTES_PER_S: u64 = 256 * 1024;
const BURST_BYTES: u64 = 1024 * 1024;
/// Maximum batches that a slow follower may lag before it misses some.
const BACKLOG: usize = 64;

/// The lines of all robots; clones share them.
#[derive(Clone)]
pub struct RobotLogs {
    state: Arc<Mutex<State>>,
    max_bytes: usize,
}

#[derive(Default)]
struct State {
    robots: HashMap<RobotId, LineBuffer>,
    bytes: usize,
    followed: HashMap<RobotId, FollowedRobot>,
    followers: u64,
}

/// One robot's last lines.
#[derive(Default)]
struct LineBuffer {
    lines: VecDeque<LogLine>,
    bytes: usize,
    /// The robot's clock and ours when the last batch arrived.
    robot_ms: u64,
    received_ms: u64,
    suppressed: u64,
    /// The robot's remaining publishing budget, and the time of that value.
    budget_bytes: u64,
    budget_ms: u64,
}

/// The robot's lines that the server holds in memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogSnapshot {
    pub lines: Vec<LogLine>,
    /// The robot's clock when the lines arrived.
    pub robot_ms: u64,
    /// Our clock when the lines arrived.
    pub received_ms: u64,
    /// Lines that were left out, for as long as the lines around them are in memory.
    pub suppressed: u64,
}

/// An event for followers.
#[derive(Debug, Clone)]
pub enum FollowEvent {
    /// The robot has confirmed that it publishes.
    Following {
        /// Publishing had stopped for a while, so lines may be missing.
        again: bool,
    },
    /// The robot can't be reached.
    Away(Arc<str>),
    /// The robot has a session at another server, where its followers have to ask anew.
    Moved,
    Lines(Arc<LogBatch>),
}

struct FollowedRobot {
    events: broadcast::Sender<FollowEvent>,
    levels: BTreeMap<u64, LogLevel>,
    changed: Arc<Notify>,
}

/// A follower's place; following ends when this is dropped.
pub struct Follower {
    logs: RobotLogs,
    robot: RobotId,
    number: u64,
}

/// The place of a new follower, and its events.
pub struct Subscription {
    pub follower: Follower,
    /// The events for the follower.
    pub events: broadcast::Receiver<FollowEvent>,
    /// Whether this is the first follower. Then the caller must request publishing from the robot,
    /// for as long as there are followers.
    pub is_first: bool,
}

impl RobotLogs {
    /// Starts without lines and followers.
    pub fn new() -> Self {
        Self { state: Arc::default(), max_bytes: MAX_BYTES }
    }

    /// Whether `robot` may publish this many bytes now. Ask before reading them.
    pub fn admits(&self, robot: &RobotId, bytes: usize, now_ms: u64) -> bool {
        let mut state = self.state();
        let buffer = state.robots.entry(robot.clone()).or_insert_with(|| LineBuffer {
            budget_bytes: BURST_BYTES,
            budget_ms: now_ms,
            ..LineBuffer::default()
        });
        let earned = now_ms.saturating_sub(buffer.budget_ms).saturating_mul(BYTES_PER_S) / 1000;
        buffer.budget_bytes = buffer.budget_bytes.saturating_add(earned).min(BURST_BYTES);
        buffer.budget_ms = now_ms;
        let left = buffer.budget_bytes.checked_sub(bytes as u64);
        buffer.budget_bytes = left.unwrap_or(buffer.budget_bytes);
        left.is_some()
    }

    /// Stores a robot's batch, and hands it to the followers.
    pub fn record(&self, mut batch: LogBatch, now_ms: u64) {
        batch.lines.truncate(MAX_BATCH_LINES);
        batch.lines.iter_mut().for_each(|line| line.text = one_line(&line.text));
        let mut state = self.state();
        let share = self.max_bytes / state.robots.len().max(1);
        let buffer = state.robots.entry(batch.robot_id.clone()).or_default();
        let before = buffer.bytes;
        (buffer.robot_ms, buffer.received_ms) = (batch.now_ms, now_ms);
        buffer.suppressed = buffer.suppressed.saturating_add(batch.suppressed);
        for line in &batch.lines {
            buffer.bytes += size(line);
            buffer.lines.push_back(line.clone());
        }
        buffer.shrink(share);
        let after = buffer.bytes;
        state.bytes = state.bytes + after - before;
        if state.bytes > self.max_bytes {
            // Frees more than needed, or the next line would cause the same work again.
            state.shrink(share / 4 * 3);
        }
        if let Some(followed) = state.followed.get(&batch.robot_id) {
            // The followers may just have left.
            let _ = followed.events.send(FollowEvent::Lines(Arc::new(batch)));
        }
    }

    /// The lines of `robot` in memory.
    pub fn snapshot(&self, robot: &RobotId) -> Option<LogSnapshot> {
        let state = self.state();
        let buffer = state.robots.get(robot).filter(|buffer| buffer.received_ms > 0)?;
        let LineBuffer { robot_ms, received_ms, suppressed, .. } = *buffer;
        Some(LogSnapshot {
            lines: buffer.lines.iter().cloned().collect(),
            robot_ms,
            received_ms,
            suppressed,
        })
    }

    /// Forgets a removed robot. The streams of its followers end.
    pub fn forget(&self, robot: &RobotId) {
        let mut state = self.state();
        let bytes = state.robots.remove(robot).map_or(0, |buffer| buffer.bytes);
        state.bytes -= bytes;
        if let Some(followed) = state.followed.remove(robot) {
            // The task that sends requests to the robot has no robot any more.
            followed.changed.notify_one();
        }
    }

    /// Follows `robot`: lines of `level` and above.
    pub fn follow(&self, robot: &RobotId, level: LogLevel) -> Subscription {
        let mut state = self.state();
        state.followers += 1;
        let number = state.followers;
        let is_first = !state.followed.contains_key(robot);
        let followed = state.followed.entry(robot.clone()).or_insert_with(|| FollowedRobot {
            events: broadcast::Sender::new(BACKLOG),
            levels: BTreeMap::new(),
            changed: Arc::default(),
        });
        followed.levels.insert(number, level);
        followed.changed.notify_one();
        let events = followed.events.subscribe();
        Subscription {
            follower: Follower { logs: self.clone(), robot: robot.clone(), number },
            events,
            is_first,
        }
    }

    /// The lowest level that the followers of `robot` want; `None` without followers. The task that
    /// sends requests to the robot then ends, and the next follower is a first one.
    pub fn requested_level(&self, robot: &RobotId) -> Option<LogLevel> {
        let mut state = self.state();
        let level = state.followed.get(robot)?.levels.values().min().copied();
        if level.is_none() {
            state.followed.remove(robot);
        }
        level
    }

    /// Wakes when the followers of `robot` change, or when the robot has reconnected.
    pub fn changed(&self, robot: &RobotId) -> Option<Arc<Notify>> {
        Some(self.state().followed.get(robot)?.changed.clone())
    }

    /// The robot has reconnected: it may have forgotten that it has followers.
    pub fn connected(&self, robot: &RobotId) {
        if let Some(followed) = self.state().followed.get(robot) {
            followed.changed.notify_one();
        }
    }

    /// Sends an event to the followers of `robot`.
    pub fn notify_followers(&self, robot: &RobotId, event: FollowEvent) {
        if let Some(followed) = self.state().followed.get(robot) {
            // The followers may just have left.
            let _ = followed.events.send(event);
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Default for RobotLogs {
    fn default() -> Self {
        Self::new()
    }
}

impl State {
    fn shrink(&mut self, share: usize) {
        self.robots.values_mut().for_each(|buffer| buffer.shrink(share));
        self.bytes = self.robots.values().map(|buffer| buffer.bytes).sum();
    }
}

impl LineBuffer {
    fn shrink(&mut self, share: usize) {
        while self.lines.len() > MAX_ROBOT_LINES || self.bytes > share {
            let Some(oldest) = self.lines.pop_front() else { break };
            self.bytes -= size(&oldest);
        }
        // A large batch leaves unused capacity behind, which counts as much as lines do.
        if self.lines.capacity() > 2 * self.lines.len() {
            self.lines.shrink_to_fit();
        }
    }
}

impl Drop for Follower {
    fn drop(&mut self) {
        if let Some(followed) = self.logs.state().followed.get_mut(&self.robot) {
            followed.levels.remove(&self.number);
            followed.changed.notify_one();
        }
    }
}

fn size(line: &LogLine) -> usize {
    let task_bytes = line.task.as_ref().map_or(0, |task| task.as_str().len());
    let node_bytes = line.node.as_ref().map_or(0, |node| node.as_str().len());
    line.text.len() + task_bytes + node_bytes + LINE_OVERHEAD_BYTES
}

/// Normalizes a text: on one line, of a bounded length.
fn one_line(text: &str) -> String {
    let cut = &text[..text.floor_char_boundary(MAX_LINE_BYTES)];
    cut.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::telemetry::log::LogSource;

    fn batch(robot: &RobotId, texts: impl IntoIterator<Item = String>) -> LogBatch {
        let line = |text| LogLine {
            at_ms: 1,
            level: LogLevel::Warn,
            source: LogSource::Stderr,
            task: None,
            node: None,
            text,
        };
        LogBatch {
            robot_id: robot.clone(),
            now_ms: 5,
            lines: texts.into_iter().map(line).collect(),
            suppressed: 1,
        }
    }

    fn texts(logs: &RobotLogs, robot: &RobotId) -> Vec<String> {
        logs.snapshot(robot).map_or_else(Vec::new, |buffer| {
            buffer.lines.into_iter().map(|line| line.text).collect()
        })
    }

    #[test]
    fn newest_lines_of_each_robot_are_remembered() {
        let (logs, robot) = (RobotLogs::new(), RobotId::random());
        assert_eq!(logs.snapshot(&robot), None);
        for number in 0..3 {
            logs.record(batch(&robot, (0..100).map(|line| format!("{number} {line}"))), 9);
        }
        let buffer = logs.snapshot(&robot).expect("remembered");
        assert_eq!((buffer.robot_ms, buffer.received_ms, buffer.suppressed), (5, 9, 3));
        assert_eq!((buffer.lines.len(), buffer.lines[0].text.as_str()), (MAX_ROBOT_LINES, "1 0"));
        logs.forget(&robot);
        assert_eq!((texts(&logs, &robot).len(), logs.state().bytes), (0, 0));
    }

    #[test]
    fn total_memory_is_bounded_and_shared_by_all_robots() {
        let logs = RobotLogs { max_bytes: 100_000, ..RobotLogs::new() };
        let robots: Vec<RobotId> = (0..50).map(|_| RobotId::random()).collect();
        for robot in &robots {
            logs.record(batch(robot, (0..100).map(|line| format!("line {line}"))), 9);
            assert!(logs.state().bytes <= 100_000);
        }
        for robot in &robots {
            logs.record(batch(robot, ["the last".to_owned()]), 9);
        }
        let bytes: usize = logs.state().robots.values().map(|buffer| buffer.bytes).sum();
        assert_eq!(bytes, logs.state().bytes);
        assert!(
            robots
                .iter()
                .all(|robot| texts(&logs, robot).last().is_some_and(|text| text == "the last"))
        );
        assert!(
            robots.iter().all(|robot| texts(&logs, robot).len() > 1),
            "each robot keeps some lines"
        );
        let has_room = |buffer: &LineBuffer| buffer.lines.capacity() > 2 * buffer.lines.len();
        assert!(!logs.state().robots.values().any(has_room), "unused capacity is released");
    }

    #[test]
    fn published_lines_are_bounded_and_sanitized() {
        let (logs, robot) = (RobotLogs::new(), RobotId::random());
        let burst = (0..).take_while(|_| logs.admits(&robot, 100 * 1024, 1000)).count();
        assert_eq!(burst as u64, BURST_BYTES / (100 * 1024));
        assert!(!logs.admits(&robot, 100 * 1024, 1100) && logs.admits(&robot, 100 * 1024, 1500));
        assert_eq!(logs.snapshot(&robot), None, "nothing was published yet");
        logs.record(batch(&robot, ["a\u{1b}[31mb\nc".to_owned(), "é".repeat(MAX_LINE_BYTES)]), 9);
        let shown = texts(&logs, &robot);
        assert_eq!(shown[0], "a\u{fffd}[31mb\u{fffd}c");
        assert!(shown[1].len() <= MAX_LINE_BYTES);
    }

    #[tokio::test]
    async fn following_ends_with_the_robot() {
        let (logs, robot) = (RobotLogs::new(), RobotId::random());
        let mut subscription = logs.follow(&robot, LogLevel::Info);
        let changed = logs.changed(&robot).expect("followed");
        logs.forget(&robot);
        assert!(matches!(
            subscription.events.recv().await,
            Err(broadcast::error::RecvError::Closed)
        ));
        changed.notified().await;
        assert_eq!(logs.requested_level(&robot), None, "the requesting task stops");
        drop(subscription);
        assert!(logs.state().followed.is_empty());
    }

    #[test]
    fn first_follower_requests_lines_for_all() {
        let (logs, robot) = (RobotLogs::new(), RobotId::random());
        let mut first = logs.follow(&robot, LogLevel::Warn);
        let second = logs.follow(&robot, LogLevel::Debug);
        assert!(first.is_first && !second.is_first);
        assert_eq!(logs.requested_level(&robot), Some(LogLevel::Debug));
        drop(second);
        assert_eq!(logs.requested_level(&robot), Some(LogLevel::Warn));
        logs.record(batch(&robot, ["x".to_owned()]), 9);
        assert!(
            matches!(first.events.try_recv(), Ok(FollowEvent::Lines(batch)) if batch.lines[0].text == "x")
        );
        drop(first.follower);
        assert!(
            !logs.follow(&robot, LogLevel::Info).is_first,
            "the requesting task has not noticed yet"
        );
        assert_eq!(logs.requested_level(&robot), None);
        assert!(logs.follow(&robot, LogLevel::Info).is_first);
    }
}
