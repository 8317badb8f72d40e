//! The part of the HTTP API that is about robots' log lines.

use serde::{Deserialize, Serialize};

use crate::TaskName;
use crate::log::{LogLevel, LogLine};

/// The query of `GET /robots/{robot}/logs` (read).
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::IntoParams))]
#[serde(deny_unknown_fields)]
pub struct LogsQuery {
    /// Lines of this task only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", param(inline))]
    pub task: Option<TaskName>,
    /// Only these and more serious ones; absent: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", param(inline))]
    pub level: Option<LogLevel>,
    /// Not older than so many seconds, by the robot's clock.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub since_s: Option<u64>,
    /// At most so many; absent: 500.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_lines: Option<u64>,
    /// Whether to stream [`LogEvent`]s from now on instead; then `since_s` and `max_lines` have no
    /// meaning.
    #[serde(default)]
    pub follow: bool,
}

/// Answer of `GET /robots/{robot}/logs`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LogsView {
    /// Whose lines these are.
    pub from: LogsFrom,
    /// For how many milliseconds nothing was heard of the robot's lines; 0 for its own answer.
    pub age_ms: u64,
    /// Why it is not the robot's own answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The oldest first.
    pub lines: Vec<LogLine>,
    /// Lines that the server never saw because they were too many; the robot kept them.
    #[serde(default)]
    pub suppressed: u64,
}

/// Where log lines were read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LogsFrom {
    /// The robot, which keeps them all for a while.
    Robot,
    /// The server's memory, which has the last that the robot published by itself.
    Server,
}

/// What `GET /robots/{robot}/logs?follow=true` streams: each is the `data` of a server-sent event
/// whose `event` is the tag's value.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum LogEvent {
    /// The robot publishes its lines from now on. Comes again after a gap: what was said in it is
    /// to be had by asking.
    Following,
    /// The robot can't be reached, and is asked again and again.
    Away {
        /// Why.
        reason: String,
    },
    /// Lines as they came, the oldest first.
    Lines {
        /// The lines.
        lines: Vec<LogLine>,
        /// Lines that were left out since the ones before because they were too many; the robot
        /// keeps them.
        suppressed: u64,
    },
}
