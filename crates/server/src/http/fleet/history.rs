//! The history of a robot's orders and their outcomes.

use axum::Json;
use axum::extract::State;
use serde::Deserialize;
use task_macros::operation;
use task_proto::api::TaskHistory;
use task_proto::{DeploymentId, RobotName, TaskName};
use utoipa::IntoParams;

use super::robots::find;
use crate::domain::person::Person;
use crate::http::error::ApiError;
use crate::http::extract::{PathParam, QueryParams};
use crate::store::{HistoryQuery, Store};

/// The default and the largest number of listed assignments.
const DEFAULT_LIMIT: u32 = 50;
const MAX_LIMIT: u32 = 200;

/// The query of `GET /robots/{robot}/tasks`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct Query {
    /// Maximum number of entries. Default: 50.
    #[param(minimum = 1, maximum = 200)]
    limit: Option<u32>,
    /// Only entries ordered before this deployment.
    #[param(inline)]
    before: Option<DeploymentId>,
    /// Only entries of this task.
    #[param(inline)]
    task: Option<TaskName>,
}

/// Lists a robot's past and present assignments with their outcomes, the newest first.
#[operation(tag = "robots",
    responses((status = 404, description = "There is no such robot, or no deployment `before`.")))]
pub(in crate::http) async fn tasks(
    State(store): State<Store>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
    QueryParams(query): QueryParams<Query>,
) -> Result<Json<TaskHistory>, ApiError> {
    let id = find(&store, &by, &robot).await?;
    let limit = query.limit.unwrap_or(DEFAULT_LIMIT);
    if !(1..=MAX_LIMIT).contains(&limit) {
        return Err(ApiError::invalid(format!("limit: {limit} is not between 1 and {MAX_LIMIT}")));
    }
    let history_query =
        HistoryQuery { task: query.task.as_ref(), before: query.before.as_ref(), limit };
    let page = store.assignments().history(&id, history_query).await?.ok_or_else(|| {
        let before = query.before.as_ref().map(DeploymentId::as_str).unwrap_or_default();
        ApiError::not_found(format!("before: there is no deployment {before}"))
    })?;
    Ok(Json(TaskHistory { assignments: page.assignments, next: page.next }))
}
