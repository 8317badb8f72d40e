//! Vitals of a robot's machine: a few figures a minute on its `telemetry` topic, and the answer to
//! [`crate::messages::request::Ask::Vitals`]. For people only: no decision depends on them, and
//! they are not stored on disk.

use serde::{Deserialize, Serialize};

use crate::RobotId;

/// The largest [`Telemetry`], in bytes of JSON.
pub const MAX_TELEMETRY_BYTES: usize = 4096;

/// A measurement of the machine. Unknown values are absent.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Vitals {
    /// Time of receipt by the server's clock; in a robot's message, time of measurement by the
    /// robot's clock.
    pub at_ms: u64,
    /// Load of all processors together since the previous measurement, 0 to 100.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu_percent: Option<f32>,
    /// Memory that is unavailable to programs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_used_bytes: Option<u64>,
    /// Total memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_total_bytes: Option<u64>,
    /// Bytes on the data directory's file system that are not free for the agent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub disk_used_bytes: Option<u64>,
    /// Size of the data directory's file system.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub disk_total_bytes: Option<u64>,
    /// Received over all network interfaces except the loopback, since the previous measurement.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network_in_bytes_per_s: Option<u64>,
    /// Sent over all network interfaces except the loopback, since the previous measurement.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network_out_bytes_per_s: Option<u64>,
    /// The kernel's load average of the last minute.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub load_1m: Option<f32>,
    /// Battery charge in percent; absent without a readable battery.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub battery_percent: Option<u8>,
    /// Temperature of the hottest sensor that the kernel knows, in degrees Celsius.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub temperature_c: Option<f32>,
}

/// The message that a robot publishes on its `telemetry` topic, QoS 0; without MQTT, the body of
/// the robot's `POST /robots/{robot}/telemetry`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Telemetry {
    /// The robot that sent the message.
    pub robot_id: RobotId,
    /// Vitals of the robot's machine.
    pub vitals: Vitals,
}
