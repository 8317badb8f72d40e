//! A robot's desired state: read, signed, and kept until it changes or its lifetime is half over.

use task_proto::envelope::Envelope;
use task_proto::{Generation, RobotId};

use super::{ActionError, Actions};

/// A robot's signed desired state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Desired {
    /// Its generation.
    pub generation: Generation,
    /// The signed document.
    pub envelope: Envelope,
}

#[derive(Debug, Default)]
pub(super) struct Envelopes;

impl Actions {
    /// What `robot` should be running, signed. Refused as `diverged` while the robot is ahead of the database.
    pub async fn desired(&self, robot: &RobotId) -> Result<Desired, ActionError> {
        todo!()
    }
}
