//! Enrollment: tokens for new robots, the registration of robots with such a token, and the
//! approval of waiting robots.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use axum::response::NoContent;
use task_proto::api::{
    CreateEnrollmentToken, EnrollRequest, EnrollResponse, EnrollmentToken, EnrollmentTokenList,
    FeedKind, PendingRobotList,
};
use task_proto::{RobotName, TokenId};

use super::broker::endpoint_of;
use super::robots::find;
use crate::domain::happening::Happening;
use crate::domain::person::Person;
use crate::http::App;
use crate::http::auth::Caller;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam, TolerantJson};
use crate::http::openapi::Created;

/// Registers the robot that holds the token.
#[utoipa::path(post, path = "/api/v1/enroll", tag = "enrolment",
    responses((status = 409, description = "`mac_known`, `name_taken` or `enrolled_anew`."),
        (status = 429, description = "Too many robots wait to be approved, or too many tokens from this address were wrong.")))]
pub(in crate::http) async fn enroll(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    caller: Caller,
    TolerantJson(request): TolerantJson<EnrollRequest>,
) -> Result<Created<EnrollResponse>, ApiError> {
    let Caller::Enrolment(token) = caller else {
        return Err(ApiError::forbidden("an enrolment token is needed"));
    };
    let enrolled = app.actions.enroll(&token, &request, Some(peer.ip().to_canonical())).await?;
    let mqtt = endpoint_of(&app, &enrolled.robot_id).await?;
    let text = format!("registered from {}", peer.ip().to_canonical());
    app.changes.happened(Happening::Robot(
        enrolled.robot_id.clone(),
        FeedKind::RobotEnrolled,
        text,
    ));
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
#[utoipa::path(post, path = "/api/v1/enrollment-tokens", tag = "enrolment",
    responses((status = 404, description = "There is no such robot.")))]
pub(in crate::http) async fn create_token(
    State(app): State<App>,
    by: Person,
    JsonBody(order): JsonBody<CreateEnrollmentToken>,
) -> Result<Created<EnrollmentToken>, ApiError> {
    Ok(Created(app.actions.create_enrollment_token(&by, &order).await?))
}

/// Lists the enrollment tokens that are still usable.
#[utoipa::path(get, path = "/api/v1/enrollment-tokens", tag = "enrolment")]
pub(in crate::http) async fn tokens(
    State(app): State<App>,
) -> Result<Json<EnrollmentTokenList>, ApiError> {
    Ok(Json(app.actions.enrollment_tokens().await?))
}

/// Revokes an enrollment token.
#[utoipa::path(delete, path = "/api/v1/enrollment-tokens/{enrollment}", tag = "enrolment")]
pub(in crate::http) async fn revoke_token(
    State(app): State<App>,
    by: Person,
    PathParam(token): PathParam<TokenId>,
) -> Result<NoContent, ApiError> {
    app.actions.revoke_enrollment_token(&by, &token).await?;
    Ok(NoContent)
}

/// Lists the robots that wait for approval.
#[utoipa::path(get, path = "/api/v1/pending-robots", tag = "enrolment")]
pub(in crate::http) async fn pending(
    State(app): State<App>,
) -> Result<Json<PendingRobotList>, ApiError> {
    Ok(Json(app.actions.pending_robots().await?))
}

/// Approves a waiting robot.
#[utoipa::path(post, path = "/api/v1/robots/{robot}/approve", tag = "enrolment")]
pub(in crate::http) async fn approve(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<NoContent, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.approve_robot(&by, &id).await?;
    Ok(NoContent)
}

/// Rejects a waiting robot.
#[utoipa::path(post, path = "/api/v1/robots/{robot}/reject", tag = "enrolment",
    responses((status = 409, description = "`not_pending`: it does not wait.")))]
pub(in crate::http) async fn reject(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<NoContent, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.reject_robot(&by, &id).await?;
    Ok(NoContent)
}
