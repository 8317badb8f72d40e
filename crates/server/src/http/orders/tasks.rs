//! Orders on tasks that robots have: start, restart, stop, remove, and roll back to the previous
//! package.

use axum::Json;
use axum::extract::State;
use http::HeaderMap;
use task_macros::operation;
use task_proto::TaskName;
use task_proto::api::{IDEMPOTENCY_KEY, MatchedRobots, OrderTask, RolledBack};

use crate::domain::person::Person;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam, idempotency_key};
use crate::http::openapi::{OrderKey, OrderRefusals};
use crate::http::views::Views;
use crate::orders::actions::{DeploymentActions, Rollback, TaskOrder};

/// Starts a task on robots that have it. A job runs once more.
#[operation(tag = "tasks", params(OrderKey), responses(OrderRefusals))]
pub(in crate::http) async fn start(
    State(deployments): State<DeploymentActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&deployments, &views, &by, TaskOrder::Start, &task, &headers, &request).await
}

/// Restarts a task on robots that have it. A running instance is stopped first.
#[operation(tag = "tasks", params(OrderKey), responses(OrderRefusals))]
pub(in crate::http) async fn restart(
    State(deployments): State<DeploymentActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&deployments, &views, &by, TaskOrder::Restart, &task, &headers, &request).await
}

/// Rolls robots back to the package of a task that ran there before the current one.
#[operation(tag = "tasks", params(OrderKey),
    responses((status = 404, description = "`unknown_robots`: the selector names unknown robots."),
        (status = 409, description = "`no_robots_match`, `nothing_to_roll_back`: none of the robots had another package \
        before, or `idempotency_key_reused`: the key was used for another order.")))]
pub(in crate::http) async fn rollback(
    State(deployments): State<DeploymentActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<RolledBack>, ApiError> {
    let Rollback { deployments: ids, robots, without } = if request.dry_run {
        deployments.preview_rollback(&by, &task, &request.selector).await?
    } else {
        let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
        deployments.rollback(&by, &key, &task, &request.selector).await?
    };
    let mut deployments = Vec::with_capacity(ids.len());
    for id in &ids {
        deployments.push(views.deployment(&by, id, false).await?);
    }
    let (robots, without) = (views.matched(robots).robots, views.matched(without).robots);
    Ok(Json(RolledBack { deployments, robots, without }))
}

/// Stops a task on robots that have it. The task stays installed.
#[operation(tag = "tasks", params(OrderKey), responses(OrderRefusals))]
pub(in crate::http) async fn stop(
    State(deployments): State<DeploymentActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&deployments, &views, &by, TaskOrder::Stop, &task, &headers, &request).await
}

/// Removes a task from robots.
#[operation(tag = "tasks", params(OrderKey), responses(OrderRefusals))]
pub(in crate::http) async fn remove(
    State(deployments): State<DeploymentActions>,
    State(views): State<Views>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&deployments, &views, &by, TaskOrder::Remove, &task, &headers, &request).await
}

async fn order(
    deployments: &DeploymentActions,
    views: &Views,
    by: &Person,
    order: TaskOrder,
    task: &TaskName,
    headers: &HeaderMap,
    request: &OrderTask,
) -> Result<Json<MatchedRobots>, ApiError> {
    let robots = if request.dry_run {
        deployments.preview_task_order(by, task, &request.selector).await?
    } else {
        let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
        deployments.order_task(by, &key, order, task, &request.selector).await?
    };
    Ok(Json(views.matched(robots)))
}
