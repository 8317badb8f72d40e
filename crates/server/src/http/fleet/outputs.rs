//! Outputs of tasks, listed for the operator's commands and the page. The bytes belong to the
//! registry.

use axum::Json;
use axum::extract::State;
use serde::Deserialize;
use task_macros::operation;
use task_proto::api::OutputList;
use task_proto::{RobotName, TaskName};
use utoipa::IntoParams;

use super::robots::find;
use crate::domain::person::{Person, Scope};
use crate::http::error::ApiError;
use crate::http::extract::QueryParams;
use crate::store::Store;

/// The query of `GET /outputs`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct ListQuery {
    /// Only outputs of this robot, by id or name.
    #[param(inline)]
    robot: Option<RobotName>,
    /// Only outputs of this task.
    #[param(inline)]
    task: Option<TaskName>,
}

/// Lists the outputs of one robot or of all robots.
#[operation(tag = "outputs",
    responses((status = 404, description = "There is no such robot.")))]
pub(in crate::http) async fn list(
    State(store): State<Store>,
    by: Person,
    QueryParams(query): QueryParams<ListQuery>,
) -> Result<Json<OutputList>, ApiError> {
    let robot = match &query.robot {
        Some(robot) => Some(find(&store, &by, robot).await?),
        None => None,
    };
    let scope = if robot.is_some() { &Scope::everything() } else { &by.scope };
    Ok(Json(OutputList {
        outputs: store.outputs().list(robot.as_ref(), query.task.as_ref(), scope).await?,
    }))
}
