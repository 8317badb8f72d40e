//! Enrolment: tokens for robots to come, and the robots that come with them.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use http::StatusCode;
use task_proto::TokenId;
use task_proto::api::{CreateEnrollmentToken, EnrollRequest, EnrollResponse, EnrollmentToken, EnrollmentTokenList};

use super::App;
use super::auth::Caller;
use super::broker::endpoint_of;
use super::error::ApiError;
use super::extract::{JsonBody, PathParam, TolerantJson};
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
    let answer =
        EnrollResponse { robot_id: enrolled.robot_id, name: enrolled.name, token: enrolled.token.reveal(), mqtt };
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
