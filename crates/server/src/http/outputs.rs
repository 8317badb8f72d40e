//! What tasks brought back, as the operator's commands and the page list it. The bytes are the registry's.

use axum::Json;
use axum::extract::State;
use serde::Deserialize;
use task_proto::api::OutputList;
use task_proto::{RobotName, TaskName};

use super::App;
use super::error::ApiError;
use super::extract::QueryParams;
use super::robots::find;
use crate::person::{Person, Scope};

/// The query of `GET /outputs`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    robot: Option<RobotName>,
    task: Option<TaskName>,
}

/// `GET /outputs`: what came back, of one robot or of all.
pub(super) async fn list(
    State(app): State<App>,
    by: Person,
    QueryParams(query): QueryParams<ListQuery>,
) -> Result<Json<OutputList>, ApiError> {
    let robot = match &query.robot {
        Some(robot) => Some(find(&app, &by, robot).await?),
        None => None,
    };
    let scope = if robot.is_some() { &Scope::everything() } else { &by.scope };
    Ok(Json(OutputList { outputs: app.store.outputs(robot.as_ref(), query.task.as_ref(), scope).await? }))
}
