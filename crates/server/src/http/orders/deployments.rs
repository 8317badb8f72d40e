//! Deployments: order, list, show, cancel and retry them, and resume a paused one.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use http::{HeaderMap, StatusCode, Uri};
use serde::Deserialize;
use task_macros::operation;
use task_proto::DeploymentId;
use task_proto::api::{
    CreateDeployment, DeploymentList, DeploymentView, IDEMPOTENCY_KEY, MatchedRobots,
    RetryDeployment,
};

use utoipa::IntoParams;

use crate::domain::person::Person;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam, QueryParams, idempotency_key, page_limit};
use crate::http::openapi::OrderKey;
use crate::http::shared_lists::{ListKey, SharedJson, SharedLists};
use crate::http::views::{Views, without_others};
use crate::orders::actions::DeploymentActions;
use crate::store::{DeploymentRow, Store};

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
const DEFAULT_LIMIT: u32 = 200;

/// Lists deployments in pages, the newest first, each limited to the caller's robots.
#[operation(tag = "deployments",
    responses((status = 404, description = "There is no deployment `before`.")))]
pub(in crate::http) async fn list(
    State(lists): State<Arc<SharedLists>>,
    State(store): State<Store>,
    by: Person,
    uri: Uri,
    QueryParams(query): QueryParams<ListQuery>,
) -> Result<SharedJson<DeploymentList>, ApiError> {
    lists.get(ListKey::new(&by.scope, &uri), listed(&store, &by, &query)).await
}

async fn listed(store: &Store, by: &Person, query: &ListQuery) -> Result<DeploymentList, ApiError> {
    let limit = page_limit(query.limit)?.unwrap_or(DEFAULT_LIMIT);
    let robots = match by.scope.is_everything() {
        true => None,
        false => Some(store.robots().ids_in(&by.scope).await?),
    };
    let before = query.before.as_ref();
    let page =
        store.deployments().page(robots.as_deref(), before, limit).await?.ok_or_else(|| {
            let before = before.map(DeploymentId::as_str).unwrap_or_default();
            ApiError::not_found(format!("before: there is no deployment {before}"))
        })?;
    let view = |row: DeploymentRow| {
        let row = if by.scope.is_everything() { row } else { without_others(row) };
        row.into_view(None)
    };
    let deployments = page.deployments.into_iter().map(view).collect();
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
#[operation(tag = "deployments")]
pub(in crate::http) async fn show(
    State(lists): State<Arc<SharedLists>>,
    State(views): State<Views>,
    by: Person,
    uri: Uri,
    PathParam(id): PathParam<DeploymentId>,
    QueryParams(query): QueryParams<ShowQuery>,
) -> Result<SharedJson<DeploymentView>, ApiError> {
    lists.get(ListKey::new(&by.scope, &uri), views.deployment(&by, &id, query.timeline)).await
}

/// Deploys a package to robots, or with a dry run only lists the robots.
#[operation(tag = "deployments", params(OrderKey),
    responses((status = 200, description = "The robots that match, for a dry run.", body = MatchedRobots),
        (status = 201, description = "The deployment.", body = DeploymentView),
        (status = 404, description = "`package_not_found`: there is no such package; `unknown_robots`: the selector names \
            unknown robots."),
        (status = 409, description = "`no_robots_match`, or `idempotency_key_reused`: the key was used for another order."),
        (status = 422, description = "`package_too_large`: the package does not fit into an announcement.")))]
pub(in crate::http) async fn create(
    State(deployments): State<DeploymentActions>,
    State(store): State<Store>,
    State(views): State<Views>,
    by: Person,
    headers: HeaderMap,
    JsonBody(order): JsonBody<CreateDeployment>,
) -> Result<Response, ApiError> {
    if order.dry_run {
        let robots = deployments.preview(&by, &order.selector).await?;
        return Ok(Json(views.matched(robots)).into_response());
    }
    let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
    let id = match store.packages().get(&order.package, &order.manifest).await? {
        Some(package) => deployments.create(&by, &key, &order, &package).await?,
        None => deployments.repeated(&by, &key, &order).await?.ok_or_else(|| {
            let message = format!(
                "manifest: there is no package {} with manifest {}",
                order.package, order.manifest
            );
            ApiError::new(StatusCode::NOT_FOUND, "package_not_found", message)
        })?,
    };
    Ok((StatusCode::CREATED, Json(views.deployment(&by, &id, false).await?)).into_response())
}

/// Cancels a deployment on its remaining robots.
#[operation(tag = "deployments",
    responses((status = 409, description = "`nothing_to_cancel`: the deployment has ended on all of its robots.")))]
pub(in crate::http) async fn cancel(
    State(deployments): State<DeploymentActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    deployments.cancel(&by, &id).await?;
    views.deployment(&by, &id, false).await.map(Json)
}

/// Resumes a paused deployment.
#[operation(tag = "deployments",
    responses((status = 409, description = "`deployment_cancelled`: the deployment was cancelled; `not_paused`: \
        the deployment is not paused. The message names what it waits for.")))]
pub(in crate::http) async fn resume(
    State(deployments): State<DeploymentActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
) -> Result<Json<DeploymentView>, ApiError> {
    deployments.resume(&by, &id).await?;
    views.deployment(&by, &id, false).await.map(Json)
}

/// Retries a deployment where it ended badly, or with a dry run only lists the robots.
#[operation(tag = "deployments", params(OrderKey),
    responses((status = 200, description = "The robots that match, for a dry run.", body = MatchedRobots),
        (status = 201, description = "The new deployment.", body = DeploymentView),
        (status = 404, description = "There is no such deployment, `package_not_found`: its package was deleted, or \
            `unknown_robots`: the selector names unknown robots."),
        (status = 409, description = "`nothing_to_retry`, or `idempotency_key_reused`: the key was used for another order.")))]
pub(in crate::http) async fn retry(
    State(deployments): State<DeploymentActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(id): PathParam<DeploymentId>,
    headers: HeaderMap,
    JsonBody(order): JsonBody<RetryDeployment>,
) -> Result<Response, ApiError> {
    if order.dry_run {
        let robots = deployments.preview_retry(&by, &id, &order).await?;
        return Ok(Json(views.matched(robots)).into_response());
    }
    let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
    let id = deployments.retry(&by, &key, &id, &order).await?;
    Ok((StatusCode::CREATED, Json(views.deployment(&by, &id, false).await?)).into_response())
}
