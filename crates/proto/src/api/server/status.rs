//! Bodies about the server's health, its connections and its rules.

use serde::{Deserialize, Serialize};

use super::{HttpTraffic, MqttTraffic, Traffic};
use crate::desired::Delivery;
use crate::ids::{LabelValue, NodeName};
use crate::{RobotId, RobotName};

/// `GET /server/status` (read). Robots and sites are limited to those visible to the user.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ServerStatus {
    /// The server's version.
    pub version: String,
    /// Seconds since the server started.
    pub uptime_s: u64,
    /// The server's clock.
    pub now_ms: u64,
    /// Number of robots.
    pub robots: RobotCounts,
    /// MQTT traffic since the start.
    pub mqtt: MqttTraffic,
    /// HTTP traffic since the start.
    pub http: HttpTraffic,
    /// Robots that pull packages.
    pub transfers: TransferStatus,
    /// Robots grouped by the label `site`, the largest sites first, at most [`MAX_SITES`].
    pub sites: Vec<SiteStatus>,
    /// Rate and latency of storing reports.
    pub reports: ReportStatus,
    /// The database of the fleet's state.
    pub database: DatabaseStatus,
    /// The data directory's file system.
    pub disk: DiskStatus,
    /// The broker that carries the notices of new states.
    pub broker: BrokerStatus,
    /// Addresses that the server listens on.
    pub listeners: Vec<ListenerView>,
    /// The servers of the cluster, by name, of which each counts above as far as it answers; empty:
    /// the server is alone.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<NodeView>,
}

/// The most sites of a [`ServerStatus`].
pub const MAX_SITES: usize = 100;

/// Number of robots.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotCounts {
    /// Registered robots.
    pub known: u64,
    /// Registered robots that are connected over MQTT or polling.
    pub online: u64,
}

/// Robots that pull packages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TransferStatus {
    /// Transfers in progress.
    pub active: u64,
    /// Robots waiting for a transfer slot.
    pub waiting: u64,
    /// Total throughput over the last seconds.
    pub bytes_per_s: u64,
}

/// The robots with one value of the label `site`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SiteStatus {
    /// The label's value; absent: the robots without this label.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub site: Option<LabelValue>,
    /// Number of robots.
    pub robots: u64,
    /// Number of robots online.
    pub online: u64,
    /// Median of the throughput measured in transfers to these robots; absent without measurements.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub throughput_bytes_per_s: Option<u64>,
    /// Median of the time from a request to the first byte of its answer; absent without
    /// measurements.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rtt_ms: Option<u64>,
}

/// Rate and latency of storing reports, over the last minute.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReportStatus {
    /// Reports stored per second.
    pub per_s: f64,
    /// Median time from a report's arrival until it was stored; absent without reports. In a
    /// cluster that of the slowest server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latency_ms_p50: Option<f64>,
    /// 99th percentile of the time from a report's arrival until it was stored; absent without
    /// reports. In a cluster that of the slowest server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latency_ms_p99: Option<f64>,
}

/// The database of the fleet's state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DatabaseStatus {
    /// `sqlite` or `postgres`.
    pub kind: String,
    /// Size of the database; absent if the database does not report it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size_bytes: Option<u64>,
    /// Latency of a query made for this answer.
    pub latency_ms: f64,
    /// For people: why orders and reports are refused; absent if the database has no known problem.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
    /// Time of the last full check without errors since the server's start. SQLite only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fully_checked_at_ms: Option<u64>,
    /// For people: how the database detects damage to its pages. Postgres only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guard: Option<String>,
}

/// The data directory's file system.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DiskStatus {
    /// Bytes that the server may still write.
    pub free_bytes: u64,
    /// Size of the file system.
    pub total_bytes: u64,
    /// Bytes used by packages and by outputs from robots.
    pub packages_bytes: u64,
}

/// The broker that carries the notices of new states.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BrokerStatus {
    /// `embedded` or `external`.
    pub kind: String,
    /// Whether a message would get through now.
    pub healthy: bool,
    /// For people: the problem, or the broker's address.
    pub detail: String,
}

/// An address that the server listens on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ListenerView {
    /// `http` or `mqtt`.
    pub kind: String,
    /// `address:port`, as bound.
    pub address: String,
    /// Whether the listener uses TLS.
    pub tls: bool,
}

/// `GET /cluster/nodes` (read).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NodeList {
    /// The servers of the cluster, by name; empty: the server is alone.
    pub nodes: Vec<NodeView>,
}

/// A server of a cluster.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NodeView {
    /// The server's name.
    pub name: NodeName,
    /// Where the other servers reach it; absent: nowhere.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub url: Option<String>,
    /// The server's version.
    pub version: String,
    /// Whether it serves.
    pub state: NodeState,
    /// Whether it is the server that gives this answer.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub answers: bool,
    /// Time since it last gave a sign of life in the database, as the answering server saw it;
    /// absent for the answering server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heartbeat_age_ms: Option<u64>,
    /// Its figures; absent if it did not answer in time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub figures: Option<NodeFigures>,
}

/// Whether a server of a cluster serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum NodeState {
    /// It serves.
    Serving,
    /// It sends its robots to other servers.
    Draining,
    /// It lives, and does not answer the other servers.
    Silent,
    /// It gives no sign of life.
    Lost,
    /// A state that this program does not know.
    #[serde(other)]
    Unknown,
}

/// Figures of one server since its start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct NodeFigures {
    /// Seconds since the server started.
    pub uptime_s: u64,
    /// Whether it sends its robots to other servers.
    pub draining: bool,
    /// Its MQTT traffic.
    pub mqtt: MqttTraffic,
    /// Its HTTP traffic.
    pub http: HttpTraffic,
    /// Robots that pull packages from it.
    pub transfers: TransferStatus,
    /// Rate and latency of storing its reports.
    pub reports: ReportStatus,
}

/// `GET /server/sessions` (read), optionally `?limit=` (1 to 1,000, absent: 100) and
/// `?after=<name>`: the robots connected over MQTT and visible to the user.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SessionList {
    /// Sorted by the robots' names.
    pub sessions: Vec<RobotSession>,
    /// Number of sessions on all pages.
    pub total: u64,
    /// The value of `after` for the next page; absent on the last page.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<RobotName>,
}

/// A robot's MQTT connection and its subscriptions. With an external broker, only robots announced
/// by the broker are known.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotSession {
    /// The robot's id.
    pub robot: RobotId,
    /// The robot's name.
    pub name: RobotName,
    /// When the connection began.
    pub since_ms: u64,
    /// The peer, `ip:port`, or without the port behind a trusted proxy; absent if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// Sorted by filter.
    pub subscriptions: Vec<Subscription>,
    /// Traffic of the connection.
    pub traffic: Traffic,
    /// The server of the cluster that has the connection; absent outside of a cluster, or if that
    /// server did not answer in time. Then subscriptions and traffic are not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<NodeName>,
}

/// A client's subscription.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Subscription {
    /// The filter of topics.
    pub topic_filter: String,
    /// The highest quality of service for its messages, 0 to 2.
    pub qos: u8,
}

/// `GET /server/rules` (read): the rules of `adaptive` delivery, and the limits in effect.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ServerRules {
    /// The rules in order: the first rule with a true condition decides.
    pub rules: Vec<RuleView>,
    /// The limits, by their keys in the configuration.
    pub limits: Vec<LimitView>,
}

/// A delivery rule in effect.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RuleView {
    /// Position of the rule, from 1.
    pub order: u64,
    /// The rule's name, as shown with decisions.
    pub name: String,
    /// The condition as text: `size ≤ 256 KB, robots ≥ 8`; empty: always true.
    pub condition: String,
    /// The delivery method that the rule selects.
    pub mechanism: Delivery,
    /// Whether the operator wrote the rule; all others are built in.
    pub own: bool,
}

/// A limit in effect.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LimitView {
    /// The limit's key in the configuration: `transfers.at_once`.
    pub key: String,
    /// The limit's value with its unit, or `none`.
    pub value: String,
}
