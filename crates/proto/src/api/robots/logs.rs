//! The part of the HTTP API about robots' log lines.

use serde::{Deserialize, Serialize};

use crate::TaskName;
use crate::telemetry::log::{LogLevel, LogLine};

/// The query of `GET /robots/{robot}/logs` (read).
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::IntoParams))]
#[serde(deny_unknown_fields)]
pub struct LogsQuery {
    /// Only lines of this task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", param(inline))]
    pub task: Option<TaskName>,
    /// Minimum level; absent: all levels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", param(inline))]
    pub level: Option<LogLevel>,
    /// Maximum age of a line in seconds, by the robot's clock.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub since_s: Option<u64>,
    /// Maximum number of lines; absent: 500.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_lines: Option<u64>,
    /// Whether to stream [`LogEvent`]s from now on; `since_s` and `max_lines` are then ignored.
    #[serde(default)]
    pub follow: bool,
}

/// Answer of `GET /robots/{robot}/logs`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LogsView {
    /// Origin of the lines.
    pub from: LogsFrom,
    /// Milliseconds since the robot's lines were last received; 0 for the robot's own answer.
    pub age_ms: u64,
    /// Why the answer is not the robot's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The lines, the oldest first.
    pub lines: Vec<LogLine>,
    /// Number of lines that the server never received because of the rate limit; the robot kept
    /// them.
    #[serde(default)]
    pub suppressed: u64,
}

/// Origin of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LogsFrom {
    /// The robot, which keeps all lines for a while.
    Robot,
    /// The server's memory, which has the latest lines that the robot published by itself.
    Server,
}

/// An event of the stream `GET /robots/{robot}/logs?follow=true`: each is the `data` of a
/// server-sent event whose `event` is the tag's value.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum LogEvent {
    /// The robot publishes its lines from now on. Repeated after a gap: request the lines of the
    /// gap separately.
    Following,
    /// The robot can't be reached; the server keeps retrying.
    Away {
        /// Why the robot can't be reached.
        reason: String,
    },
    /// New lines, the oldest first.
    Lines {
        /// The lines.
        lines: Vec<LogLine>,
        /// Number of lines left out since the previous event because of the rate limit; the robot
        /// keeps them.
        suppressed: u64,
    },
}
