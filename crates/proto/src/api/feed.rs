//! Bodies of the feed: recent notable events in the fleet. An event that the server can't store in
//! time is left out; records that must not be lost are in the audit.

use serde::{Deserialize, Serialize};

use crate::telemetry::log::LogLevel;
use crate::{DeploymentId, RobotId, RobotName};

/// The highest `limit` of a request. The server may keep fewer entries.
pub const MAX_FEED_ENTRIES: usize = 2000;

/// `GET /feed` (read), optionally `?after=<number>` and `?limit=` (absent: 100): the newest entries
/// visible to the user.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FeedPage {
    /// The entries, the newest last; with `after` and more than `limit` entries, the oldest after
    /// that number.
    pub entries: Vec<FeedEntry>,
}

/// An event in the fleet.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FeedEntry {
    /// Increasing number; continues to grow after a restart of the server.
    pub number: u64,
    /// Time of the event.
    pub at_ms: u64,
    /// Type of the event.
    pub kind: FeedKind,
    /// Severity: `info`, `warn` or `error`.
    pub level: LogLevel,
    /// The robot concerned, if the event is about a single robot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotId>,
    /// The robot's name at that time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot_name: Option<RobotName>,
    /// The deployment concerned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deployment: Option<DeploymentId>,
    /// Description for people: one sentence.
    pub text: String,
}

/// Type of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FeedKind {
    /// A robot came online; many at once form one entry without a robot.
    RobotOnline,
    /// A robot went offline; many at once form one entry without a robot.
    RobotOffline,
    /// A robot registered.
    RobotEnrolled,
    /// A robot was revoked or removed.
    RobotRevoked,
    /// A robot exceeded its limits or sent forbidden messages, and was disconnected.
    RobotMisbehaved,
    /// A robot reported a new condition.
    RobotCondition,
    /// A task failed, or was rolled back.
    TaskFailed,
    /// A task that had failed runs again, or has succeeded.
    TaskRecovered,
    /// A deployment was ordered.
    DeploymentBegun,
    /// All assignments of a deployment are settled.
    DeploymentSettled,
    /// A deployment paused because too many robots failed.
    DeploymentPaused,
    /// An operator cancelled a deployment.
    DeploymentCancelled,
    /// The broker became unreachable, or is reachable again.
    Broker,
    /// The server's disk is nearly full, or has enough space again.
    Disk,
    /// An event type unknown to this version.
    #[serde(other)]
    Unknown,
}
