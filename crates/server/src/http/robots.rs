//! Robots: what operators see and change of them, and the two calls robots make themselves.

use std::net::SocketAddr;

use axum::extract::{ConnectInfo, State};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use http::{HeaderMap, StatusCode, header};
use serde::Deserialize;
use task_proto::api::{EditRobot, MqttConnection, ReportReply, RobotList, RobotToken, RobotView};
use task_proto::report::Report;
use task_proto::selector::Selector;
use task_proto::{Digest, RobotId, RobotName};

use super::App;
use super::auth::TokenNumber;
use super::error::ApiError;
use super::extract::{JsonBody, PathParam, QueryParams, TolerantJson};
use super::views::complete_robot;
use crate::changes::Change;
use crate::person::Person;
use crate::uplink;

/// The query of `GET /robots`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    selector: Option<Selector>,
}

/// `GET /robots`: all robots of the person's, or those of them a selector means.
pub(super) async fn list(
    State(app): State<App>,
    by: Person,
    QueryParams(query): QueryParams<ListQuery>,
) -> Result<Json<RobotList>, ApiError> {
    let mut robots = app.store.robots().await?;
    robots.retain(|robot| by.scope.covers(&robot.id, &robot.name, &robot.labels));
    if let Some(selector) = query.selector {
        robots.retain(|robot| selector.matches(&robot.id, &robot.name, &robot.labels));
    }
    let now_ms = app.clock.now_ms();
    robots.iter_mut().for_each(|robot| complete_robot(robot, &app.presence, &app.conduct, now_ms));
    Ok(Json(RobotList { robots }))
}

/// `GET /robots/{robot}`: one robot, by id or name.
pub(super) async fn show(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<Json<RobotView>, ApiError> {
    let id = find(&app, &by, &robot).await?;
    let mut view = view(&app, &id).await?;
    let since_ms = app.presence.get(&id, app.clock.now_ms()).and_then(|sighting| sighting.connected_since_ms);
    view.mqtt =
        since_ms.zip(app.broker.traffic_of(&id)).map(|(since_ms, traffic)| MqttConnection { since_ms, traffic });
    Ok(Json(view))
}

/// `PATCH /robots/{robot}`: changes name or labels.
pub(super) async fn edit(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
    JsonBody(edit): JsonBody<EditRobot>,
) -> Result<Json<RobotView>, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.edit_robot(&by, &id, &edit).await?;
    view(&app, &id).await.map(Json)
}

/// `DELETE /robots/{robot}`: removes it; whoever is connected with its token has to go.
pub(super) async fn remove(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<StatusCode, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.remove_robot(&by, &id).await?;
    put_out(&app, &id);
    app.logs.forget(&id);
    app.presence.forget(&id);
    Ok(StatusCode::NO_CONTENT)
}

/// `POST /robots/{robot}/revoke`: ends its tokens, and whatever is under way by them.
pub(super) async fn revoke(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<StatusCode, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.revoke_robot(&by, &id).await?;
    put_out(&app, &id);
    // One that polled would count as there for a while.
    app.presence.forget(&id);
    app.changes.announce(Change::Robot(id));
    Ok(StatusCode::NO_CONTENT)
}

/// Ends a robot's session and its requests. To be called once its tokens have ended.
fn put_out(app: &App, robot: &RobotId) {
    app.broker.disconnect(robot);
    app.visits.end(robot);
}

/// `GET /robots/{robot}/desired` (that robot): its signed desired state. Asking counts as being there.
pub(super) async fn desired(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    PathParam(robot): PathParam<RobotId>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let now_ms = app.clock.now_ms();
    uplink::heard(&app.presence, &app.changes, &robot, peer, now_ms);
    if app.presence.is_duplicate(&robot, now_ms) {
        let message = "two agents use this robot's identity and keep displacing each other; it gets no new work";
        return Err(ApiError::conflict("duplicate_identity", message));
    }
    let desired = app.actions.desired(&robot).await?;
    let body = serde_json::to_vec(&desired.envelope).map_err(|error| ApiError::internal(&error))?;
    // The same generation is signed again before its lifetime ends, so the tag covers the signature as well.
    let tag = format!("\"{}-{}\"", desired.generation, &Digest::of(&body).hex()[..16]);
    let is_known = headers.get(header::IF_NONE_MATCH).is_some_and(|value| value.as_bytes() == tag.as_bytes());
    let caching = [(header::ETAG, tag), (header::CACHE_CONTROL, "no-cache".to_owned())];
    if is_known {
        return Ok((StatusCode::NOT_MODIFIED, caching).into_response());
    }
    Ok((caching, [(header::CONTENT_TYPE, "application/json")], body).into_response())
}

/// `POST /robots/{robot}/report` (that robot): stores a report; the answer comes after the commit.
pub(super) async fn report(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    Extension(TokenNumber(token_number)): Extension<TokenNumber>,
    PathParam(robot): PathParam<RobotId>,
    TolerantJson(report): TolerantJson<Report>,
) -> Result<Json<ReportReply>, ApiError> {
    if report.robot_id != robot {
        return Err(ApiError::invalid(format!("robot_id: the report is by {}, not by {robot}", report.robot_id)));
    }
    let now_ms = app.clock.now_ms();
    uplink::heard(&app.presence, &app.changes, &robot, peer, now_ms);
    app.presence.instance_seen(&robot, Some(peer), &report.instance, now_ms);
    Ok(Json(app.reports.submit(report, token_number).await?))
}

/// `POST /robots/{robot}/token` (that robot): a token it may go over to; the first use of it ends the one it called with.
pub(super) async fn next_token(
    State(app): State<App>,
    PathParam(robot): PathParam<RobotId>,
) -> Result<(StatusCode, Json<RobotToken>), ApiError> {
    let token = app.actions.next_robot_token(&robot).await?;
    Ok((StatusCode::CREATED, Json(RobotToken { token: token.reveal() })))
}

/// The robot that a person names, which must be one of theirs.
pub(super) async fn find(app: &App, by: &Person, id_or_name: &RobotName) -> Result<RobotId, ApiError> {
    let found = app.store.find_robot(id_or_name.as_str()).await?;
    let found = found.ok_or_else(|| ApiError::not_found(format!("there is no robot {id_or_name}")))?;
    if by.scope.covers(&found.id, &found.name, &found.labels) {
        return Ok(found.id);
    }
    Err(ApiError::out_of_scope(format!("robot {id_or_name}"), by))
}

async fn view(app: &App, id: &RobotId) -> Result<RobotView, ApiError> {
    let found = app.store.robot(id).await?;
    let mut view = found.ok_or_else(|| ApiError::not_found(format!("there is no robot {id}")))?;
    complete_robot(&mut view, &app.presence, &app.conduct, app.clock.now_ms());
    Ok(view)
}
