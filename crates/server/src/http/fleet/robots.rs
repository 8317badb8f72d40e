//! Robots: reading and changing them for operators, and the two calls that robots make themselves.

use std::net::SocketAddr;
use std::str::FromStr;
use std::sync::Arc;

use axum::extract::{ConnectInfo, State};
use axum::response::{IntoResponse, NoContent, Response};
use axum::{Extension, Json};
use http::{HeaderMap, StatusCode, Uri, header};
use serde::Deserialize;
use task_macros::operation;
use task_proto::api::{
    EditRobot, INSTANCE_HEADER, PLACE_HEADER, ReportReply, RobotList, RobotToken, RobotView,
};
use task_proto::ids::selector::Selector;
use task_proto::messages::report::Report;
use task_proto::trust::envelope::Envelope;
use task_proto::{Digest, RobotId, RobotName};
use utoipa::IntoParams;

use super::live_robots::LiveRobots;
use crate::domain::person::Person;
use crate::fleet::presence::AgentIdentity;
use crate::http::auth::TokenNumber;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam, QueryParams, TolerantJson, page_limit};
use crate::http::openapi::Created;
use crate::http::shared_lists::{ListKey, SharedJson, SharedLists};
use crate::http::views::Views;
use crate::orders::actions::RobotActions;
use crate::orders::desired_states::DesiredStates;
use crate::orders::report_writer::ReportWriter;
use crate::store::{RobotPage, Store};

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
#[operation(tag = "robots")]
pub(in crate::http) async fn list(
    State(lists): State<Arc<SharedLists>>,
    State(views): State<Views>,
    by: Person,
    uri: Uri,
    QueryParams(query): QueryParams<ListQuery>,
) -> Result<SharedJson<RobotList>, ApiError> {
    lists.get(ListKey::new(&by.scope, &uri), listed(&views, &by, &query)).await
}

async fn listed(views: &Views, by: &Person, query: &ListQuery) -> Result<RobotList, ApiError> {
    let (selector, after) = (query.selector.as_ref(), query.after.as_ref());
    let (rows, next, total) = match (page_limit(query.limit)?, after) {
        (Some(limit), after) => {
            let RobotPage { robots, next, total } =
                views.store.robots().page(&by.scope, selector, after, limit as usize).await?;
            (robots, next, Some(total))
        }
        (None, None) => (views.store.robots().list(&by.scope.and(selector)).await?, None, None),
        (None, Some(_)) => return Err(ApiError::invalid("after: requires limit")),
    };
    let unknown = match selector {
        Some(selector) => views.store.robots().unknown(selector, &by.scope).await?,
        None => Vec::new(),
    };
    views.peers.ask_for_figures(rows.iter().map(|row| &row.robot.id)).await;
    let robots = rows.into_iter().map(|row| views.of_robot(row)).collect();
    Ok(RobotList { robots, unknown, next, total })
}

/// Shows one robot with its tasks.
#[operation(tag = "robots")]
pub(in crate::http) async fn show(
    State(store): State<Store>,
    State(views): State<Views>,
    State(live): State<LiveRobots>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<Json<RobotView>, ApiError> {
    let id = find(&store, &by, &robot).await?;
    views.robot(&id, live.mqtt_connection(&id)).await.map(Json)
}

/// Changes a robot's name, labels or settings.
#[operation(tag = "robots",
    responses((status = 409, description = "`name_taken`: another robot has the name.")))]
pub(in crate::http) async fn edit(
    State(store): State<Store>,
    State(robots): State<RobotActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
    JsonBody(edit): JsonBody<EditRobot>,
) -> Result<Json<RobotView>, ApiError> {
    let id = find(&store, &by, &robot).await?;
    robots.edit(&by, &id, &edit).await?;
    views.robot(&id, None).await.map(Json)
}

/// Removes a robot and disconnects clients that use its token.
#[operation(tag = "robots")]
pub(in crate::http) async fn remove(
    State(store): State<Store>,
    State(robots): State<RobotActions>,
    State(live): State<LiveRobots>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<NoContent, ApiError> {
    let id = find(&store, &by, &robot).await?;
    robots.remove(&by, &id).await?;
    live.removed(&id);
    Ok(NoContent)
}

/// Revokes a robot's tokens and ends the connections and transfers that use them.
#[operation(tag = "robots")]
pub(in crate::http) async fn revoke(
    State(store): State<Store>,
    State(robots): State<RobotActions>,
    State(live): State<LiveRobots>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<NoContent, ApiError> {
    let id = find(&store, &by, &robot).await?;
    robots.revoke(&by, &id).await?;
    live.revoked(id);
    Ok(NoContent)
}

/// Returns the robot's signed desired state. The request counts as a sign of presence.
#[operation(tag = "agent",
    responses((status = 200, description = "The state as a DSSE envelope, with its tag in `ETag`.", body = Envelope),
        (status = 304, description = "Not modified: `If-None-Match` names the current state."),
        (status = 409, description = "`duplicate_identity`: two agents use this identity; `instance_waits`: another agent has this robot's work, and was seen recently; `diverged`: the robot has a newer generation than this server.")))]
pub(in crate::http) async fn desired(
    State(desired_states): State<DesiredStates>,
    State(live): State<LiveRobots>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    PathParam(robot): PathParam<RobotId>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    live.record_request(&robot, peer);
    let is_serving = live.is_serving(&robot, peer, agent_from_headers(&headers)?);
    if live.is_duplicate(&robot) {
        let message = "two agents use this robot's identity and keep displacing each other; the robot gets no new work";
        return Err(ApiError::conflict("duplicate_identity", message));
    }
    if !is_serving {
        return Err(instance_waits());
    }
    let desired = desired_states.get(&robot).await?;
    let body = serde_json::to_vec(&desired.envelope).map_err(|error| ApiError::internal(&error))?;
    // The same generation is signed again before its lifetime ends, so the tag covers the signature
    // as well.
    let tag = format!("\"{}-{}\"", desired.generation, &Digest::of(&body).hex()[..16]);
    let is_current =
        headers.get(header::IF_NONE_MATCH).is_some_and(|value| value.as_bytes() == tag.as_bytes());
    let caching = [(header::ETAG, tag), (header::CACHE_CONTROL, "no-cache".to_owned())];
    if is_current {
        return Ok((StatusCode::NOT_MODIFIED, caching).into_response());
    }
    Ok((caching, [(header::CONTENT_TYPE, "application/json")], body).into_response())
}

/// Stores a report of the robot. The response is sent after the commit.
#[operation(tag = "agent",
    responses((status = 409, description = "`instance_waits`, as for the desired state."),
        (status = 503, description = "Too many reports are queued, or the database is unavailable or corrupt."),
        (status = 507, description = "`disk_full`: the server's disk is full, and the report is not stored.")))]
pub(in crate::http) async fn report(
    State(live): State<LiveRobots>,
    State(reports): State<ReportWriter>,
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
    live.record_request(&robot, peer);
    let agent = AgentIdentity { instance: report.instance.clone(), place: report.place };
    if !live.is_serving(&robot, peer, Some(agent)) {
        return Err(instance_waits());
    }
    Ok(Json(reports.submit(report, token_number).await?))
}

/// Issues the robot's next token. Its first use ends the token that this request was made with.
#[operation(tag = "agent",
    responses((status = 409, description = "`enrolled_anew`: another agent has enrolled as this robot in the meantime; `instance_waits`, as for the desired state.")))]
pub(in crate::http) async fn next_token(
    State(live): State<LiveRobots>,
    State(robots): State<RobotActions>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    Extension(TokenNumber(token_number)): Extension<TokenNumber>,
    PathParam(robot): PathParam<RobotId>,
) -> Result<Created<RobotToken>, ApiError> {
    if !live.is_serving(&robot, peer, agent_from_headers(&headers)?) {
        return Err(instance_waits());
    }
    let token = robots.next_token(&robot, token_number).await?;
    Ok(Created(RobotToken { token: token.reveal() }))
}

/// The instance that the requesting agent states in its headers; older agents state none.
fn agent_from_headers(headers: &HeaderMap) -> Result<Option<AgentIdentity>, ApiError> {
    fn read<T: FromStr>(headers: &HeaderMap, name: &str) -> Result<Option<T>, ApiError> {
        let Some(value) = headers.get(name) else { return Ok(None) };
        let read = value.to_str().ok().and_then(|text| text.parse().ok());
        read.map(Some).ok_or_else(|| ApiError::invalid(format!("{name}: not a valid id")))
    }
    let place = read(headers, PLACE_HEADER)?;
    Ok(read(headers, INSTANCE_HEADER)?.map(|instance| AgentIdentity { instance, place }))
}

fn instance_waits() -> ApiError {
    let message = "another agent has this robot's work; this agent gets it once the other has been silent for 30 s";
    ApiError::conflict("instance_waits", message)
}

/// The robot that a person names, which must be in the person's scope.
pub(in crate::http) async fn find(
    store: &Store,
    by: &Person,
    id_or_name: &RobotName,
) -> Result<RobotId, ApiError> {
    let found = store.robots().find(id_or_name.as_str()).await?;
    let found =
        found.ok_or_else(|| ApiError::not_found(format!("there is no robot {id_or_name}")))?;
    if by.scope.covers(&found.id, &found.name, &found.labels) {
        return Ok(found.id);
    }
    Err(ApiError::out_of_scope(format!("robot {id_or_name}"), by))
}
