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
use super::views::{complete_deployment, complete_matched, narrowed};
use crate::person::Person;

/// `GET /deployments`: the newest first; of each only what concerns the person's robots.
pub(super) async fn list(State(app): State<App>, by: Person) -> Result<Json<DeploymentList>, ApiError> {
    let deployments = if by.scope.is_everything() {
        app.store.deployments().await?
    } else {
        app.store.deployments_of(&app.store.robots_in(&by.scope).await?).await?
    };
    Ok(Json(DeploymentList { deployments }))
}

/// `GET /deployments/{deployment}`: one, with its assignments.
pub(super) async fn show(
    State(app): State<App>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    view(&app, &by, &id).await.map(Json)
}

/// `POST /deployments`: orders a package on robots, or only says which robots that would be.
pub(super) async fn create(
    State(app): State<App>,
    by: Person,
    headers: HeaderMap,
    JsonBody(order): JsonBody<CreateDeployment>,
) -> Result<Response, ApiError> {
    if order.dry_run {
        let mut robots = app.actions.matching_robots(&by, &order.selector).await?;
        complete_matched(&mut robots, &app.presence, app.clock.now_ms());
        return Ok(Json(MatchedRobots { robots }).into_response());
    }
    let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
    let id = match app.store.package(&order.package, &order.manifest).await? {
        Some(package) => app.actions.create_deployment(&by, &key, &order, &package).await?,
        None => app.actions.deployment_ordered_before(&by, &key, &order).await?.ok_or_else(|| {
            let message = format!("manifest: there is no package {} with manifest {}", order.package, order.manifest);
            ApiError::new(StatusCode::NOT_FOUND, "package_not_found", message)
        })?,
    };
    Ok((StatusCode::CREATED, Json(view(&app, &by, &id).await?)).into_response())
}

/// `POST /deployments/{deployment}/cancel`: interrupts it.
pub(super) async fn cancel(
    State(app): State<App>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    app.actions.cancel_deployment(&by, &id).await?;
    view(&app, &by, &id).await.map(Json)
}

/// `POST /deployments/{deployment}/resume`: lets a paused one go on.
pub(super) async fn resume(
    State(app): State<App>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    app.actions.resume_deployment(&by, &id).await?;
    view(&app, &by, &id).await.map(Json)
}

async fn view(app: &App, by: &Person, id: &DeploymentId) -> Result<DeploymentView, ApiError> {
    let found = app.store.deployment(id).await?;
    let mut view = found.ok_or_else(|| ApiError::not_found(format!("there is no deployment {id}")))?;
    if !by.scope.is_everything() {
        let robots = app.store.robots_in(&by.scope).await?.into_iter().collect();
        view = narrowed(view, &robots).ok_or_else(|| ApiError::out_of_scope(format!("deployment {id}"), by))?;
    }
    complete_deployment(&mut view, &app.presence, app.clock.now_ms());
    Ok(view)
}
