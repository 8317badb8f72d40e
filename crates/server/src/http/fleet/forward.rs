//! Requests about one robot that only the server with the robot's session can answer. They are
//! passed on there after this server has admitted the caller, and answered here where the session
//! is. This module never passes a request on twice.

use std::net::SocketAddr;

use axum::body::{Body, to_bytes};
use axum::extract::rejection::RawPathParamsRejection;
use axum::extract::{ConnectInfo, RawPathParams, Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use http::StatusCode;
use http::request::Parts;
use task_proto::RobotName;

use super::robots::find;
use crate::domain::person::Person;
use crate::fleet::requests::RequestError;
use crate::http::App;
use crate::http::auth::Caller;
use crate::http::error::ApiError;
use crate::http::peers::{Patience, Peer};

/// The answer if the robot's server is silent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::http) enum IfSilent {
    /// Answer with this server's own knowledge.
    AnswerHere,
    /// Refuse the request: this server could only wait for the robot.
    Refuse,
}

/// State of one route's layer.
#[derive(Clone)]
pub(in crate::http) struct ForwardState {
    pub(in crate::http) app: App,
    pub(in crate::http) if_silent: IfSilent,
    pub(in crate::http) body_bytes: usize,
}

/// Runs between the guard and the handler.
pub(in crate::http) async fn to_robots_server(
    State(ForwardState { app, if_silent, body_bytes }): State<ForwardState>,
    ConnectInfo(client): ConnectInfo<SocketAddr>,
    params: Result<RawPathParams, RawPathParamsRejection>,
    request: Request,
    next: Next,
) -> Response {
    // The handler answers that there is no such path.
    let Ok(params) = params else { return next.run(request).await };
    let (parts, body) = request.into_parts();
    let peer = match robots_server(&app, &params, &parts).await {
        Ok(Some(peer)) => peer,
        Ok(None) => return next.run(Request::from_parts(parts, body)).await,
        Err(error) => return error.into_response(),
    };
    // Read as a whole, so that it can't be too long and a handler here can read it again.
    let Ok(body) = to_bytes(body, body_bytes).await else {
        let message = "the body is larger than this route allows, or incomplete";
        return ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "too_large", message).into_response();
    };
    let by = parts.extensions.get::<Caller>().and_then(Caller::person);
    let address = by.and_then(|by| by.address).unwrap_or(client.ip());
    let sent = Request::from_parts(parts.clone(), Body::from(body.clone()));
    match (app.peers.forward(&peer, Patience::ROBOT, address, sent).await, if_silent) {
        (Ok(answer), _) => answer,
        (Err(_), IfSilent::AnswerHere) => {
            next.run(Request::from_parts(parts, Body::from(body))).await
        }
        (Err(_), IfSilent::Refuse) => ApiError::from(RequestError::NotConnected).into_response(),
    }
}

/// The other server that has the session of the path's robot, which must be in the caller's scope.
async fn robots_server(
    app: &App,
    params: &RawPathParams,
    request: &Parts,
) -> Result<Option<Peer>, ApiError> {
    // Every server can reach the robots of an external broker.
    if app.peers.own_name().is_none() || app.broker.local_addr().is_none() {
        return Ok(None);
    }
    let name = params.iter().find(|(name, _)| *name == "robot");
    let robot = name.and_then(|(_, name)| name.parse::<RobotName>().ok());
    let by = request.extensions.get::<Caller>().and_then(Caller::person);
    let (Some(robot), Some(by)): (_, Option<&Person>) = (robot, by) else { return Ok(None) };
    let id = find(&app.store, by, &robot).await?;
    if app.broker.traffic_of(&id).is_some() {
        return Ok(None);
    }
    Ok(app.peers.with_session(&id, &request.headers).await?)
}
