//! Orders on tasks that robots have: start, restart, stop, remove, and roll back to the previous
//! package.

use axum::Json;
use axum::extract::State;
use http::HeaderMap;
use task_proto::TaskName;
use task_proto::api::{IDEMPOTENCY_KEY, MatchedRobots, OrderTask, RolledBack};

use super::deployments;
use crate::domain::person::Person;
use crate::http::App;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam, idempotency_key};
use crate::http::openapi::OrderKey;
use crate::http::views::complete_matched;
use crate::orders::actions::{Rollback, TaskOrder};

/// Starts a task on robots that have it. A job runs once more.
#[utoipa::path(post, path = "/api/v1/tasks/{task}/start", tag = "tasks", params(OrderKey),
    responses((status = 404, description = "`unknown_robots`: the selector names robots that there are not."),
        (status = 409, description = "`no_robots_match`, or `idempotency_key_reused` for another order.")))]
pub(in crate::http) async fn start(
    State(app): State<App>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&app, &by, TaskOrder::Start, &task, &headers, &request).await
}

/// Restarts a task on robots that have it. A running instance is stopped first.
#[utoipa::path(post, path = "/api/v1/tasks/{task}/restart", tag = "tasks", params(OrderKey),
    responses((status = 404, description = "`unknown_robots`: the selector names robots that there are not."),
        (status = 409, description = "`no_robots_match`, or `idempotency_key_reused` for another order.")))]
pub(in crate::http) async fn restart(
    State(app): State<App>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&app, &by, TaskOrder::Restart, &task, &headers, &request).await
}

/// Rolls robots back to the package of a task that ran there before the current one.
#[utoipa::path(post, path = "/api/v1/tasks/{task}/rollback", tag = "tasks", params(OrderKey),
    responses((status = 404, description = "`unknown_robots`: the selector names robots that there are not."),
        (status = 409, description = "`no_robots_match`, `nothing_to_roll_back`: none of them had another package \
        before, or `idempotency_key_reused` for another order.")))]
pub(in crate::http) async fn rollback(
    State(app): State<App>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<RolledBack>, ApiError> {
    let Rollback { deployments: ids, mut robots, mut without } = if request.dry_run {
        app.actions.rollback(&by, &task, &request.selector).await?
    } else {
        let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
        app.actions.roll_back(&by, &key, &task, &request.selector).await?
    };
    let mut deployments = Vec::with_capacity(ids.len());
    for id in &ids {
        deployments.push(deployments::view(&app, &by, id).await?);
    }
    let now_ms = app.clock.now_ms();
    complete_matched(&mut robots, &app.presence, now_ms);
    complete_matched(&mut without, &app.presence, now_ms);
    Ok(Json(RolledBack { deployments, robots, without }))
}

/// Stops a task on robots that have it. The task stays installed.
#[utoipa::path(post, path = "/api/v1/tasks/{task}/stop", tag = "tasks", params(OrderKey),
    responses((status = 404, description = "`unknown_robots`: the selector names robots that there are not."),
        (status = 409, description = "`no_robots_match`, or `idempotency_key_reused` for another order.")))]
pub(in crate::http) async fn stop(
    State(app): State<App>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&app, &by, TaskOrder::Stop, &task, &headers, &request).await
}

/// Removes a task from robots.
#[utoipa::path(post, path = "/api/v1/tasks/{task}/remove", tag = "tasks", params(OrderKey),
    responses((status = 404, description = "`unknown_robots`: the selector names robots that there are not."),
        (status = 409, description = "`no_robots_match`, or `idempotency_key_reused` for another order.")))]
pub(in crate::http) async fn remove(
    State(app): State<App>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&app, &by, TaskOrder::Remove, &task, &headers, &request).await
}

async fn order(
    app: &App,
    by: &Person,
    order: TaskOrder,
    task: &TaskName,
    headers: &HeaderMap,
    request: &OrderTask,
) -> Result<Json<MatchedRobots>, ApiError> {
    let mut robots = if request.dry_run {
        app.actions.robots_with_task(by, task, &request.selector).await?
    } else {
        let key = idempotency_key(headers.get(IDEMPOTENCY_KEY))?;
        app.actions.order_task(by, &key, order, task, &request.selector).await?
    };
    complete_matched(&mut robots, &app.presence, app.clock.now_ms());
    Ok(Json(MatchedRobots { robots }))
}
