//! Enrolment: tokens for robots to come, the robots that come with them, and those that wait to be approved.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use http::StatusCode;
use task_proto::api::{
    CreateEnrollmentToken, EnrollRequest, EnrollResponse, EnrollmentToken, EnrollmentTokenList, PendingRobotList,
};
use task_proto::{RobotName, TokenId};

use super::App;
use super::auth::Caller;
use super::broker::endpoint_of;
use super::error::ApiError;
use super::extract::{JsonBody, PathParam, TolerantJson};
use super::robots::find;
use crate::person::Person;

/// `POST /enroll`: registers the robot that holds the token.
pub(super) async fn enroll(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    caller: Caller,
    TolerantJson(request): TolerantJson<EnrollRequest>,
) -> Result<(StatusCode, Json<EnrollResponse>), ApiError> {
    let Caller::Enrolment(token) = caller else {
        return Err(ApiError::forbidden("an enrolment token is needed"));
    };
    let enrolled = app.actions.enroll(&token, &request, Some(peer.ip().to_canonical())).await?;
    let mqtt = endpoint_of(&app, &enrolled.robot_id).await?;
    let (token, awaits_approval) = (enrolled.token.reveal(), enrolled.awaits_approval);
    let answer = EnrollResponse { robot_id: enrolled.robot_id, name: enrolled.name, token, mqtt, awaits_approval };
    Ok((StatusCode::CREATED, Json(answer)))
}

/// `POST /enrollment-tokens`: makes a token.
pub(super) async fn create_token(
    State(app): State<App>,
    by: Person,
    JsonBody(order): JsonBody<CreateEnrollmentToken>,
) -> Result<(StatusCode, Json<EnrollmentToken>), ApiError> {
    Ok((StatusCode::CREATED, Json(app.actions.create_enrollment_token(&by, &order).await?)))
}

/// `GET /enrollment-tokens`: those that are good for something.
pub(super) async fn tokens(State(app): State<App>) -> Result<Json<EnrollmentTokenList>, ApiError> {
    Ok(Json(app.actions.enrollment_tokens().await?))
}

/// `DELETE /enrollment-tokens/{enrollment}`: revokes one.
pub(super) async fn revoke_token(
    State(app): State<App>,
    by: Person,
    PathParam(token): PathParam<TokenId>,
) -> Result<StatusCode, ApiError> {
    app.actions.revoke_enrollment_token(&by, &token).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// `GET /pending-robots`: those that wait to be approved.
pub(super) async fn pending(State(app): State<App>) -> Result<Json<PendingRobotList>, ApiError> {
    Ok(Json(app.actions.pending_robots().await?))
}

/// `POST /robots/{robot}/approve`: lets one in.
pub(super) async fn approve(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<StatusCode, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.approve_robot(&by, &id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// `POST /robots/{robot}/reject`: turns one away that waits.
pub(super) async fn reject(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<StatusCode, ApiError> {
    let id = find(&app, &by, &robot).await?;
    app.actions.reject_robot(&by, &id).await?;
    Ok(StatusCode::NO_CONTENT)
}
