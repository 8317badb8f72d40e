//! Enrollment: tokens for new robots, the registration of robots with such a token, and the
//! approval of waiting robots.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use axum::response::NoContent;
use task_macros::operation;
use task_proto::api::{
    CreateEnrollmentToken, EnrollRequest, EnrollResponse, EnrollmentToken, EnrollmentTokenList,
    FeedKind, PendingRobotList,
};
use task_proto::{RobotName, TokenId};

use super::broker::BrokerAccounts;
use super::live_robots::LiveRobots;
use super::robots::find;
use crate::domain::person::Person;
use crate::http::auth::Caller;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam, TolerantJson};
use crate::http::openapi::Created;
use crate::orders::actions::RobotActions;
use crate::store::Store;

/// Registers the robot that holds the token.
#[operation(tag = "enrollment",
    responses((status = 409, description = "`mac_known`, `name_taken` or `enrolled_anew`."),
        (status = 429, description = "Too many robots wait for approval, or too many invalid tokens came from this address.")))]
pub(in crate::http) async fn enroll(
    State(robots): State<RobotActions>,
    State(accounts): State<BrokerAccounts>,
    State(live): State<LiveRobots>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    caller: Caller,
    TolerantJson(request): TolerantJson<EnrollRequest>,
) -> Result<Created<EnrollResponse>, ApiError> {
    let Caller::Enrollment(token) = caller else {
        return Err(ApiError::forbidden("an enrollment token is required"));
    };
    let enrolled = robots.enroll(&token, &request, Some(peer.ip().to_canonical())).await?;
    let mqtt = accounts.endpoint_of(&enrolled.robot_id).await?;
    let text = format!("registered from {}", peer.ip().to_canonical());
    live.announce_event(enrolled.robot_id.clone(), FeedKind::RobotEnrolled, text);
    let (token, awaits_approval) = (enrolled.token.reveal(), enrolled.awaits_approval);
    let answer = EnrollResponse {
        robot_id: enrolled.robot_id,
        name: enrolled.name,
        token,
        mqtt,
        awaits_approval,
    };
    Ok(Created(answer))
}

/// Creates an enrollment token.
#[operation(tag = "enrollment",
    responses((status = 404, description = "There is no such robot.")))]
pub(in crate::http) async fn create_token(
    State(robots): State<RobotActions>,
    by: Person,
    JsonBody(order): JsonBody<CreateEnrollmentToken>,
) -> Result<Created<EnrollmentToken>, ApiError> {
    Ok(Created(robots.create_enrollment_token(&by, &order).await?))
}

/// Lists the enrollment tokens that are still usable.
#[operation(tag = "enrollment")]
pub(in crate::http) async fn tokens(
    State(robots): State<RobotActions>,
) -> Result<Json<EnrollmentTokenList>, ApiError> {
    Ok(Json(robots.enrollment_tokens().await?))
}

/// Revokes an enrollment token.
#[operation(tag = "enrollment")]
pub(in crate::http) async fn revoke_token(
    State(robots): State<RobotActions>,
    by: Person,
    PathParam(token): PathParam<TokenId>,
) -> Result<NoContent, ApiError> {
    robots.revoke_enrollment_token(&by, &token).await?;
    Ok(NoContent)
}

/// Lists the robots that wait for approval.
#[operation(tag = "enrollment")]
pub(in crate::http) async fn pending(
    State(robots): State<RobotActions>,
) -> Result<Json<PendingRobotList>, ApiError> {
    Ok(Json(robots.pending().await?))
}

/// Approves a waiting robot.
#[operation(tag = "enrollment")]
pub(in crate::http) async fn approve(
    State(store): State<Store>,
    State(robots): State<RobotActions>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<NoContent, ApiError> {
    let id = find(&store, &by, &robot).await?;
    robots.approve(&by, &id).await?;
    Ok(NoContent)
}

/// Rejects a waiting robot.
#[operation(tag = "enrollment",
    responses((status = 409, description = "`not_pending`: the robot does not wait for approval.")))]
pub(in crate::http) async fn reject(
    State(store): State<Store>,
    State(robots): State<RobotActions>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<NoContent, ApiError> {
    let id = find(&store, &by, &robot).await?;
    robots.reject(&by, &id).await?;
    Ok(NoContent)
}
