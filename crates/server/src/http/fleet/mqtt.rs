//! MQTT over the HTTP port: a WebSocket, for robots that can't reach another port. The broker
//! authenticates clients, as at its own port.

use std::io;
use std::net::SocketAddr;

use axum::body::Body;
use axum::extract::{ConnectInfo, Request, State};
use axum::response::{IntoResponse as _, Response};
use http::{HeaderValue, StatusCode, header};
use hyper_util::rt::TokioIo;
use task_transport::websocket::{WebSocket, WebSocketError, grant};

use crate::http::App;
use crate::http::error::ApiError;
use crate::net::tls::ClientProof;

/// Upgrades to MQTT over WebSocket. The broker authenticates the client, as at its own port.
#[utoipa::path(get, path = "/mqtt", tag = "agent",
    responses((status = 101, description = "MQTT from here on."),
        (status = 426, description = "It is no WebSocket handshake for MQTT."),
        (status = 503, description = "MQTT is served elsewhere, or to as many as there may be.")))]
pub(in crate::http) async fn upgrade(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    mut request: Request,
) -> Result<Response, ApiError> {
    let headers = match grant(request.headers()) {
        Ok(headers) => headers,
        Err(error) => return Ok(upgrade_required(&error)),
    };
    let proof = request.extensions().get::<ClientProof>().cloned().unwrap_or_default();
    let upgrade = hyper::upgrade::on(&mut request);
    let handshake = async move {
        let stream = upgrade.await.map_err(io::Error::other)?;
        Ok((WebSocket::server(TokioIo::new(stream)), proof))
    };
    if !app.broker.take_in(peer, handshake) {
        return Err(ApiError::unavailable(
            "MQTT is served elsewhere, or to as many as there may be",
        ));
    }
    let mut response = Response::new(Body::empty());
    *response.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    response.headers_mut().extend(headers);
    Ok(response)
}

/// Adds the required upgrade headers to the error.
fn upgrade_required(error: &WebSocketError) -> Response {
    let error = ApiError::new(StatusCode::UPGRADE_REQUIRED, "upgrade_required", error.to_string());
    let mut response = error.into_response();
    response.headers_mut().extend([
        (header::CONNECTION, HeaderValue::from_static("Upgrade")),
        (header::UPGRADE, HeaderValue::from_static("websocket")),
        (header::SEC_WEBSOCKET_VERSION, HeaderValue::from_static("13")),
    ]);
    response
}
