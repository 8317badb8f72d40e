//! MQTT over the HTTP port: a WebSocket, for robots that can't reach another port. The broker
//! authenticates clients, as at its own port.

use std::io;
use std::net::SocketAddr;

use axum::body::Body;
use axum::extract::{ConnectInfo, Request, State};
use axum::response::{IntoResponse as _, Response};
use http::{HeaderValue, StatusCode, header};
use hyper_util::rt::TokioIo;
use task_macros::operation;
use task_transport::websocket::{WebSocket, WebSocketError, grant};

use crate::broker::Broker;
use crate::http::error::ApiError;
use crate::net::tls::ClientProof;

/// Upgrades to MQTT over WebSocket. The broker authenticates the client, as at its own port.
#[operation(tag = "agent",
    responses((status = 101, description = "The connection continues with MQTT."),
        (status = 426, description = "The request is not a WebSocket handshake for MQTT."),
        (status = 503, description = "MQTT is served by an external broker, or the connection limit is reached.")))]
pub(in crate::http) async fn upgrade(
    State(broker): State<Broker>,
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
    if !broker.serve_connection(peer, handshake) {
        return Err(ApiError::unavailable(
            "MQTT is served by an external broker, or the connection limit is reached",
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
