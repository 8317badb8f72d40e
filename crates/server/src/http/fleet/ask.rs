//! Questions to one robot: passed on by the server, answered by the robot itself. Questions that
//! change something need more permission than those that read.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use http::StatusCode;
use task_proto::RobotName;
use task_proto::id::RequestId;
use task_proto::person::Permission;
use task_proto::request::{Action, Answer, Ask, Refusal};

use super::robots::find;
use crate::domain::person::Person;
use crate::fleet::requests::RequestError;
use crate::http::App;
use crate::http::auth::not_permitted;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam};
use crate::orders::changes::Change;

/// Time limit for the robot's answer. The longest case is a lifecycle transition on a slow robot.
const PATIENCE: Duration = Duration::from_secs(20);

/// Sends a question to the robot and returns the answer.
///
/// Questions that change something require the permission `operate`.
#[utoipa::path(post, path = "/api/v1/robots/{robot}/ask", tag = "robots",
    responses((status = 409, description = "`robot_offline`, or what the robot says of why it gives no answer: `no_ros`, `no_such_node`, …."),
        (status = 503, description = "Too many questions to it are under way."),
        (status = 504, description = "`robot_silent`: it did not answer in time.")))]
pub(in crate::http) async fn ask(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
    JsonBody(ask): JsonBody<Ask>,
) -> Result<Json<Answer>, ApiError> {
    if ask == Ask::Unknown {
        return Err(ApiError::invalid("type: there is no such question"));
    }
    let id = find(&app, &by, &robot).await?;
    let mut answer = if ask.changes_something() {
        if !by.may(Permission::Operate) {
            return Err(not_permitted(&by, Permission::Operate));
        }
        // Every agent announces its instance as soon as it connects.
        let instance = app.presence.instance(&id).ok_or(RequestError::NotConnected)?;
        let action = Action { robot_id: id.clone(), instance, id: RequestId::random(), ask };
        let signed = app.actions.sign_action(&by, &action).await?;
        app.requests.act(&app.broker, action, signed, PATIENCE).await?
    } else {
        app.requests.ask(&app.broker, &id, ask, PATIENCE).await?
    };
    if let Answer::Vitals(vitals) = &mut answer {
        // A robot's clock and figures are untrusted.
        *vitals = app.vitals.take(&id, *vitals, app.clock.now_ms());
        app.changes.announce(Change::Robot(id));
    }
    Ok(Json(answer))
}

impl From<RequestError> for ApiError {
    fn from(error: RequestError) -> Self {
        let message = error.to_string();
        match error {
            RequestError::NotConnected => Self::conflict("robot_offline", message),
            RequestError::Busy => Self::unavailable(message),
            RequestError::TimedOut { .. } => {
                Self::new(StatusCode::GATEWAY_TIMEOUT, "robot_silent", message)
            }
            RequestError::Refused(refusal) => Self::conflict(code(&refusal), message),
            RequestError::Unwritable(_) => Self::internal(&error),
        }
    }
}

/// The robot's code, if this version knows the code.
fn code(refusal: &Refusal) -> &'static str {
    const KNOWN: [&str; 10] = [
        "no_ros",
        "no_such_node",
        "no_such_parameter",
        "no_such_task",
        "rejected",
        "timeout",
        "too_large",
        "busy",
        "unsigned",
        "unsupported",
    ];
    KNOWN.into_iter().find(|known| *known == refusal.code).unwrap_or("refused")
}
