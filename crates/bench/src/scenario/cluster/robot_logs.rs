//! The robots' own logs of a run, read back and summed up.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::Context as _;

use crate::simulated::robots::log::{LogLine, LoggedEvent, LoggedTask};

/// The last report of a robot that a server has acknowledged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Acknowledged {
    /// Start and number of the report.
    pub position: (u64, u64),
    pub generation: u64,
    pub tasks: Vec<LoggedTask>,
}

/// A report that was acknowledged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StoredReport {
    pub robot: usize,
    pub position: (u64, u64),
    pub at_ns: u64,
    pub took_ms: f64,
}

/// A session that ended, and when the robot had its next one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gap {
    pub robot: usize,
    pub from_ns: u64,
    /// Absent: the robot has no session since.
    pub until_ns: Option<u64>,
}

/// The logs of all robots.
#[derive(Debug, Default)]
pub struct RobotLogs {
    /// By the robot's number.
    pub last: BTreeMap<usize, Acknowledged>,
    /// When a robot verified a state with this deployment.
    pub received: BTreeMap<(usize, String), u64>,
    /// How often a robot started a run of a deployment.
    pub started: BTreeMap<(usize, String, u64), u64>,
    pub stored: Vec<StoredReport>,
    pub gaps: Vec<Gap>,
    /// Acknowledgements, those of old reports included.
    pub acknowledged: u64,
    /// The places in `gaps` of robots without a session.
    pub open_gaps: BTreeMap<usize, usize>,
}

impl RobotLogs {
    /// Reads the logs as far as they are written.
    pub fn read(paths: &[PathBuf]) -> anyhow::Result<Self> {
        let mut logs = Self::default();
        for path in paths {
            let text = std::fs::read_to_string(path);
            let text = text.with_context(|| path.display().to_string())?;
            logs.add(&text).with_context(|| path.display().to_string())?;
        }
        Ok(logs)
    }

    /// Adds the lines of one log; a last line that is not complete is left out.
    fn add(&mut self, text: &str) -> anyhow::Result<()> {
        let complete = text.rfind('\n').map_or("", |end| &text[..end]);
        for line in complete.lines() {
            self.add_line(serde_json::from_str(line).with_context(|| line.to_owned())?);
        }
        Ok(())
    }

    fn add_line(&mut self, LogLine { robot, at_ns, event }: LogLine) {
        match event {
            LoggedEvent::Connected => {
                let open = self.open_gaps.remove(&robot);
                if let Some(gap) = open.and_then(|number| self.gaps.get_mut(number)) {
                    gap.until_ns = Some(at_ns);
                }
            }
            LoggedEvent::Disconnected => {
                self.open_gaps.insert(robot, self.gaps.len());
                self.gaps.push(Gap { robot, from_ns: at_ns, until_ns: None });
            }
            LoggedEvent::Received { deployment } => {
                self.received.entry((robot, deployment.to_string())).or_insert(at_ns);
            }
            LoggedEvent::Started { deployment, run } => {
                *self.started.entry((robot, deployment.to_string(), run)).or_default() += 1;
            }
            LoggedEvent::Acknowledged { start, seq, generation, took_ns, tasks } => {
                self.acknowledged += 1;
                if let Some(took_ns) = took_ns {
                    let position = (start, seq);
                    let took_ms = took_ns as f64 / 1e6;
                    self.stored.push(StoredReport { robot, position, at_ns, took_ms });
                    let last = Acknowledged { position, generation, tasks };
                    self.last.insert(robot, last);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_summed_up_and_a_torn_one_is_left_out() {
        let text = format!(
            "{}\n{}\n{}\n{}\n{}\n{{\"robot\":",
            r#"{"robot":1,"at_ns":5,"event":"connected"}"#,
            r#"{"robot":1,"at_ns":7,"event":"disconnected"}"#,
            r#"{"robot":2,"at_ns":8,"event":"disconnected"}"#,
            r#"{"robot":1,"at_ns":9,"event":"connected"}"#,
            r#"{"robot":1,"at_ns":9,"event":"acknowledged","start":1,"seq":4,"generation":2,"took_ns":3000000,"tasks":[]}"#,
        );
        let mut logs = RobotLogs::default();
        logs.add(&text).expect("lines");
        let gap = |robot, from_ns, until_ns| Gap { robot, from_ns, until_ns };
        assert_eq!(logs.gaps, [gap(1, 7, Some(9)), gap(2, 8, None)]);
        assert_eq!(logs.last[&1].position, (1, 4));
        assert_eq!(
            logs.stored,
            [StoredReport { robot: 1, position: (1, 4), at_ns: 9, took_ms: 3.0 }]
        );
        assert!(logs.add("{}\n").is_err());
    }
}
