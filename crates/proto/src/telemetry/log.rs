//! Log lines from a robot: the output of tasks, the messages of their nodes on `/rosout` and
//! `/diagnostics`, and the agent's messages. For people only: no decision depends on them.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::ids::{GraphName, InvalidId};
use crate::{RobotId, TaskName};

/// The most lines in one published batch.
pub const MAX_BATCH_LINES: usize = 500;
/// The longest text of a line, in bytes; a longer one is cut and ends in `…`.
pub const MAX_LINE_BYTES: usize = 4096;
/// The most lines of an answer to [`crate::messages::request::Ask::Logs`].
pub const MAX_KEPT_LINES: usize = 5000;
/// The largest batch, in bytes of JSON.
pub const MAX_BATCH_BYTES: usize = 200 * 1024;

/// Severity of a line: the five levels of ROS, in ascending order.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LogLevel {
    /// For the program's developers.
    Debug,
    /// Also the level of lines without one on standard output.
    #[default]
    Info,
    /// Also the level of lines without one on standard error.
    Warn,
    /// An operation failed.
    Error,
    /// The program can't continue.
    Fatal,
}

/// Origin of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LogSource {
    /// The task's standard output.
    Stdout,
    /// The task's standard error.
    Stderr,
    /// A node's message on `/rosout`.
    Rosout,
    /// A status on `/diagnostics`.
    Diagnostics,
    /// The build tool's output.
    Build,
    /// The agent, or a source unknown to this version.
    #[serde(other)]
    Agent,
}

/// One line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LogLine {
    /// Time by the robot's clock: milliseconds since the Unix epoch.
    pub at_ms: u64,
    /// Severity of the line.
    pub level: LogLevel,
    /// Origin of the line.
    pub source: LogSource,
    /// The task that the line belongs to; `None`: no task of ours, or the robot as a whole.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<TaskName>,
    /// The node that logged the line, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<GraphName>,
    /// One line, without its line end and without control characters.
    pub text: String,
}

/// The batch that a robot publishes on its `log` topic; also part of the answer to
/// [`crate::messages::request::Ask::Logs`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LogBatch {
    /// The robot that sent the batch.
    pub robot_id: RobotId,
    /// The robot's clock at sending, as in [`LogLine::at_ms`]: gives a line's age independently of
    /// the reader's clock.
    pub now_ms: u64,
    /// The lines, the oldest first.
    pub lines: Vec<LogLine>,
    /// Number of lines left out since the previous batch because of the rate limit; the robot keeps
    /// them.
    #[serde(default)]
    pub suppressed: u64,
}

impl LogLevel {
    /// Every level, the least severe first.
    pub const ALL: [Self; 5] = [Self::Debug, Self::Info, Self::Warn, Self::Error, Self::Fatal];

    /// The level as text.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Debug => "debug",
            Self::Info => "info",
            Self::Warn => "warn",
            Self::Error => "error",
            Self::Fatal => "fatal",
        }
    }
}

impl FromStr for LogLevel {
    type Err = InvalidId;
    fn from_str(text: &str) -> Result<Self, InvalidId> {
        let found = Self::ALL.into_iter().find(|level| level.as_str() == text);
        found.ok_or_else(|| InvalidId::new("log level", text, "debug, info, warn, error or fatal"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_ordered_and_parse_back() {
        assert!(LogLevel::ALL.is_sorted());
        for level in LogLevel::ALL {
            assert_eq!(level.as_str().parse(), Ok(level));
            assert_eq!(serde_json::to_value(level).expect("json"), level.as_str());
        }
        assert!("loud".parse::<LogLevel>().is_err());
    }
}
