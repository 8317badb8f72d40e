//! Questions to one robot: passed on by the server, answered by the robot itself. Questions that
//! change something need more permission than those that read.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use http::StatusCode;
use task_macros::operation;
use task_proto::RobotName;
use task_proto::ids::RequestId;
use task_proto::messages::request::{Action, Answer, Ask, Refusal};
use task_proto::people::roles::Permission;

use super::live_robots::LiveRobots;
use super::robots::find;
use crate::domain::person::Person;
use crate::fleet::requests::RequestError;
use crate::http::auth::not_permitted;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam};
use crate::orders::actions::RobotActions;
use crate::store::Store;

/// Time limit for the robot's answer. The longest case is a lifecycle transition on a slow robot.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(20);

/// Sends a question to the robot and returns the answer.
///
/// Questions that change something require the permission `operate`.
#[operation(tag = "robots",
    responses((status = 409, description = "`robot_offline`, or the robot's reason: `no_ros`, `no_such_node`, …."),
        (status = 503, description = "Too many questions to this robot are in progress."),
        (status = 504, description = "`robot_silent`: the robot did not answer in time.")))]
pub(in crate::http) async fn ask(
    State(store): State<Store>,
    State(robots): State<RobotActions>,
    State(live): State<LiveRobots>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
    JsonBody(ask): JsonBody<Ask>,
) -> Result<Json<Answer>, ApiError> {
    if ask == Ask::Unknown {
        return Err(ApiError::invalid("type: unknown question"));
    }
    let id = find(&store, &by, &robot).await?;
    let mut answer = if ask.changes_something() {
        if !by.may(Permission::Operate) {
            return Err(not_permitted(&by, Permission::Operate));
        }
        // Every agent announces its instance as soon as it connects.
        let instance = live.presence.instance(&id).ok_or(RequestError::NotConnected)?;
        let action = Action { robot_id: id.clone(), instance, id: RequestId::random(), ask };
        let signed = robots.sign_action(&by, &action).await?;
        live.ask_signed(action, signed, ANSWER_TIMEOUT).await?
    } else {
        live.ask(&id, ask, ANSWER_TIMEOUT).await?
    };
    if let Answer::Vitals(vitals) = &mut answer {
        *vitals = live.record_vitals(id, *vitals);
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
            RequestError::Unserializable(_) => Self::internal(&error),
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
