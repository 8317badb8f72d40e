//! Robots come, are edited and go; and the tokens they come with.

use task_proto::api::{CreateEnrollmentToken, EditRobot, EnrollRequest, EnrollmentToken, MatchedRobot};
use task_proto::selector::Selector;
use task_proto::token::Token;
use task_proto::{RobotId, RobotName};

use super::{ActionError, Actions};

/// A robot that has just registered.
#[derive(Debug)]
pub struct Enrolled {
    /// Its identity.
    pub robot_id: RobotId,
    /// The name it got.
    pub name: RobotName,
    /// Its token, shown this once.
    pub token: Token,
}

impl Actions {
    /// Registers a robot that holds the enrolment token `token`.
    pub async fn enroll(&self, token: &Token, request: &EnrollRequest) -> Result<Enrolled, ActionError> {
        todo!()
    }

    /// Makes an enrolment token.
    pub async fn create_enrollment_token(&self, order: &CreateEnrollmentToken) -> Result<EnrollmentToken, ActionError> {
        todo!()
    }

    /// Changes a robot's name or labels.
    pub async fn edit_robot(&self, robot: &RobotId, edit: &EditRobot) -> Result<(), ActionError> {
        todo!()
    }

    /// Removes a robot: its tokens end now, its MAC and name are free, its id is never used again.
    pub async fn remove_robot(&self, robot: &RobotId) -> Result<(), ActionError> {
        todo!()
    }

    /// The robots a selector means now, sorted by name; an error if nobody. `online` is left false.
    pub async fn matching_robots(&self, selector: &Selector) -> Result<Vec<MatchedRobot>, ActionError> {
        todo!()
    }
}
