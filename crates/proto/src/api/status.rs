//! Bodies about the server itself: how it does, who is connected, by what rules it decides.

use serde::{Deserialize, Serialize};

use super::{HttpTraffic, MqttTraffic, Traffic};
use crate::desired::Delivery;
use crate::id::LabelValue;
use crate::{RobotId, RobotName};

/// `GET /server/status` (read). Robots and sites are those that the person may see.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ServerStatus {
    /// The server's version.
    pub version: String,
    /// How long it has been up.
    pub uptime_s: u64,
    /// The server's clock.
    pub now_ms: u64,
    /// How many robots there are.
    pub robots: RobotCounts,
    /// What went over MQTT since the start.
    pub mqtt: MqttTraffic,
    /// What went over HTTP since the start.
    pub http: HttpTraffic,
    /// Robots that pull packages.
    pub transfers: TransferStatus,
    /// By the label `site`, the one with the most robots first, at most [`MAX_SITES`].
    pub sites: Vec<SiteStatus>,
    /// How fast reports are stored.
    pub reports: ReportStatus,
    /// Where the fleet's state is kept.
    pub database: DatabaseStatus,
    /// The data directory's file system.
    pub disk: DiskStatus,
    /// What carries the doorbell.
    pub broker: BrokerStatus,
    /// Where the server listens.
    pub listeners: Vec<ListenerView>,
}

/// The most sites of a [`ServerStatus`].
pub const MAX_SITES: usize = 100;

/// How many robots there are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotCounts {
    /// Registered.
    pub known: u64,
    /// Of them connected over MQTT or polling.
    pub online: u64,
}

/// Robots that pull packages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TransferStatus {
    /// Under way.
    pub active: u64,
    /// Told to wait for their turn.
    pub waiting: u64,
    /// What they get together, over the last seconds.
    pub bytes_per_s: u64,
}

/// The robots with one value of the label `site`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SiteStatus {
    /// The label's value; absent: the robots that have no such label.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub site: Option<LabelValue>,
    /// How many.
    pub robots: u64,
    /// Of them online.
    pub online: u64,
    /// The median of what transfers to them have shown; absent where none was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub throughput_bytes_per_s: Option<u64>,
    /// Likewise, from a request to the first byte of its answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rtt_ms: Option<u64>,
}

/// How fast reports are stored: of the last minute.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReportStatus {
    /// Stored a second.
    pub per_s: f64,
    /// From its arrival until it was stored, of half of them at most; absent where none came.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latency_ms_p50: Option<f64>,
    /// Likewise, of 99 in a hundred.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latency_ms_p99: Option<f64>,
}

/// Where the fleet's state is kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DatabaseStatus {
    /// `sqlite` or `postgres`.
    pub kind: String,
    /// Absent where the database does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size_bytes: Option<u64>,
    /// Of a question asked now.
    pub latency_ms: f64,
    /// For people: why orders and reports are refused; absent where nothing is known against the
    /// database.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
    /// When the server last checked all of it since its start and found nothing wrong. SQLite only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fully_checked_at_ms: Option<u64>,
    /// For people: how the database itself notices damage to its pages. Postgres only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guard: Option<String>,
}

/// The data directory's file system.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DiskStatus {
    /// What the server may still write.
    pub free_bytes: u64,
    /// Its size.
    pub total_bytes: u64,
    /// Of it packages and what robots brought back.
    pub packages_bytes: u64,
}

/// What carries the doorbell.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BrokerStatus {
    /// `embedded` or `external`.
    pub kind: String,
    /// Whether a message would get through now.
    pub healthy: bool,
    /// For people: what is wrong, or where it is.
    pub detail: String,
}

/// Where the server listens.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ListenerView {
    /// `http` or `mqtt`.
    pub kind: String,
    /// `address:port`, as bound.
    pub address: String,
    /// Whether it speaks TLS.
    pub tls: bool,
}

/// `GET /server/sessions` (read), optionally `?limit=` (1 to 1,000, absent: 100) and
/// `?after=<name>`: the robots that are connected over MQTT and that the person may see.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SessionList {
    /// Sorted by the robots' names.
    pub sessions: Vec<RobotSession>,
    /// How many there are in all.
    pub total: u64,
    /// What `after` is for the next ones; absent: these were the last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<RobotName>,
}

/// A robot's MQTT connection and what it listens to. With an external broker only whom it has
/// announced is known.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotSession {
    /// Whose.
    pub robot: RobotId,
    /// Its name.
    pub name: RobotName,
    /// When it began.
    pub since_ms: u64,
    /// The peer, `ip:port`; absent where it is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// Sorted by filter.
    pub subscriptions: Vec<Subscription>,
    /// What went over it.
    pub traffic: Traffic,
}

/// What a client listens to.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Subscription {
    /// Which topics.
    pub topic_filter: String,
    /// The highest quality of service that it is sent with, 0 to 2.
    pub qos: u8,
}

/// `GET /server/rules` (read): how bytes travel with `adaptive`, and the limits that hold.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ServerRules {
    /// The first whose condition holds decides.
    pub rules: Vec<RuleView>,
    /// By their keys in the configuration.
    pub limits: Vec<LimitView>,
}

/// A rule as it stands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RuleView {
    /// From 1.
    pub order: u64,
    /// Its name, as decisions show it.
    pub name: String,
    /// In words: `size ≤ 256 KB, robots ≥ 8`; empty: it always decides.
    pub condition: String,
    /// What is used then.
    pub mechanism: Delivery,
    /// Whether the operator wrote it; the others are built in.
    pub own: bool,
}

/// A limit that holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LimitView {
    /// Its key in the configuration: `transfers.at_once`.
    pub key: String,
    /// Its value with its unit, or `none`.
    pub value: String,
}
