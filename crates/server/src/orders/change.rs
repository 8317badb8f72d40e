//! Changes that are announced: which object has changed, and which robots are to be notified. This
//! module announces nothing.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use task_proto::{DeploymentId, RobotId, TaskName};

use crate::store::KnownRobot;

/// One created, changed or removed object. The listener reads the current value from the store.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// A robot is new or has changed.
    Robot(RobotId),
    /// A robot was removed.
    RobotRemoved(Box<KnownRobot>),
    /// A robot may have entered or left some user's scope.
    Scopes,
    /// A deployment is new or has changed.
    Deployment(DeploymentId),
    /// A package was pushed or deleted.
    Package(TaskName),
    /// The feed has entries with these numbers.
    Feed { first: u64, last: u64 },
    /// More has changed than was announced.
    Missed,
}

/// The robots to notify.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct RobotsToNotify {
    /// Whether all robots are to be notified.
    pub all: bool,
    pub robots: BTreeSet<RobotId>,
}
