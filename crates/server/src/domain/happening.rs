//! Things that happened and are worth a look, as the place that notices them knows them.
//! [`crate::orders::feed`] tells them.

use std::sync::Arc;

use task_proto::api::FeedKind;
use task_proto::report::{Failure, Phase};
use task_proto::{DeploymentId, RobotId, RobotName};

/// Something that happened, as its own place knows it.
#[derive(Debug, Clone)]
pub enum Happening {
    /// A robot came, or went.
    Presence(RobotId, bool),
    /// A task came into a phase that is worth a look, or that mends one.
    Task(Arc<TaskNews>),
    /// Something about one robot.
    Robot(RobotId, FeedKind, String),
}

/// Where a robot's part of a deployment stands now.
#[derive(Debug)]
pub struct TaskNews {
    /// The robot.
    pub robot: RobotId,
    /// Its name.
    pub name: RobotName,
    /// The deployment.
    pub deployment: DeploymentId,
    /// The phase.
    pub phase: Phase,
    /// Why it failed, if it did.
    pub failure: Option<Failure>,
}
