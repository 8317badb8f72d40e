//! Liveness, readiness, and information about the server.

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse as _, Response};
use http::StatusCode;
use serde_json::{Value, json};
use task_macros::operation;
use task_proto::api::ServerInfo;
use tokio_util::sync::CancellationToken;

use super::gauges::Gauges;
use crate::http::server::readiness::Readiness;

/// Reports that the process responds.
#[operation(tag = "server",
    responses((status = 200, description = "The process responds.", body = Value, example = json!({ "status": "ok" }))))]
pub(in crate::http) async fn healthz() -> Json<Value> {
    Json(json!({ "status": "ok" }))
}

/// Reports whether database, broker and disk passed their last check, a few seconds ago, and names
/// the problems. With a common store of blobs, `blobs` says whether that store answers; without its
/// answer the server is ready nevertheless.
#[operation(tag = "server",
    responses((status = 200, description = "All components are healthy.", body = Value,
            example = json!({ "status": "ready", "database": "ok", "broker": "ok", "disk": "ok" })),
        (status = 503, description = "A component is unhealthy, or the server is draining or stopping.", body = Value)))]
pub(in crate::http) async fn readyz(
    State(readiness): State<Readiness>,
    State(stop): State<CancellationToken>,
) -> Response {
    let verdicts = readiness.verdicts();
    let is_stopping = readiness.is_stopping() || stop.is_cancelled();
    let is_healthy =
        verdicts.iter().all(|(component, problem)| problem.is_none() || !component.is_vital());
    let is_ready = is_healthy && !is_stopping && !readiness.is_draining();
    let status = match is_healthy {
        _ if is_stopping => "stopping",
        _ if readiness.is_draining() => "draining",
        true => "ready",
        false => "not_ready",
    };
    let mut body = json!({ "status": status });
    for (component, problem) in verdicts {
        body[component.as_str()] = problem.unwrap_or_else(|| "ok".to_owned()).into();
    }
    (if is_ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE }, Json(body))
        .into_response()
}

/// Shows information about the server, its MQTT listeners and their traffic.
#[operation(tag = "server")]
pub(in crate::http) async fn server(State(gauges): State<Gauges>) -> Json<ServerInfo> {
    Json(ServerInfo {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        key: gauges.facts.key.clone(),
        ca_pin: gauges.facts.ca_pin,
        mqtt: gauges.broker.address(),
        now_ms: gauges.clock.now_ms(),
        traffic: gauges.broker.traffic(),
        http: gauges.http_traffic.read(),
        conduct: gauges.robot_limiter.totals(),
    })
}
