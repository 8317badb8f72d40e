//! Who is calling, and may they: every route names its [`Access`], the guard finds the [`Caller`] and refuses the rest.
//! Secrets are compared as SHA-256 in constant time. It never decides what a caller's order means.

use axum::extract::FromRequestParts;
use http::request::Parts;
use task_proto::RobotId;

use super::error::ApiError;

/// Who may call a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Everybody, known or not.
    Anyone,
    /// A person with an operator token or a signed-in page.
    Operator,
    /// The robot that the path's `{robot}` names, and no other.
    OwnRobot,
    /// A machine with an enrolment token that is still good.
    Enrolment,
    /// An operator, or any robot; the handler narrows what a robot gets.
    OperatorOrRobot,
}

/// Who is calling, as the guard found out. Handlers take it as an argument.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Caller {
    /// Nobody known: only on routes for anyone.
    Anyone,
    /// An operator.
    Operator {
        /// The public part of the token.
        token_id: String,
    },
    /// A robot.
    Robot(RobotId),
    /// The holder of an enrolment token.
    Enrolment {
        /// The public part of the token.
        token_id: String,
    },
}

impl Caller {
    /// The robot that calls; `None` for everybody else.
    pub fn robot(&self) -> Option<&RobotId> {
        match self {
            Self::Robot(robot) => Some(robot),
            _ => None,
        }
    }

    /// Whether an operator calls.
    pub fn is_operator(&self) -> bool {
        matches!(self, Self::Operator { .. })
    }
}

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> Result<Self, ApiError> {
        // Absent only if a handler was mounted without the guard: then nobody is let in.
        parts.extensions.get::<Self>().cloned().ok_or_else(|| ApiError::unauthorized("this route has no guard"))
    }
}
