//! Liveness, readiness, and information about the server.

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse as _, Response};
use http::StatusCode;
use serde_json::{Value, json};
use task_proto::api::ServerInfo;

use crate::http::App;

/// Reports that the process responds.
#[utoipa::path(get, path = "/healthz", tag = "server",
    responses((status = 200, description = "It does.", body = Value, example = json!({ "status": "ok" }))))]
pub(in crate::http) async fn healthz() -> Json<Value> {
    Json(json!({ "status": "ok" }))
}

/// Reports whether database, broker and disk passed their last check, a few seconds ago, and names
/// the problems.
#[utoipa::path(get, path = "/readyz", tag = "server",
    responses((status = 200, description = "All of them were.", body = Value,
            example = json!({ "status": "ready", "database": "ok", "broker": "ok", "disk": "ok" })),
        (status = 503, description = "Some were not, or the server stops.", body = Value)))]
pub(in crate::http) async fn readyz(State(app): State<App>) -> Response {
    let verdicts = app.readiness.verdicts();
    let is_ready = verdicts.values().all(Option::is_none) && !app.stop.is_cancelled();
    let mut body = json!({ "status": if is_ready { "ready" } else { "not_ready" } });
    for (component, problem) in verdicts {
        body[component.as_str()] = problem.unwrap_or_else(|| "ok".to_owned()).into();
    }
    (if is_ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE }, Json(body))
        .into_response()
}

/// Shows information about the server, its MQTT listeners and their traffic.
#[utoipa::path(get, path = "/api/v1/server", tag = "server")]
pub(in crate::http) async fn server(State(app): State<App>) -> Json<ServerInfo> {
    Json(ServerInfo {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        key: app.key.clone(),
        ca_pin: app.ca_pin,
        mqtt: app.broker.address(),
        now_ms: app.clock.now_ms(),
        traffic: app.broker.traffic(),
        http: app.http_traffic.read(),
        conduct: app.conduct.totals(),
    })
}
