//! Deployments: order one, look at them, take one back, let a paused one go on.

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use http::{HeaderMap, StatusCode};
use task_proto::DeploymentId;
use task_proto::api::{CreateDeployment, DeploymentList, DeploymentView, IDEMPOTENCY_KEY, MatchedRobots};

use super::App;
use super::error::ApiError;
use super::extract::{JsonBody, PathParam, idempotency_key};
use super::views::{complete_deployment, complete_matched};

/// `GET /deployments`: the newest first.
pub(super) async fn list(State(app): State<App>) -> Result<Json<DeploymentList>, ApiError> {
    Ok(Json(DeploymentList { deployments: app.store.deployments().await? }))
}

/// `GET /deployments/{deployment}`: one, with its assignments.
pub(super) async fn show(
    State(app): State<App>,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    view(&app, &id).await.map(Json)
}

/// `POST /deployments`: orders a package on robots, or only says which robots that would be.
pub(super) async fn create(
    State(app): State<App>,
    headers: HeaderMap,
    JsonBody(order): JsonBody<CreateDeployment>,
) -> Result<Response, ApiError> {
    if order.dry_run {
        let mut robots = app.actions.matching_robots(&order.selector).await?;
        complete_matched(&mut robots, &app.presence, app.clock.now_ms());
        return Ok(Json(MatchedRobots { robots }).into_response());
    }
    let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
    let id = match app.store.package(&order.package, &order.manifest).await? {
        Some(package) => app.actions.create_deployment(&key, &order, &package).await?,
        None => app.actions.deployment_ordered_before(&key, &order).await?.ok_or_else(|| {
            let message = format!("manifest: there is no package {} with manifest {}", order.package, order.manifest);
            ApiError::new(StatusCode::NOT_FOUND, "package_not_found", message)
        })?,
    };
    Ok((StatusCode::CREATED, Json(view(&app, &id).await?)).into_response())
}

/// `POST /deployments/{deployment}/cancel`: interrupts it.
pub(super) async fn cancel(
    State(app): State<App>,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    app.actions.cancel_deployment(&id).await?;
    view(&app, &id).await.map(Json)
}

/// `POST /deployments/{deployment}/resume`: lets a paused one go on.
pub(super) async fn resume(
    State(app): State<App>,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    app.actions.resume_deployment(&id).await?;
    view(&app, &id).await.map(Json)
}

async fn view(app: &App, id: &DeploymentId) -> Result<DeploymentView, ApiError> {
    let found = app.store.deployment(id).await?;
    let mut view = found.ok_or_else(|| ApiError::not_found(format!("there is no deployment {id}")))?;
    complete_deployment(&mut view, &app.presence, app.clock.now_ms());
    Ok(view)
}
