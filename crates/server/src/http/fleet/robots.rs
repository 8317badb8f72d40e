//! Robots: reading and changing them for operators, and the two calls that robots make themselves.

use std::net::SocketAddr;
use std::str::FromStr;

use axum::extract::{ConnectInfo, State};
use axum::response::{IntoResponse, NoContent, Response};
use axum::{Extension, Json};
use http::{HeaderMap, StatusCode, Uri, header};
use serde::Deserialize;
use task_proto::api::{
    EditRobot, FeedKind, INSTANCE_HEADER, MqttConnection, PLACE_HEADER, ReportReply, RobotList,
    RobotToken, RobotView,
};
use task_proto::envelope::Envelope;
use task_proto::report::Report;
use task_proto::selector::Selector;
use task_proto::{Digest, RobotId, RobotName};
use utoipa::IntoParams;

use crate::domain::happening::Happening;
use crate::domain::person::Person;
use crate::fleet::presence::Claim;
use crate::http::App;
use crate::http::auth::TokenNumber;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam, QueryParams, TolerantJson, page_limit};
use crate::http::openapi::Created;
use crate::http::shared_lists::{ListKey, SharedJson};
use crate::http::views::complete_robot;
use crate::link::uplink;
use crate::orders::changes::Change;

/// The query of `GET /robots`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct ListQuery {
    /// Only robots that match this selector.
    #[param(inline)]
    selector: Option<Selector>,
    /// Maximum number of robots. Default: all.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<u32>,
    /// Only robots whose names come after this one. Requires `limit`.
    #[param(inline)]
    after: Option<RobotName>,
}

/// Lists the caller's robots, optionally filtered by a selector and in pages.
#[utoipa::path(get, path = "/api/v1/robots", tag = "robots")]
pub(in crate::http) async fn list(
    State(app): State<App>,
    by: Person,
    uri: Uri,
    QueryParams(query): QueryParams<ListQuery>,
) -> Result<SharedJson<RobotList>, ApiError> {
    app.lists.get(ListKey::new(&by.scope, &uri), listed(&app, &by, &query)).await
}

async fn listed(app: &App, by: &Person, query: &ListQuery) -> Result<RobotList, ApiError> {
    let (selector, after) = (query.selector.as_ref(), query.after.as_ref());
    let mut list = match (page_limit(query.limit)?, after) {
        (Some(limit), after) => {
            let page = app.store.robots_page(&by.scope, selector, after, limit as usize).await?;
            RobotList {
                robots: page.robots,
                next: page.next,
                total: Some(page.total),
                ..RobotList::default()
            }
        }
        (None, None) => {
            let mut robots = app.store.robots().await?;
            robots.retain(|RobotView { id, name, labels, .. }| {
                by.scope.covers(id, name, labels)
                    && selector.is_none_or(|selector| selector.matches(id, name, labels))
            });
            RobotList { robots, ..RobotList::default() }
        }
        (None, Some(_)) => return Err(ApiError::invalid("after: a page needs a limit as well")),
    };
    if let Some(selector) = selector {
        list.unknown = app.store.unknown_robots(selector, &by.scope).await?;
    }
    let now_ms = app.clock.now_ms();
    list.robots
        .iter_mut()
        .for_each(|robot| complete_robot(robot, &app.presence, &app.conduct, &app.vitals, now_ms));
    Ok(list)
}

/// Shows one robot.
#[utoipa::path(get, path = "/api/v1/robots/{robot}", tag = "robots")]
pub(in crate::http) async fn show(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<Json<RobotView>, ApiError> {
    let id = find(&app, &by, &robot).await?;
    let mut view = view(&app, &id).await?;
    let since_ms =
        app.presence.get(&id, app.clock.now_ms()).and_then(|sighting| sighting.connected_since_ms);
    view.mqtt = since_ms
        .zip(app.broker.traffic_of(&id))
        .map(|(since_ms, traffic)| MqttConnection { since_ms, traffic });
    Ok(Json(view))
}

/// Changes a robot's name, labels or settings.
#[utoipa::path(patch, path = "/api/v1/robots/{robot}", tag = "robots",
    responses((status = 409, description = "`name_taken`: another robot has the name.")))]
pub(in crate::http) async fn edit(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
    JsonBody(edit): JsonBody<EditRobot>,
) -> Result<Json<RobotView>, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.edit_robot(&by, &id, &edit).await?;
    view(&app, &id).await.map(Json)
}

/// Removes a robot and disconnects clients that use its token.
#[utoipa::path(delete, path = "/api/v1/robots/{robot}", tag = "robots")]
pub(in crate::http) async fn remove(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<NoContent, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.remove_robot(&by, &id).await?;
    gone(&app, &id);
    Ok(NoContent)
}

/// Revokes a robot's tokens and ends the connections and transfers that use them.
#[utoipa::path(post, path = "/api/v1/robots/{robot}/revoke", tag = "robots")]
pub(in crate::http) async fn revoke(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<NoContent, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.revoke_robot(&by, &id).await?;
    put_out(&app, &id);
    // A robot that polled would otherwise count as online for a while.
    app.presence.forget(&id);
    app.changes.happened(Happening::Robot(
        id.clone(),
        FeedKind::RobotRevoked,
        "was put out".to_owned(),
    ));
    app.changes.announce(Change::Robot(id));
    Ok(NoContent)
}

/// Cleans up after a removed robot: clients connected with its token are disconnected.
pub(in crate::http) fn gone(app: &App, robot: &RobotId) {
    put_out(app, robot);
    app.logs.forget(robot);
    app.vitals.forget(robot);
    app.presence.forget(robot);
}

/// Ends a robot's session and its requests. Call this once the robot's tokens have ended.
fn put_out(app: &App, robot: &RobotId) {
    app.broker.disconnect(robot);
    app.http_connections.end(robot);
}

/// Returns the robot's signed desired state. The request counts as a sign of presence.
#[utoipa::path(get, path = "/api/v1/robots/{robot}/desired", tag = "agent",
    responses((status = 200, description = "The state, as a DSSE envelope; its tag is in `ETag`.", body = Envelope),
        (status = 304, description = "It is still the one that `If-None-Match` names."),
        (status = 409, description = "`duplicate_identity`: two agents use this identity; `instance_waits`: another agent has this robot's work, and was heard lately; `diverged`: the robot has come further than this server.")))]
pub(in crate::http) async fn desired(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    PathParam(robot): PathParam<RobotId>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let now_ms = app.clock.now_ms();
    uplink::heard(&app.presence, &app.changes, &robot, peer, now_ms);
    let is_served = is_served(&app, &robot, peer, claim_in(&headers)?);
    if app.presence.is_duplicate(&robot, now_ms) {
        let message = "two agents use this robot's identity and keep displacing each other; it gets no new work";
        return Err(ApiError::conflict("duplicate_identity", message));
    }
    if !is_served {
        return Err(waits());
    }
    let desired = app.actions.desired(&robot).await?;
    let body = serde_json::to_vec(&desired.envelope).map_err(|error| ApiError::internal(&error))?;
    // The same generation is signed again before its lifetime ends, so the tag covers the signature
    // as well.
    let tag = format!("\"{}-{}\"", desired.generation, &Digest::of(&body).hex()[..16]);
    let is_known =
        headers.get(header::IF_NONE_MATCH).is_some_and(|value| value.as_bytes() == tag.as_bytes());
    let caching = [(header::ETAG, tag), (header::CACHE_CONTROL, "no-cache".to_owned())];
    if is_known {
        return Ok((StatusCode::NOT_MODIFIED, caching).into_response());
    }
    Ok((caching, [(header::CONTENT_TYPE, "application/json")], body).into_response())
}

/// Stores a report of the robot. The response is sent after the commit.
#[utoipa::path(post, path = "/api/v1/robots/{robot}/report", tag = "agent",
    responses((status = 409, description = "`instance_waits`, as of the desired state."),
        (status = 503, description = "Too many reports wait to be stored, or the database does not answer or is corrupt."),
        (status = 507, description = "`disk_full`: the server's disk is, and the report is not stored.")))]
pub(in crate::http) async fn report(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    Extension(TokenNumber(token_number)): Extension<TokenNumber>,
    PathParam(robot): PathParam<RobotId>,
    TolerantJson(report): TolerantJson<Report>,
) -> Result<Json<ReportReply>, ApiError> {
    if report.robot_id != robot {
        return Err(ApiError::invalid(format!(
            "robot_id: the report is by {}, not by {robot}",
            report.robot_id
        )));
    }
    let now_ms = app.clock.now_ms();
    uplink::heard(&app.presence, &app.changes, &robot, peer, now_ms);
    if !is_served(
        &app,
        &robot,
        peer,
        Some(Claim { instance: report.instance.clone(), place: report.place }),
    ) {
        return Err(waits());
    }
    Ok(Json(app.reports.submit(report, token_number).await?))
}

/// Issues the robot's next token. Its first use ends the token that this request was made with.
#[utoipa::path(post, path = "/api/v1/robots/{robot}/token", tag = "agent",
    responses((status = 409, description = "`enrolled_anew`: another agent has enrolled as this robot meanwhile; `instance_waits`, as of the desired state.")))]
pub(in crate::http) async fn next_token(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    Extension(TokenNumber(token_number)): Extension<TokenNumber>,
    PathParam(robot): PathParam<RobotId>,
) -> Result<Created<RobotToken>, ApiError> {
    if !is_served(&app, &robot, peer, claim_in(&headers)?) {
        return Err(waits());
    }
    let token = app.actions.next_robot_token(&robot, token_number).await?;
    Ok(Created(RobotToken { token: token.reveal() }))
}

/// The instance that the requesting agent states in its headers; older agents state none.
fn claim_in(headers: &HeaderMap) -> Result<Option<Claim>, ApiError> {
    fn read<T: FromStr>(headers: &HeaderMap, name: &str) -> Result<Option<T>, ApiError> {
        let Some(value) = headers.get(name) else { return Ok(None) };
        let read = value.to_str().ok().and_then(|text| text.parse().ok());
        read.map(Some).ok_or_else(|| ApiError::invalid(format!("{name}: it is no such id")))
    }
    let place = read(headers, PLACE_HEADER)?;
    Ok(read(headers, INSTANCE_HEADER)?.map(|instance| Claim { instance, place }))
}

/// True if the requesting agent is the one that has the robot's work.
fn is_served(app: &App, robot: &RobotId, peer: SocketAddr, claim: Option<Claim>) -> bool {
    match claim {
        Some(claim) => uplink::claimed(
            &app.presence,
            &app.changes,
            robot,
            (Some(peer), None),
            claim,
            app.clock.now_ms(),
        ),
        None => !app.presence.takes_a_claim(robot),
    }
}

fn waits() -> ApiError {
    let message = "another agent has this robot's work; this one gets it once that one has been silent for 30 s";
    ApiError::conflict("instance_waits", message)
}

/// The robot that a person names, which must be in the person's scope.
pub(in crate::http) async fn find(
    app: &App,
    by: &Person,
    id_or_name: &RobotName,
) -> Result<RobotId, ApiError> {
    let found = app.store.find_robot(id_or_name.as_str()).await?;
    let found =
        found.ok_or_else(|| ApiError::not_found(format!("there is no robot {id_or_name}")))?;
    if by.scope.covers(&found.id, &found.name, &found.labels) {
        return Ok(found.id);
    }
    Err(ApiError::out_of_scope(format!("robot {id_or_name}"), by))
}

async fn view(app: &App, id: &RobotId) -> Result<RobotView, ApiError> {
    let found = app.store.robot(id).await?;
    let mut view = found.ok_or_else(|| ApiError::not_found(format!("there is no robot {id}")))?;
    complete_robot(&mut view, &app.presence, &app.conduct, &app.vitals, app.clock.now_ms());
    Ok(view)
}
