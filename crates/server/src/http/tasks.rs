//! Orders on tasks that robots have: start, stop, remove.

use axum::Json;
use axum::extract::State;
use http::HeaderMap;
use task_proto::TaskName;
use task_proto::api::{IDEMPOTENCY_KEY, MatchedRobots, OrderTask};

use super::App;
use super::error::ApiError;
use super::extract::{JsonBody, PathParam, idempotency_key};
use super::views::complete_matched;
use crate::actions::TaskOrder;
use crate::person::Person;

/// `POST /tasks/{task}/start`
pub(super) async fn start(
    State(app): State<App>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&app, &by, TaskOrder::Start, &task, &headers, &request).await
}

/// `POST /tasks/{task}/stop`
pub(super) async fn stop(
    State(app): State<App>,
    by: Person,
    PathParam(task): PathParam<TaskName>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<OrderTask>,
) -> Result<Json<MatchedRobots>, ApiError> {
    order(&app, &by, TaskOrder::Stop, &task, &headers, &request).await
}

/// `POST /tasks/{task}/remove`
pub(super) async fn remove(
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
