//! Deployments: order, list, show, cancel and retry them, and resume a paused one.

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use http::{HeaderMap, StatusCode, Uri};
use serde::Deserialize;
use task_proto::DeploymentId;
use task_proto::api::{
    CreateDeployment, DeploymentList, DeploymentView, IDEMPOTENCY_KEY, MatchedRobots,
    RetryDeployment,
};

use crate::http::App;
use crate::http::error::ApiError;
use utoipa::IntoParams;

use crate::domain::person::Person;
use crate::http::extract::{JsonBody, PathParam, QueryParams, idempotency_key, page_limit};
use crate::http::openapi::OrderKey;
use crate::http::shared_lists::{ListKey, SharedJson};
use crate::http::views::{complete_deployment, complete_matched, narrowed, without_others};

/// The query of `GET /deployments`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct ListQuery {
    /// Maximum number of deployments. Default: 200.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<u32>,
    /// Only deployments created before this one.
    #[param(inline)]
    before: Option<DeploymentId>,
}

/// Default number of listed deployments.
const LISTED: u32 = 200;

/// Lists deployments in pages, the newest first, each limited to the caller's robots.
#[utoipa::path(get, path = "/api/v1/deployments", tag = "deployments",
    responses((status = 404, description = "There is no deployment `before`.")))]
pub(in crate::http) async fn list(
    State(app): State<App>,
    by: Person,
    uri: Uri,
    QueryParams(query): QueryParams<ListQuery>,
) -> Result<SharedJson<DeploymentList>, ApiError> {
    app.lists.get(ListKey::new(&by.scope, &uri), listed(&app, &by, &query)).await
}

async fn listed(app: &App, by: &Person, query: &ListQuery) -> Result<DeploymentList, ApiError> {
    let limit = page_limit(query.limit)?.unwrap_or(LISTED);
    let robots = match by.scope.is_everything() {
        true => None,
        false => Some(app.store.robots_in(&by.scope).await?),
    };
    let before = query.before.as_ref();
    let page = app.store.deployments(robots.as_deref(), before, limit).await?.ok_or_else(|| {
        let before = before.map(DeploymentId::as_str).unwrap_or_default();
        ApiError::not_found(format!("before: there is no deployment {before}"))
    })?;
    let deployments = match by.scope.is_everything() {
        true => page.deployments,
        false => page.deployments.into_iter().map(without_others).collect(),
    };
    Ok(DeploymentList { deployments, next: page.next })
}

/// The query of `GET /deployments/{deployment}`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct ShowQuery {
    /// Whether each assignment includes the times at which it entered its phases.
    #[serde(default)]
    #[param(required = false)]
    timeline: bool,
}

/// Shows one deployment with its assignments.
#[utoipa::path(get, path = "/api/v1/deployments/{deployment}", tag = "deployments")]
pub(in crate::http) async fn show(
    State(app): State<App>,
    by: Person,
    uri: Uri,
    PathParam(id): PathParam<DeploymentId>,
    QueryParams(query): QueryParams<ShowQuery>,
) -> Result<SharedJson<DeploymentView>, ApiError> {
    app.lists.get(ListKey::new(&by.scope, &uri), seen(&app, &by, &id, query.timeline)).await
}

/// Deploys a package to robots, or with a dry run only lists the robots.
#[utoipa::path(post, path = "/api/v1/deployments", tag = "deployments", params(OrderKey),
    responses((status = 200, description = "A dry run: the robots it would be.", body = MatchedRobots),
        (status = 201, description = "The deployment.", body = DeploymentView),
        (status = 404, description = "`package_not_found`: nobody has pushed that; `unknown_robots`: the selector names \
            robots that there are not."),
        (status = 409, description = "`no_robots_match`, or `idempotency_key_reused` for another order."),
        (status = 422, description = "`package_too_large`: so much does not fit into the announcement.")))]
pub(in crate::http) async fn create(
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
        None => {
            app.actions.deployment_ordered_before(&by, &key, &order).await?.ok_or_else(|| {
                let message = format!(
                    "manifest: there is no package {} with manifest {}",
                    order.package, order.manifest
                );
                ApiError::new(StatusCode::NOT_FOUND, "package_not_found", message)
            })?
        }
    };
    Ok((StatusCode::CREATED, Json(view(&app, &by, &id).await?)).into_response())
}

/// Cancels a deployment.
#[utoipa::path(post, path = "/api/v1/deployments/{deployment}/cancel", tag = "deployments",
    responses((status = 409, description = "`nothing_to_cancel`: it is over on all of its robots.")))]
pub(in crate::http) async fn cancel(
    State(app): State<App>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    app.actions.cancel_deployment(&by, &id).await?;
    view(&app, &by, &id).await.map(Json)
}

/// Resumes a paused deployment.
#[utoipa::path(post, path = "/api/v1/deployments/{deployment}/resume", tag = "deployments",
    responses((status = 409, description = "`deployment_cancelled`: it was taken back; `not_paused`: \
        nothing is to be resumed, and what it waits for.")))]
pub(in crate::http) async fn resume(
    State(app): State<App>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    app.actions.resume_deployment(&by, &id).await?;
    view(&app, &by, &id).await.map(Json)
}

/// Retries a deployment where it ended badly, or with a dry run only lists the robots.
#[utoipa::path(post, path = "/api/v1/deployments/{deployment}/retry", tag = "deployments", params(OrderKey),
    responses((status = 200, description = "A dry run: the robots it would be.", body = MatchedRobots),
        (status = 201, description = "The new deployment.", body = DeploymentView),
        (status = 404, description = "There is no such deployment, `package_not_found`: its package was deleted, or \
            `unknown_robots`: the selector names robots that there are not."),
        (status = 409, description = "`nothing_to_retry`, or `idempotency_key_reused` for another order.")))]
pub(in crate::http) async fn retry(
    State(app): State<App>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
    headers: HeaderMap,
    JsonBody(order): JsonBody<RetryDeployment>,
) -> Result<Response, ApiError> {
    if order.dry_run {
        let mut robots = app.actions.robots_to_retry(&by, &id, &order).await?;
        complete_matched(&mut robots, &app.presence, app.clock.now_ms());
        return Ok(Json(MatchedRobots { robots }).into_response());
    }
    let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
    let id = app.actions.retry_deployment(&by, &key, &id, &order).await?;
    Ok((StatusCode::CREATED, Json(view(&app, &by, &id).await?)).into_response())
}

/// The part of a deployment that concerns the person, without timelines.
pub(in crate::http) async fn view(
    app: &App,
    by: &Person,
    id: &DeploymentId,
) -> Result<DeploymentView, ApiError> {
    seen(app, by, id, false).await
}

async fn seen(
    app: &App,
    by: &Person,
    id: &DeploymentId,
    with_timelines: bool,
) -> Result<DeploymentView, ApiError> {
    let found = app.store.deployment(id, with_timelines).await?;
    let mut view =
        found.ok_or_else(|| ApiError::not_found(format!("there is no deployment {id}")))?;
    if !by.scope.is_everything() {
        let robots = app.store.robots_in(&by.scope).await?.into_iter().collect();
        view = narrowed(view, &robots)
            .ok_or_else(|| ApiError::out_of_scope(format!("deployment {id}"), by))?;
    }
    complete_deployment(&mut view, &app.presence, app.clock.now_ms());
    Ok(view)
}
