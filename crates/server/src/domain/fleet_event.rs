//! Events of the fleet, as known to the module that notices them. [`crate::orders::feed`] publishes
//! them.

use std::sync::Arc;

use task_proto::api::FeedKind;
use task_proto::messages::report::{Failure, Phase};
use task_proto::{DeploymentId, RobotId, RobotName};

/// An event, as known to the module that notices it.
#[derive(Debug, Clone)]
pub enum FleetEvent {
    /// A robot went online (true) or offline (false).
    Presence(RobotId, bool),
    /// A task reached a phase worth showing, or one that ends such a phase.
    Task(Arc<TaskEvent>),
    /// An event of one robot.
    Robot(RobotId, FeedKind, String),
}

/// The phase of a robot's part of a deployment.
#[derive(Debug)]
pub struct TaskEvent {
    pub robot: RobotId,
    pub name: RobotName,
    pub deployment: DeploymentId,
    pub phase: Phase,
    /// The cause of a failure.
    pub failure: Option<Failure>,
}
