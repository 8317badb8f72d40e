//! The routes of a server that waits as a standby: it is alive and not ready, and refuses every
//! other request. This module does not know how long the wait takes.

use axum::Router;
use axum::middleware;
use axum::routing::get;
use axum::{Json, response::IntoResponse as _};
use http::StatusCode;
use serde_json::json;
use tokio::sync::watch;

use super::health;
use crate::http::connection::drain::drain_unread;
use crate::http::error::ApiError;
use crate::http::harden;

/// The routes of a standby that waits for the reason in `reason`.
pub fn router(reason: watch::Receiver<String>) -> Router {
    let ready = {
        let reason = reason.clone();
        async move || {
            let body = json!({ "status": "standby", "database": *reason.borrow() });
            (StatusCode::SERVICE_UNAVAILABLE, Json(body)).into_response()
        }
    };
    let refuse = async move || {
        ApiError::unavailable(format!("this server is a standby: {}", *reason.borrow()))
    };
    Router::new()
        .route("/healthz", get(health::healthz))
        .route("/readyz", get(ready))
        .fallback(refuse)
        .layer(middleware::map_response(harden))
        .layer(middleware::map_request(drain_unread))
}
