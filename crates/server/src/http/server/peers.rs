//! Answers to the other servers of the cluster: the figures of this server, and those of robots
//! that are connected to it. Nothing here changes anything.

use std::collections::HashMap;

use axum::Json;
use axum::extract::State;
use task_proto::RobotId;
use task_proto::api::{
    HttpTraffic, MAX_PAGE_ENTRIES, MqttTraffic, NodeFigures, ReportStatus, Traffic, TransferStatus,
};
use tokio::time::Instant;

use super::gauges::Gauges;
use crate::http::error::ApiError;
use crate::http::peers::{PeerJson, RobotFigures, RobotQuestion, SessionFigures};
use crate::http::views::Views;

/// This server's own figures.
pub(in crate::http) async fn status(
    State(gauges): State<Gauges>,
    PeerJson(()): PeerJson<()>,
) -> Json<NodeFigures> {
    Json(own_figures(&gauges))
}

pub(super) fn own_figures(gauges: &Gauges) -> NodeFigures {
    NodeFigures {
        uptime_s: gauges.facts.began.elapsed().as_secs(),
        draining: gauges.readiness.is_draining(),
        mqtt: gauges.broker.traffic(),
        http: gauges.http_traffic.read(),
        transfers: TransferStatus {
            active: gauges.transfers.running(),
            waiting: gauges.transfers.waiting(),
            bytes_per_s: gauges.transfers.bytes_per_s(),
        },
        reports: gauges.reports.meter().read(Instant::now()),
    }
}

/// The figures of all servers together. Percentiles can't be added, so those of the slowest server
/// count; uptime is that of the server that started first.
pub(super) fn total(all: impl Iterator<Item = NodeFigures>) -> NodeFigures {
    all.reduce(|one, other| NodeFigures {
        uptime_s: one.uptime_s.max(other.uptime_s),
        draining: one.draining && other.draining,
        mqtt: mqtt_total(one.mqtt, other.mqtt),
        http: HttpTraffic {
            connections: one.http.connections + other.http.connections,
            requests: one.http.requests + other.http.requests,
            bytes_in: one.http.bytes_in + other.http.bytes_in,
            bytes_out: one.http.bytes_out + other.http.bytes_out,
        },
        transfers: TransferStatus {
            active: one.transfers.active + other.transfers.active,
            waiting: one.transfers.waiting + other.transfers.waiting,
            bytes_per_s: one.transfers.bytes_per_s + other.transfers.bytes_per_s,
        },
        reports: ReportStatus {
            per_s: one.reports.per_s + other.reports.per_s,
            latency_ms_p50: slower(one.reports.latency_ms_p50, other.reports.latency_ms_p50),
            latency_ms_p99: slower(one.reports.latency_ms_p99, other.reports.latency_ms_p99),
        },
    })
    .unwrap_or_default()
}

fn mqtt_total(one: MqttTraffic, other: MqttTraffic) -> MqttTraffic {
    let (all, more) = (one.all, other.all);
    MqttTraffic {
        robots_connected: one.robots_connected + other.robots_connected,
        connections_accepted: one.connections_accepted + other.connections_accepted,
        connections_refused: one.connections_refused + other.connections_refused,
        messages_refused: one.messages_refused + other.messages_refused,
        messages_dropped: one.messages_dropped + other.messages_dropped,
        all: Traffic {
            bytes_in: all.bytes_in + more.bytes_in,
            bytes_out: all.bytes_out + more.bytes_out,
            packets_in: all.packets_in + more.packets_in,
            packets_out: all.packets_out + more.packets_out,
            messages_in: all.messages_in + more.messages_in,
            messages_out: all.messages_out + more.messages_out,
            acks_in: all.acks_in + more.acks_in,
            acks_out: all.acks_out + more.acks_out,
        },
    }
}

fn slower(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    [one, other].into_iter().flatten().reduce(f64::max)
}

/// The sessions of those of the robots that are connected here.
pub(in crate::http) async fn sessions(
    State(gauges): State<Gauges>,
    PeerJson(question): PeerJson<RobotQuestion>,
) -> Result<Json<HashMap<RobotId, SessionFigures>>, ApiError> {
    let session = |robot: RobotId| {
        let traffic = gauges.broker.traffic_of(&robot)?;
        let subscriptions = gauges.broker.subscriptions_of(&robot);
        Some((robot, SessionFigures { subscriptions, traffic, node: None }))
    };
    Ok(Json(checked(question)?.into_iter().filter_map(session).collect()))
}

/// The vitals and the penalties of those of the robots that this server knows.
pub(in crate::http) async fn figures(
    State(views): State<Views>,
    PeerJson(question): PeerJson<RobotQuestion>,
) -> Result<Json<HashMap<RobotId, RobotFigures>>, ApiError> {
    let figures = |robot: RobotId| {
        let vitals = views.vitals.newest(&robot);
        let penalty = views.robot_limiter.penalty(&robot);
        let is_known = vitals.is_some() || penalty.is_some();
        is_known.then_some((robot, RobotFigures { vitals, penalty }))
    };
    Ok(Json(checked(question)?.into_iter().filter_map(figures).collect()))
}

fn checked(question: RobotQuestion) -> Result<Vec<RobotId>, ApiError> {
    match question.robots.len() <= MAX_PAGE_ENTRIES as usize {
        true => Ok(question.robots),
        false => Err(ApiError::invalid(format!("robots: more than {MAX_PAGE_ENTRIES}"))),
    }
}
