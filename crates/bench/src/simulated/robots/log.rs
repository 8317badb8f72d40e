//! The log of a process's robots: a line for each session, desired state, start of a task and
//! acknowledged report, as the robot saw them. The database is compared with this log.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufWriter, Write as _};
use std::path::Path;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use task_agent::link::state::LinkState;
use task_proto::messages::report::{Phase, Report};
use task_proto::{DeploymentId, TaskName};
use tokio::sync::mpsc;

use crate::system::clock::monotonic_ns;

/// Lines that were not written yet. When it is full, robots wait.
const QUEUED_LINES: usize = 16 * 1024;
/// Reports that a robot sent and that were not acknowledged yet; older ones are forgotten.
const KEPT_REPORTS: usize = 64;

/// A line of the log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogLine {
    /// Number of the robot.
    pub robot: usize,
    /// Nanoseconds of the machine's monotonic clock.
    pub at_ns: u64,
    #[serde(flatten)]
    pub event: LoggedEvent,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum LoggedEvent {
    /// An MQTT session began.
    Connected,
    /// The MQTT session ended.
    Disconnected,
    /// The first report shows this deployment: the robot has verified the signed state with it.
    Received { deployment: DeploymentId },
    /// A process of a task was started.
    Started { deployment: DeploymentId, run: u64 },
    /// The server has acknowledged, and so stored, a report.
    Acknowledged {
        start: u64,
        seq: u64,
        generation: u64,
        /// From sending the report until now; absent if the report is too long ago.
        took_ns: Option<u64>,
        /// The tasks in the report; empty if the report is too long ago.
        tasks: Vec<LoggedTask>,
    },
}

/// A task in a report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoggedTask {
    pub task: TaskName,
    pub deployment: DeploymentId,
    pub run: u64,
    pub phase: Phase,
}

/// Writes the lines of one robot.
#[derive(Debug, Clone)]
pub struct RobotLog {
    robot: usize,
    lines: mpsc::Sender<LogLine>,
}

impl RobotLog {
    /// Opens the log of a process; the returned sender is for all of its robots.
    pub fn open(path: &Path) -> anyhow::Result<mpsc::Sender<LogLine>> {
        let file = std::fs::File::create(path).with_context(|| path.display().to_string())?;
        let (lines, queued) = mpsc::channel(QUEUED_LINES);
        std::thread::spawn(move || write_lines(BufWriter::new(file), queued));
        Ok(lines)
    }

    pub fn of(robot: usize, lines: mpsc::Sender<LogLine>) -> Self {
        Self { robot, lines }
    }

    pub async fn write(&self, event: LoggedEvent) {
        let line = LogLine { robot: self.robot, at_ns: monotonic_ns(), event };
        // The writer ends with the process or with a full disk, which the missing lines show.
        let _ = self.lines.send(line).await;
    }
}

/// Writes all lines at hand, then waits for more.
fn write_lines(
    mut file: BufWriter<std::fs::File>,
    mut queued: mpsc::Receiver<LogLine>,
) -> std::io::Result<()> {
    let mut batch = Vec::new();
    while queued.blocking_recv_many(&mut batch, QUEUED_LINES) > 0 {
        for line in batch.drain(..) {
            serde_json::to_writer(&mut file, &line).map_err(std::io::Error::other)?;
            file.write_all(b"\n")?;
        }
        file.flush()?;
    }
    Ok(())
}

/// Logs a robot's sessions, states and acknowledged reports until the robot ends.
pub async fn log_link(log: RobotLog, link_state: LinkState) {
    let mut reports = link_state.reports.subscribe();
    let mut confirmed = link_state.confirmed.subscribe();
    let mut mqtt = link_state.mqtt.subscribe();
    let mut sent: BTreeMap<u64, (u64, std::sync::Arc<Report>)> = BTreeMap::new();
    let mut received: BTreeSet<DeploymentId> = BTreeSet::new();
    let (mut acknowledged, mut is_up) = (0, false);
    loop {
        let report = reports.borrow_and_update().clone();
        if let Some(report) = report {
            for task in &report.tasks {
                if received.insert(task.deployment.clone()) {
                    let deployment = task.deployment.clone();
                    log.write(LoggedEvent::Received { deployment }).await;
                }
            }
            sent.entry(report.seq).or_insert((monotonic_ns(), report));
            while sent.len() > KEPT_REPORTS {
                sent.pop_first();
            }
        }
        let stored = *confirmed.borrow_and_update();
        if stored > acknowledged {
            acknowledged = stored;
            log.write(acknowledgement(stored, &sent)).await;
            sent = sent.split_off(&(stored + 1));
        }
        let up = mqtt.borrow_and_update().is_up();
        if up != is_up {
            is_up = up;
            let event = if up { LoggedEvent::Connected } else { LoggedEvent::Disconnected };
            log.write(event).await;
        }
        let changed = tokio::select! {
            // All cancel-safe: a watch remembers that its value changed.
            changed = reports.changed() => changed,
            changed = confirmed.changed() => changed,
            changed = mqtt.changed() => changed,
        };
        if changed.is_err() {
            return;
        }
    }
}

fn acknowledgement(seq: u64, sent: &BTreeMap<u64, (u64, std::sync::Arc<Report>)>) -> LoggedEvent {
    let Some((at_ns, report)) = sent.get(&seq) else {
        return LoggedEvent::Acknowledged {
            start: 0,
            seq,
            generation: 0,
            took_ns: None,
            tasks: Vec::new(),
        };
    };
    let task = |task: &task_proto::messages::report::TaskReport| LoggedTask {
        task: task.task.clone(),
        deployment: task.deployment.clone(),
        run: task.run,
        phase: task.phase,
    };
    LoggedEvent::Acknowledged {
        start: report.start,
        seq,
        generation: report.observed_generation.0,
        took_ns: Some(monotonic_ns().saturating_sub(*at_ns)),
        tasks: report.tasks.iter().map(task).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_is_read_back() {
        let line = LogLine {
            robot: 7,
            at_ns: 12,
            event: LoggedEvent::Acknowledged {
                start: 1,
                seq: 3,
                generation: 2,
                took_ns: Some(5),
                tasks: vec![LoggedTask {
                    task: "a".parse().expect("a name"),
                    deployment: DeploymentId::random(),
                    run: 1,
                    phase: Phase::Running,
                }],
            },
        };
        let text = serde_json::to_string(&line).expect("json");
        assert_eq!(serde_json::from_str::<LogLine>(&text).expect("a line"), line);
    }
}
