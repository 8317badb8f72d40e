//! Bodies of the feed: the last things in the fleet that are worth a look. It is in memory and
//! starts empty with the server; what must not be lost is in the audit.

use serde::{Deserialize, Serialize};

use crate::log::LogLevel;
use crate::{DeploymentId, RobotId, RobotName};

/// The most entries the server keeps, and the most that are answered at once.
pub const MAX_FEED_ENTRIES: usize = 2000;

/// `GET /feed` (read), optionally `?after=<number>` and `?limit=` (absent: 100): the newest of
/// those that the person may see.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FeedPage {
    /// The newest last; with `after` and more than `limit` of them, the oldest of those after it.
    pub entries: Vec<FeedEntry>,
}

/// Something that happened.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct FeedEntry {
    /// Grows by one; it goes on growing when the server has been restarted.
    pub number: u64,
    /// When.
    pub at_ms: u64,
    /// What kind of thing.
    pub kind: FeedKind,
    /// How serious: `info`, `warn` or `error`.
    pub level: LogLevel,
    /// The robot it is about, if it is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotId>,
    /// Its name then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot_name: Option<RobotName>,
    /// The deployment it is about.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deployment: Option<DeploymentId>,
    /// For people: one sentence.
    pub text: String,
}

/// What kind of thing happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FeedKind {
    /// A robot came online; many at once are one entry without a robot.
    RobotOnline,
    /// A robot went offline; likewise.
    RobotOffline,
    /// A robot registered.
    RobotEnrolled,
    /// A robot was put out or removed.
    RobotRevoked,
    /// A robot sent more than it may, or what it may not, and was cut off.
    RobotMisbehaved,
    /// A robot reported a new condition.
    RobotCondition,
    /// A task failed, or was rolled back.
    TaskFailed,
    /// A task that had failed runs, or has succeeded.
    TaskRecovered,
    /// A deployment was ordered.
    DeploymentBegun,
    /// Every robot's part of a deployment is settled.
    DeploymentSettled,
    /// Too many robots failed.
    DeploymentPaused,
    /// An operator took it back.
    DeploymentCancelled,
    /// The broker can't be reached, or can again.
    Broker,
    /// The server's disk is nearly full, or is not any more.
    Disk,
    /// A kind of a newer version.
    #[serde(other)]
    Unknown,
}
