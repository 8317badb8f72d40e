//! Bodies about robots: their views, tasks, settings and vitals.

mod bulk;
mod enrollment;
mod logs;

use serde::{Deserialize, Deserializer, Serialize};

pub use self::bulk::{BulkLabels, BulkRemove};
pub use self::enrollment::{
    AWAITS_APPROVAL, CreateEnrollmentToken, EnrollRequest, EnrollResponse, EnrollmentToken,
    EnrollmentTokenList, EnrollmentTokenView, PendingRobot, PendingRobotList, RobotToken,
};
pub use self::logs::{LogEvent, LogsFrom, LogsQuery, LogsView};
use super::{DeliveryDecision, MqttConnection};
use crate::desired::TargetState;
use crate::desired::settings::{EffectiveSettings, RobotSettings};
use crate::ids::Labels;
use crate::messages::report::{
    ActiveVersion, Condition, Failure, HostFacts, LinkFacts, Phase, Progress,
};
use crate::telemetry::vitals::Vitals;
use crate::{DeploymentId, Generation, MacAddress, RobotId, RobotName, TaskName, Version};

/// `GET /robots` (read), optionally filtered by `?selector=`, and paged by `?limit=` (1 to 1,000)
/// with `?after=`, a robot's name.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotList {
    /// Sorted by name.
    pub robots: Vec<RobotView>,
    /// Names and ids in the selector that match none of the caller's robots, sorted: a deployment
    /// with this selector is refused.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unknown: Vec<RobotName>,
    /// The value of `after` for the next page; absent on the last page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<RobotName>,
    /// Number of robots on all pages; only in a paged answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub total: Option<u64>,
}

/// A robot as operators see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotView {
    /// The robot's id.
    pub id: RobotId,
    /// The robot's name.
    pub name: RobotName,
    /// The MAC address that the robot was registered by.
    pub mac: MacAddress,
    /// The robot's labels.
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Whether the robot is connected over MQTT or polls.
    pub online: bool,
    /// The robot's last peer address, `ip:port`; without the port behind a trusted proxy.
    pub address: Option<String>,
    /// When the server last heard from the robot.
    pub last_seen_ms: Option<u64>,
    /// When the robot registered.
    pub enrolled_at_ms: u64,
    /// The generation that the robot should have.
    pub generation: Generation,
    /// The generation that the robot last reported.
    pub observed_generation: Generation,
    /// `diverged`, `duplicate_identity`, `instance_waits` and the conditions that the robot
    /// reported.
    pub conditions: Vec<Condition>,
    /// Facts that the agent reported about its machine.
    pub host: Option<HostFacts>,
    /// Measurements of the robot's connection to the server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkFacts>,
    /// The robot's tasks, sorted by name.
    pub tasks: Vec<RobotTask>,
    /// The robot's MQTT connection, if connected; only in `GET /robots/{robot}`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mqtt: Option<MqttConnection>,
    /// The machine's latest vitals; absent: none received since the server started.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vitals: Option<Vitals>,
    /// Settings of this robot on the server; absent: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub settings: Option<RobotSettings>,
    /// Settings in effect on the robot, as last reported; absent: the agent's defaults.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effective_settings: Option<EffectiveSettings>,
}

/// A task on a robot: its order and its state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotTask {
    /// The task's name.
    pub task: TaskName,
    /// The version that the deployment ordered.
    pub version: Version,
    /// The deployment that ordered the task.
    pub deployment: DeploymentId,
    /// Whether the task should run.
    pub wanted: TargetState,
    /// Number of times the task was asked to start.
    pub run: u64,
    /// How the package's bytes travel, and the reason for that choice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delivery: Option<DeliveryDecision>,
    /// The task's current phase.
    pub phase: Phase,
    /// Progress within the phase.
    pub progress: Option<Progress>,
    /// Why the task failed.
    pub failure: Option<Failure>,
    /// Why the running task is degraded.
    #[serde(default)]
    pub degraded: Option<Failure>,
    /// The version with a live process.
    pub active: Option<ActiveVersion>,
    /// Whether the ordered version now names another package, after a forced push.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub outdated: bool,
    /// Times the process was restarted in this run.
    pub restarts: u32,
}

/// `PATCH /robots/{robot}` (maintain): absent fields stay unchanged.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EditRobot {
    /// A new name.
    #[serde(default)]
    pub name: Option<RobotName>,
    /// The new labels; they replace all existing labels.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Option<Labels>,
    /// The new settings; they replace all existing settings. Null removes them.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "given")]
    pub settings: Option<Option<RobotSettings>>,
}

/// Tells an explicit null from an absent field.
fn given<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

/// Answer to a robot's `POST /robots/{robot}/report`. The report is stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReportReply {
    /// The generation the robot should have.
    pub generation: Generation,
    /// The robot's name on the server; the server's value wins over the robot's own.
    pub name: RobotName,
    /// The robot's labels on the server; the server's value wins over the robot's own.
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
}

/// `GET /robots/{robot}/vitals` (read): samples of the last hour, about one per minute; lost when
/// the server restarts.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct VitalsView {
    /// The samples, the oldest first.
    pub samples: Vec<Vitals>,
}
