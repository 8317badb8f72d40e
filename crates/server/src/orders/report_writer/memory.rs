//! The writer's cache of the database from one batch to the next, so that robots that keep
//! reporting are not read again each time. Every write takes the next turn: as long as this writer
//! also had the previous turn, no other writer, in this process or another, has changed anything.
//! Otherwise the cache is cleared. The cache never decides anything.

use std::collections::{HashMap, HashSet};

use task_proto::report::{Condition, FailureCode};
use task_proto::{DeploymentId, RobotId};

use crate::store::{OpenAssignment, ReportedRobot, StoreError, Write};

/// Robots cached before a batch; a batch may add its own.
const MAX_ROBOTS: usize = 20_000;
/// Maximum number of cached conditions per robot; further ones are not reported as new.
const MAX_CONDITIONS: usize = 16;

/// Cached copies of stored rows.
#[derive(Default)]
pub(super) struct Memory {
    /// The turn of the last write that is remembered.
    turn: u64,
    robots: HashMap<RobotId, Remembered>,
    /// Deployments in which every robot's batch has begun: they need no further advance.
    begun: HashSet<DeploymentId>,
    /// Codes of the conditions that robots report. No other writer changes them, so clearing the
    /// cache keeps them.
    conditions: HashMap<RobotId, Vec<FailureCode>>,
}

/// One robot as stored.
pub(super) struct Remembered {
    pub(super) robot: ReportedRobot,
    pub(super) open: Vec<OpenAssignment>,
    /// The fingerprint of the stored report; `None`: unknown.
    pub(super) fingerprint: Option<u64>,
}

impl Memory {
    /// Loads the registered ones of `robots` that are not cached, as they stand in `write`.
    pub(super) async fn learn(
        &mut self,
        write: &mut Write,
        robots: impl Iterator<Item = &RobotId>,
    ) -> Result<(), StoreError> {
        if write.turn() != self.turn + 1 {
            self.forget();
        }
        if self.robots.len() > MAX_ROBOTS {
            self.robots.clear();
        }
        let unknown: Vec<RobotId> =
            robots.filter(|robot| !self.robots.contains_key(*robot)).cloned().collect();
        for robot in write.reported_robots(&unknown).await? {
            let remembered = Remembered { robot, open: Vec::new(), fingerprint: None };
            self.robots.insert(remembered.robot.id.clone(), remembered);
        }
        for assignment in write.open_assignments(&unknown).await? {
            if let Some(remembered) = self.robots.get_mut(&assignment.robot) {
                remembered.open.push(assignment);
            }
        }
        Ok(())
    }

    pub(super) fn get(&self, robot: &RobotId) -> Option<&Remembered> {
        self.robots.get(robot)
    }

    pub(super) fn get_mut(&mut self, robot: &RobotId) -> Option<&mut Remembered> {
        self.robots.get_mut(robot)
    }

    /// Whether robots of the deployment may still wait for their batch.
    pub(super) fn may_wait(&self, deployment: &DeploymentId) -> bool {
        !self.begun.contains(deployment)
    }

    /// Every robot's batch of the deployment has begun.
    pub(super) fn has_begun(&mut self, deployment: DeploymentId) {
        self.begun.insert(deployment);
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

    /// The write with this turn was committed, and the cache contains its changes.
    pub(super) fn committed(&mut self, turn: u64) {
        self.turn = turn;
    }

    /// Nothing is certain any more.
    pub(super) fn forget(&mut self) {
        *self = Self { conditions: std::mem::take(&mut self.conditions), ..Self::default() };
    }
}
