//! Whether the process lives, whether it can do its work, and what it is.

use std::path::Path;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse as _, Response};
use http::StatusCode;
use serde_json::{Value, json};
use task_proto::api::ServerInfo;

use super::App;
use crate::broker::Health;

/// How long one part may take to answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// Says that the process answers.
#[utoipa::path(get, path = "/healthz", tag = "server",
    responses((status = 200, description = "It does.", body = Value, example = json!({ "status": "ok" }))))]
pub(super) async fn healthz() -> Json<Value> {
    Json(json!({ "status": "ok" }))
}

/// Says whether database, broker and disk answer, and names which do not.
#[utoipa::path(get, path = "/readyz", tag = "server",
    responses((status = 200, description = "All of them do.", body = Value,
            example = json!({ "status": "ready", "database": "ok", "broker": "ok", "disk": "ok" })),
        (status = 503, description = "Some do not, or the server stops.", body = Value)))]
pub(super) async fn readyz(State(app): State<App>) -> Response {
    let (database, disk) = tokio::join!(
        tokio::time::timeout(PATIENCE, app.store.ping()),
        tokio::time::timeout(PATIENCE, is_writable(&app.data)),
    );
    let broker = match &*app.broker.health().borrow() {
        Health::Serving => None,
        Health::Recovering(seen) | Health::Failed(seen) => Some(seen.clone()),
    };
    let database = match database {
        Ok(Ok(())) => None,
        Ok(Err(_)) => Some("it refuses a statement".to_owned()),
        Err(_) => Some("it does not answer".to_owned()),
    };
    let disk = match disk {
        Ok(Ok(())) => None,
        Ok(Err(error)) => Some(format!("the data directory can't be written: {}", error.kind())),
        Err(_) => Some("the data directory does not answer".to_owned()),
    };
    let parts = [("database", database), ("broker", broker), ("disk", disk)];
    let is_ready = parts.iter().all(|(_, problem)| problem.is_none()) && !app.stop.is_cancelled();
    let mut body = json!({ "status": if is_ready { "ready" } else { "not_ready" } });
    for (part, problem) in parts {
        body[part] = problem.unwrap_or_else(|| "ok".to_owned()).into();
    }
    (if is_ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE }, Json(body)).into_response()
}

/// Writes one small file of a fixed name, so that a full or read-only disk is noticed before a robot's report is lost.
async fn is_writable(data: &Path) -> std::io::Result<()> {
    let probe = data.join(".ready");
    tokio::fs::write(&probe, b"ready\n").await
}

/// Says what the server is, where MQTT listens and what went over it.
#[utoipa::path(get, path = "/api/v1/server", tag = "server")]
pub(super) async fn server(State(app): State<App>) -> Json<ServerInfo> {
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
