//! The writer's cache of the database from one batch to the next, so that the assignments of robots
//! that keep reporting are not read again each time. Orders are numbered: a new one clears the
//! cache. Between orders only reports change a robot's assignments, and each moves the stored
//! position of the robot's last report, which every batch reads. So a robot that has reported
//! through another writer, in this process or another, is read again, and it alone. The cache never
//! decides anything.

use std::collections::{HashMap, HashSet};

use task_proto::messages::report::{Condition, FailureCode};
use task_proto::{DeploymentId, RobotId};

use crate::store::{OpenAssignment, ReportTransaction, ReportedRobot, StoreError};

/// Robots cached before a batch; a batch may add its own.
const MAX_ROBOTS: usize = 20_000;
/// Maximum number of cached conditions per robot; further ones are not reported as new.
const MAX_CONDITIONS: usize = 16;

/// Cached copies of stored rows.
#[derive(Default)]
pub(super) struct RowCache {
    /// The number of the last order before the cached rows were read.
    last_order: u64,
    robots: HashMap<RobotId, CachedRobot>,
    /// Deployments in which no report begins a batch before the next order.
    at_rest: HashSet<DeploymentId>,
    /// Codes of the conditions that robots report here. They are not stored, so clearing the cache
    /// keeps them.
    conditions: HashMap<RobotId, Vec<FailureCode>>,
}

/// One robot as stored.
pub(super) struct CachedRobot {
    pub(super) robot: ReportedRobot,
    pub(super) open: Vec<OpenAssignment>,
    /// The fingerprint of the stored report; `None`: unknown.
    pub(super) fingerprint: Option<u64>,
}

impl RowCache {
    /// Loads the robots of `write`, unless they are cached as they stand in it.
    pub(super) async fn load(&mut self, write: &mut ReportTransaction) -> Result<(), StoreError> {
        if write.last_order() != self.last_order {
            self.clear();
            self.last_order = write.last_order();
        }
        if self.robots.len() > MAX_ROBOTS {
            self.robots.clear();
        }
        let mut unknown = Vec::new();
        for robot in write.robots() {
            let cached = self.robots.get(&robot.id).map(|cached| cached.robot.last_report);
            if cached != Some(robot.last_report) {
                unknown.push(robot.id.clone());
                let read =
                    CachedRobot { robot: robot.clone(), open: Vec::new(), fingerprint: None };
                self.robots.insert(robot.id.clone(), read);
            }
        }
        for assignment in write.reports().open_assignments(&unknown).await? {
            if let Some(cached) = self.robots.get_mut(&assignment.robot) {
                cached.open.push(assignment);
            }
        }
        Ok(())
    }

    pub(super) fn get(&self, robot: &RobotId) -> Option<&CachedRobot> {
        self.robots.get(robot)
    }

    pub(super) fn get_mut(&mut self, robot: &RobotId) -> Option<&mut CachedRobot> {
        self.robots.get_mut(robot)
    }

    /// Whether a report may begin a batch of the deployment.
    pub(super) fn may_begin(&self, deployment: &DeploymentId) -> bool {
        !self.at_rest.contains(deployment)
    }

    /// No report begins a batch of these deployments before the next order.
    pub(super) fn mark_at_rest(&mut self, deployments: impl IntoIterator<Item = DeploymentId>) {
        self.at_rest.extend(deployments);
    }

    /// Stores the conditions that a robot reports. Returns the conditions that are new.
    pub(super) fn new_conditions<'a>(
        &mut self,
        robot: &RobotId,
        conditions: &'a [Condition],
    ) -> Vec<&'a Condition> {
        let before = self.conditions.remove(robot).unwrap_or_default();
        if self.conditions.len() >= MAX_ROBOTS {
            self.conditions.clear();
        }
        let conditions = &conditions[..conditions.len().min(MAX_CONDITIONS)];
        let codes: Vec<_> =
            conditions.iter().map(|condition| FailureCode::from(condition.code.clone())).collect();
        let is_new = |(_, code): &(&Condition, &FailureCode)| !before.contains(code);
        let new =
            conditions.iter().zip(&codes).filter(is_new).map(|(condition, _)| condition).collect();
        if !codes.is_empty() {
            self.conditions.insert(robot.clone(), codes);
        }
        new
    }

    /// Nothing is certain any more.
    pub(super) fn clear(&mut self) {
        *self = Self { conditions: std::mem::take(&mut self.conditions), ..Self::default() };
    }
}
