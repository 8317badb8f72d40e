//! Records the messages of nodes on `/rosout` and `/diagnostics`, in console format, in the logs of
//! the task whose process sent them. Messages that belong to no task go to a separate log. The
//! contents of messages influence no decision.

use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use task_proto::TaskName;
use task_proto::telemetry::log::{LogLevel, LogSource};
use task_proto::time::timestamp;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::mpsc;

use crate::logs::LogSpec;
use crate::logs::RotatedLog;
use crate::logs::record;
use crate::process::containment::RUN_DIR_VARIABLE;
use crate::process::program::{ProcessEntry, environments};
use crate::ros::graph::{DiagnosticLevel, DiagnosticStatus, Graph, ParticipantId, RosoutLine};
use crate::system::clock;
use crate::system::layout::DataDir;

/// Maximum number of messages that wait for the disk.
const QUEUED_MESSAGES: usize = 1024;
/// Maximum number of statuses of which the last value is remembered.
const MAX_STATUSES: usize = 4096;
/// Interval until the owner of a participant without a task is looked up again.
const REFRESH_INTERVAL: Duration = Duration::from_secs(2);
/// Minimum interval between two look-ups of participants.
const LOOKUP_PAUSE: Duration = Duration::from_millis(200);
/// Maximum time for discovery to show a participant after its first message.
const DISCOVERY: Duration = Duration::from_secs(1);
/// Number of files of each log.
const FILES: u32 = 2;

/// Messages to be written.
enum Message {
    Line(Arc<RosoutLine>, Option<TaskName>),
    Status(Arc<DiagnosticStatus>, Option<TaskName>),
    Missed(u64),
}

/// Records the messages on `graph` until it is closed.
pub async fn record_messages(graph: Graph, data: DataDir, log_bytes: Option<u64>) {
    let (mut rosout, mut diagnostics) = match (graph.rosout(), graph.diagnostics()) {
        (Ok(rosout), Ok(diagnostics)) => (rosout, diagnostics),
        (Err(error), _) | (_, Err(error)) => {
            tracing::warn!(%error, "messages of ROS nodes are not recorded");
            return;
        }
    };
    let (messages, waiting) = mpsc::channel(QUEUED_MESSAGES);
    let recorder = Recorder::new(data.clone(), log_bytes);
    tokio::task::spawn_blocking(move || recorder.run(waiting));
    let mut tasks = TaskLookup { data, known: HashMap::new(), looked_up_at: None };
    let mut missed = 0;
    let mut changes = graph.changes();
    let mut missed_before = 0;
    loop {
        let message = tokio::select! {
            // Cancel-safe: a message stays in the channel until it is received.
            line = rosout.recv() => match line {
                Ok(line) => {
                    let task = tasks.task_of(&graph, line.participant).await;
                    Message::Line(line, task)
                }
                Err(RecvError::Lagged(count)) => Message::Missed(count),
                Err(RecvError::Closed) => return,
            },
            // Cancel-safe, for the same reason.
            status = diagnostics.recv() => match status {
                Ok(status) => {
                    let task = tasks.task_of(&graph, status.participant).await;
                    Message::Status(status, task)
                }
                Err(RecvError::Lagged(count)) => Message::Missed(count),
                Err(RecvError::Closed) => return,
            },
            // Cancel-safe: a watch remembers that it changed. It ends with the graph.
            changed = changes.changed() => match changed {
                Ok(()) => continue,
                Err(_) => return,
            },
        };
        let missed_so_far = graph.missed_messages();
        let more =
            missed_so_far.saturating_sub(std::mem::replace(&mut missed_before, missed_so_far));
        missed = u64::saturating_add(missed, more);
        if missed > 0 && messages.try_send(Message::Missed(missed)).is_ok() {
            missed = 0;
        }
        // The disk can't keep up: messages are dropped and counted.
        missed += u64::from(messages.try_send(message).is_err());
    }
}

/// The tasks whose processes take part in the graph.
struct TaskLookup {
    data: DataDir,
    known: HashMap<ParticipantId, Option<TaskName>>,
    looked_up_at: Option<Instant>,
}

impl TaskLookup {
    async fn task_of(&mut self, graph: &Graph, participant: ParticipantId) -> Option<TaskName> {
        let pause = match self.known.get(&participant) {
            Some(Some(task)) => return Some(task.clone()),
            Some(None) => REFRESH_INTERVAL,
            None => LOOKUP_PAUSE,
        };
        if self.looked_up_at.is_some_and(|at| at.elapsed() < pause) {
            return None;
        }
        let mut changes = graph.changes();
        let shown = changes.wait_for(|snapshot| snapshot.participants.contains_key(&participant));
        // A participant that discovery does not show has no known owner.
        let _ = tokio::time::timeout(DISCOVERY, shown).await;
        let snapshot = graph.snapshot();
        self.looked_up_at = Some(Instant::now());
        self.known.retain(|participant, _| snapshot.participants.contains_key(participant));
        let data = self.data.clone();
        let pids =
            tokio::task::spawn_blocking(move || pids_by_task(&data)).await.unwrap_or_default();
        for (task, pids) in pids {
            let owners = Graph::owners(snapshot.clone(), pids).await;
            self.known.extend(
                owners.theirs.into_iter().map(|participant| (participant, Some(task.clone()))),
            );
        }
        self.known.entry(participant).or_default().clone()
    }
}

/// The processes of each task, by the run directory in their environment.
fn pids_by_task(data: &DataDir) -> Vec<(TaskName, Vec<u32>)> {
    let tasks = data.task_names().unwrap_or_default();
    let mut found: BTreeMap<TaskName, Vec<u32>> = BTreeMap::new();
    let run_dirs = environments::read_all(ProcessEntry::all().unwrap_or_default(), |process| {
        process.variable(RUN_DIR_VARIABLE)
    });
    for (process, run_dir) in run_dirs {
        let Some(run_dir) = run_dir else { continue };
        let task = tasks
            .iter()
            .find(|task| std::path::Path::new(&run_dir).starts_with(data.task(task).run()));
        if let Some(task) = task {
            found.entry(task.clone()).or_default().push(process.pid);
        }
    }
    found.into_iter().collect()
}

/// Writes messages into the logs.
struct Recorder {
    data: DataDir,
    log_bytes: Option<u64>,
    logs: BTreeMap<Option<TaskName>, RotatedLog>,
    /// Last level and message of each part: only a change is logged.
    statuses: HashMap<(String, String), (DiagnosticLevel, String)>,
}

impl Recorder {
    fn new(data: DataDir, log_bytes: Option<u64>) -> Self {
        Self { data, log_bytes, logs: BTreeMap::new(), statuses: HashMap::new() }
    }

    fn run(mut self, mut messages: mpsc::Receiver<Message>) {
        while let Some(message) = messages.blocking_recv() {
            match message {
                Message::Line(line, task) => {
                    let stamp = seconds(line.at_ms);
                    let level = console_level(line.level);
                    let text = format!("[{level}] [{stamp}] [{}]: {}", line.logger, line.text);
                    self.write(task, LogSource::Rosout, &text);
                    if line.lost > 0 {
                        self.write(
                            None,
                            LogSource::Agent,
                            &format!("[WARN] {} lines of {} were lost", line.lost, line.logger),
                        );
                    }
                }
                Message::Status(status, task) => self.status(&status, task),
                Message::Missed(count) => {
                    self.write(
                        None,
                        LogSource::Agent,
                        &format!(
                            "[WARN] {count} messages of nodes were dropped: they came too fast"
                        ),
                    );
                }
            }
        }
    }

    fn status(&mut self, status: &DiagnosticStatus, task: Option<TaskName>) {
        if self.statuses.len() >= MAX_STATUSES {
            self.statuses.clear();
        }
        let part = (status.hardware_id.clone(), status.name.clone());
        let now = (status.level, status.message.clone());
        if self.statuses.insert(part, now.clone()).as_ref() == Some(&now) {
            return;
        }
        let level = match status.level {
            DiagnosticLevel::Ok => LogLevel::Info,
            DiagnosticLevel::Warn | DiagnosticLevel::Stale => LogLevel::Warn,
            DiagnosticLevel::Error => LogLevel::Error,
        };
        let stamp = seconds(status.at_ms);
        let level = console_level(level);
        let text = format!("[{level}] [{stamp}]: {}: {}", status.name, status.message);
        self.write(task, LogSource::Diagnostics, &text);
    }

    fn write(&mut self, task: Option<TaskName>, source: LogSource, text: &str) {
        let path = log_path(&self.data, task.as_ref());
        // A task that was removed has no directory any more, and this must not create one.
        let parent = path.parent().filter(|_| task.is_none());
        if let Some(Err(error)) = parent.map(std::fs::create_dir_all) {
            tracing::debug!(%error, "a message of a ROS node can't be recorded");
        }
        if !path.exists() {
            // The file was never created, or was removed with its task: a file that was open then
            // does not belong to the next task. Other removed files are closed too, because they
            // would keep their bytes on the disk.
            let data = &self.data;
            self.logs.retain(|task, _| log_path(data, task.as_ref()).exists());
        }
        let log = self.logs.entry(task).or_insert_with(|| {
            let mut spec = LogSpec::at(path);
            spec.files = FILES;
            spec.max_bytes = self.log_bytes.unwrap_or(spec.max_bytes);
            RotatedLog::new(spec)
        });
        let mut line = Vec::new();
        let text = text.replace('\n', " ⏎ ");
        let text = &text[..text.floor_char_boundary(record::MAX_TEXT_BYTES)];
        record::write(&mut line, &timestamp(clock::wall_ms()), source, false, text.as_bytes());
        log.write(&line);
    }
}

/// Path of the log for the messages of a task's nodes, or of nodes without a task.
fn log_path(data: &DataDir, task: Option<&TaskName>) -> PathBuf {
    task.map_or_else(|| data.ros_log(), |task| data.task(task).ros_log())
}

fn seconds(ms: u64) -> String {
    format!("{}.{:03}", ms / 1000, ms % 1000)
}

fn console_level(level: LogLevel) -> &'static str {
    match level {
        LogLevel::Debug => "DEBUG",
        LogLevel::Info => "INFO",
        LogLevel::Warn => "WARN",
        LogLevel::Error => "ERROR",
        LogLevel::Fatal => "FATAL",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::system::durable;

    #[test]
    fn task_installed_again_starts_a_new_log() {
        let temp = tempfile::tempdir().expect("temp dir");
        let data = DataDir::new(temp.path()).expect("data dir");
        let name: TaskName = "talker".parse().expect("valid");
        let task = data.task(&name);
        let mut recorder = Recorder::new(data.clone(), None);
        for text in ["first", "second"] {
            durable::create_dir_all(&task.logs()).expect("made");
            recorder.write(Some(name.clone()), LogSource::Rosout, text);
            let log = std::fs::read_to_string(task.ros_log()).expect("a log");
            assert!(log.contains(text), "{log}");
            task.remove().expect("removed");
        }
    }
}
