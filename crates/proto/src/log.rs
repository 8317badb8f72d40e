//! Log lines on their way from a robot: what tasks print, what their nodes say on `/rosout` and
//! `/diagnostics`, what the agent says about them. They are for people; nothing is decided by them.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::id::{GraphName, InvalidId};
use crate::{RobotId, TaskName};

/// The most lines in one published batch.
pub const MAX_BATCH_LINES: usize = 500;
/// The longest text of a line, in bytes; a longer one is cut and ends in `…`.
pub const MAX_LINE_BYTES: usize = 4096;
/// The most lines of an answer to [`crate::request::Ask::Logs`].
pub const MAX_KEPT_LINES: usize = 5000;
/// The largest batch, in bytes of JSON.
pub const MAX_BATCH_BYTES: usize = 200 * 1024;

/// How serious a line is: the five levels of ROS, each more serious than the one before.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LogLevel {
    /// For whoever wrote the program.
    Debug,
    /// Also what has no level: a line on standard output.
    #[default]
    Info,
    /// Also what came on standard error without a level.
    Warn,
    /// Something failed.
    Error,
    /// Nothing works any more.
    Fatal,
}

/// Where a line comes from.
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
    /// The agent, or a source this version does not know.
    #[serde(other)]
    Agent,
}

/// One line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LogLine {
    /// When, by the robot's clock: milliseconds since the Unix epoch.
    pub at_ms: u64,
    /// How serious.
    pub level: LogLevel,
    /// Where from.
    pub source: LogSource,
    /// The task it belongs to; `None`: none of ours, or the robot as a whole.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<TaskName>,
    /// The node that said it, where one did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<GraphName>,
    /// One line, without its end and without control characters.
    pub text: String,
}

/// What a robot publishes on its `log` topic, and part of the answer to
/// [`crate::request::Ask::Logs`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LogBatch {
    /// Who speaks.
    pub robot_id: RobotId,
    /// The robot's clock when it was sent, as in [`LogLine::at_ms`]: with it a line's age is known
    /// to whoever's clock.
    pub now_ms: u64,
    /// The oldest first.
    pub lines: Vec<LogLine>,
    /// Lines that were left out since the batch before because they were too many; they are counted
    /// here and kept on the robot.
    #[serde(default)]
    pub suppressed: u64,
}

impl LogLevel {
    /// Every level, the least serious first.
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
