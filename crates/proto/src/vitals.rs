//! How a robot's machine does: a few figures a minute on its `telemetry` topic, and the answer to
//! [`crate::request::Ask::Vitals`]. They are for people; nothing is decided by them, and none is
//! kept on a disk.

use serde::{Deserialize, Serialize};

use crate::RobotId;

/// The largest [`Telemetry`], in bytes of JSON.
pub const MAX_TELEMETRY_BYTES: usize = 4096;

/// One look at the machine. What is not known of it is absent.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Vitals {
    /// When the server got it, by its clock; from a robot: when it looked, by its own.
    pub at_ms: u64,
    /// Of all processors together, since the look before, 0 to 100.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu_percent: Option<f32>,
    /// Memory that programs could not have.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_used_bytes: Option<u64>,
    /// Memory there is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_total_bytes: Option<u64>,
    /// What is not free for the agent on the data directory's file system.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub disk_used_bytes: Option<u64>,
    /// That file system's size.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub disk_total_bytes: Option<u64>,
    /// Over all network interfaces but the loopback, since the look before.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network_in_bytes_per_s: Option<u64>,
    /// Likewise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network_out_bytes_per_s: Option<u64>,
    /// The kernel's load average of the last minute.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub load_1m: Option<f32>,
    /// What is left of its battery; absent where it has none that can be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub battery_percent: Option<u8>,
    /// Of the hottest place the kernel knows, in degrees Celsius.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub temperature_c: Option<f32>,
}

/// What a robot publishes on its `telemetry` topic, QoS 0; without MQTT the body of its
/// `POST /robots/{robot}/telemetry`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Telemetry {
    /// Who speaks.
    pub robot_id: RobotId,
    /// How its machine does.
    pub vitals: Vitals,
}
