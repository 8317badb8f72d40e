//! The last log lines of each robot, and the robot's followers. In memory only: lines that a robot
//! published by itself stay until newer lines replace them; the full log is on the robot. This
//! module never sends requests to a robot.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::RobotId;
use task_proto::log::{LogBatch, LogLevel, LogLine, MAX_BATCH_LINES, MAX_LINE_BYTES};
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
    robots: HashMap<RobotId, Kept>,
    bytes: usize,
    followed: HashMap<RobotId, Followed>,
    followers: u64,
}

/// One robot's last lines.
#[derive(Default)]
struct Kept {
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
pub struct Remembered {
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
pub enum Told {
    /// The robot has confirmed that it publishes.
    Following {
        /// Publishing had stopped for a while, so lines may be missing.
        again: bool,
    },
    /// The robot can't be reached.
    Away(Arc<str>),
    Lines(Arc<LogBatch>),
}

struct Followed {
    told: broadcast::Sender<Told>,
    levels: BTreeMap<u64, LogLevel>,
    changed: Arc<Notify>,
}

/// A follower's place; following ends when this is dropped.
pub struct Follower {
    logs: RobotLogs,
    robot: RobotId,
    number: u64,
}

/// A new follower's place, and the follow-up work.
pub struct Joined {
    pub follower: Follower,
    /// The events for the follower.
    pub told: broadcast::Receiver<Told>,
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
        let kept = state.robots.entry(robot.clone()).or_insert_with(|| Kept {
            budget_bytes: BURST_BYTES,
            budget_ms: now_ms,
            ..Kept::default()
        });
        let earned = now_ms.saturating_sub(kept.budget_ms).saturating_mul(BYTES_PER_S) / 1000;
        kept.budget_bytes = kept.budget_bytes.saturating_add(earned).min(BURST_BYTES);
        kept.budget_ms = now_ms;
        let left = kept.budget_bytes.checked_sub(bytes as u64);
        kept.budget_bytes = left.unwrap_or(kept.budget_bytes);
        left.is_some()
    }

    /// Stores a robot's batch, and hands it to the followers.
    pub fn take(&self, mut batch: LogBatch, now_ms: u64) {
        batch.lines.truncate(MAX_BATCH_LINES);
        batch.lines.iter_mut().for_each(|line| line.text = one_line(&line.text));
        let mut state = self.state();
        let share = self.max_bytes / state.robots.len().max(1);
        let kept = state.robots.entry(batch.robot_id.clone()).or_default();
        let before = kept.bytes;
        (kept.robot_ms, kept.received_ms) = (batch.now_ms, now_ms);
        kept.suppressed = kept.suppressed.saturating_add(batch.suppressed);
        for line in &batch.lines {
            kept.bytes += size(line);
            kept.lines.push_back(line.clone());
        }
        kept.shrink(share);
        let after = kept.bytes;
        state.bytes = state.bytes + after - before;
        if state.bytes > self.max_bytes {
            // Frees more than needed, or the next line would cause the same work again.
            state.shrink(share / 4 * 3);
        }
        if let Some(followed) = state.followed.get(&batch.robot_id) {
            // The followers may just have left.
            let _ = followed.told.send(Told::Lines(Arc::new(batch)));
        }
    }

    /// The lines of `robot` in memory.
    pub fn remembered(&self, robot: &RobotId) -> Option<Remembered> {
        let state = self.state();
        let kept = state.robots.get(robot).filter(|kept| kept.received_ms > 0)?;
        let Kept { robot_ms, received_ms, suppressed, .. } = *kept;
        Some(Remembered {
            lines: kept.lines.iter().cloned().collect(),
            robot_ms,
            received_ms,
            suppressed,
        })
    }

    /// Forgets a removed robot. The streams of its followers end.
    pub fn forget(&self, robot: &RobotId) {
        let mut state = self.state();
        let bytes = state.robots.remove(robot).map_or(0, |kept| kept.bytes);
        state.bytes -= bytes;
        if let Some(followed) = state.followed.remove(robot) {
            // The task that sends requests to the robot has no robot any more.
            followed.changed.notify_one();
        }
    }

    /// Follows `robot`: lines of `level` and above.
    pub fn follow(&self, robot: &RobotId, level: LogLevel) -> Joined {
        let mut state = self.state();
        state.followers += 1;
        let number = state.followers;
        let is_first = !state.followed.contains_key(robot);
        let followed = state.followed.entry(robot.clone()).or_insert_with(|| Followed {
            told: broadcast::Sender::new(BACKLOG),
            levels: BTreeMap::new(),
            changed: Arc::default(),
        });
        followed.levels.insert(number, level);
        followed.changed.notify_one();
        let told = followed.told.subscribe();
        Joined {
            follower: Follower { logs: self.clone(), robot: robot.clone(), number },
            told,
            is_first,
        }
    }

    /// The lowest level that the followers of `robot` want; `None` without followers. The task that
    /// sends requests to the robot then ends, and the next follower is a first one.
    pub fn wanted(&self, robot: &RobotId) -> Option<LogLevel> {
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
    pub fn tell(&self, robot: &RobotId, told: Told) {
        if let Some(followed) = self.state().followed.get(robot) {
            // The followers may just have left.
            let _ = followed.told.send(told);
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
        self.robots.values_mut().for_each(|kept| kept.shrink(share));
        self.bytes = self.robots.values().map(|kept| kept.bytes).sum();
    }
}

impl Kept {
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
    use task_proto::log::LogSource;

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
        logs.remembered(robot)
            .map_or_else(Vec::new, |kept| kept.lines.into_iter().map(|line| line.text).collect())
    }

    #[test]
    fn the_newest_lines_of_each_robot_are_remembered() {
        let (logs, robot) = (RobotLogs::new(), RobotId::random());
        assert_eq!(logs.remembered(&robot), None);
        for number in 0..3 {
            logs.take(batch(&robot, (0..100).map(|line| format!("{number} {line}"))), 9);
        }
        let kept = logs.remembered(&robot).expect("remembered");
        assert_eq!((kept.robot_ms, kept.received_ms, kept.suppressed), (5, 9, 3));
        assert_eq!((kept.lines.len(), kept.lines[0].text.as_str()), (MAX_ROBOT_LINES, "1 0"));
        logs.forget(&robot);
        assert_eq!((texts(&logs, &robot).len(), logs.state().bytes), (0, 0));
    }

    #[test]
    fn all_robots_together_have_a_bound_and_each_its_share() {
        let logs = RobotLogs { max_bytes: 100_000, ..RobotLogs::new() };
        let robots: Vec<RobotId> = (0..50).map(|_| RobotId::random()).collect();
        for robot in &robots {
            logs.take(batch(robot, (0..100).map(|line| format!("line {line}"))), 9);
            assert!(logs.state().bytes <= 100_000);
        }
        for robot in &robots {
            logs.take(batch(robot, ["the last".to_owned()]), 9);
        }
        let bytes: usize = logs.state().robots.values().map(|kept| kept.bytes).sum();
        assert_eq!(bytes, logs.state().bytes);
        assert!(
            robots
                .iter()
                .all(|robot| texts(&logs, robot).last().is_some_and(|text| text == "the last"))
        );
        assert!(
            robots.iter().all(|robot| texts(&logs, robot).len() > 1),
            "nobody is left with nothing"
        );
        let has_room = |kept: &Kept| kept.lines.capacity() > 2 * kept.lines.len();
        assert!(
            !logs.state().robots.values().any(has_room),
            "room that no line needs is given back"
        );
    }

    #[test]
    fn what_a_robot_publishes_is_bounded_and_made_harmless() {
        let (logs, robot) = (RobotLogs::new(), RobotId::random());
        let burst = (0..).take_while(|_| logs.admits(&robot, 100 * 1024, 1000)).count();
        assert_eq!(burst as u64, BURST_BYTES / (100 * 1024));
        assert!(!logs.admits(&robot, 100 * 1024, 1100) && logs.admits(&robot, 100 * 1024, 1500));
        assert_eq!(logs.remembered(&robot), None, "nothing was published yet");
        logs.take(batch(&robot, ["a\u{1b}[31mb\nc".to_owned(), "é".repeat(MAX_LINE_BYTES)]), 9);
        let shown = texts(&logs, &robot);
        assert_eq!(shown[0], "a\u{fffd}[31mb\u{fffd}c");
        assert!(shown[1].len() <= MAX_LINE_BYTES);
    }

    #[tokio::test]
    async fn following_ends_with_the_robot() {
        let (logs, robot) = (RobotLogs::new(), RobotId::random());
        let mut joined = logs.follow(&robot, LogLevel::Info);
        let changed = logs.changed(&robot).expect("followed");
        logs.forget(&robot);
        assert!(matches!(joined.told.recv().await, Err(broadcast::error::RecvError::Closed)));
        changed.notified().await;
        assert_eq!(logs.wanted(&robot), None, "whoever asks it stops");
        drop(joined);
        assert!(logs.state().followed.is_empty());
    }

    #[test]
    fn one_follower_asks_the_robot_for_all() {
        let (logs, robot) = (RobotLogs::new(), RobotId::random());
        let mut first = logs.follow(&robot, LogLevel::Warn);
        let second = logs.follow(&robot, LogLevel::Debug);
        assert!(first.is_first && !second.is_first);
        assert_eq!(logs.wanted(&robot), Some(LogLevel::Debug));
        drop(second);
        assert_eq!(logs.wanted(&robot), Some(LogLevel::Warn));
        logs.take(batch(&robot, ["x".to_owned()]), 9);
        assert!(
            matches!(first.told.try_recv(), Ok(Told::Lines(batch)) if batch.lines[0].text == "x")
        );
        drop(first.follower);
        assert!(!logs.follow(&robot, LogLevel::Info).is_first, "whoever asks has not noticed yet");
        assert_eq!(logs.wanted(&robot), None);
        assert!(logs.follow(&robot, LogLevel::Info).is_first);
    }
}
