//! A robot's desired state: read, signed, and kept until it changes or half its lifetime is over.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use task_proto::desired::DesiredState;
use task_proto::envelope::{DESIRED_STATE_TYPE, Envelope};
use task_proto::{Generation, RobotId};

use super::{ActionError, Actions};

/// The most signed states that are kept. At the limit all are forgotten: signing again is cheap.
const MAX_KEPT: usize = 16 * 1024;

/// A robot's signed desired state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Desired {
    /// Its generation.
    pub generation: Generation,
    /// The signed document.
    pub envelope: Envelope,
}

/// Signed states by robot, with when they were signed.
#[derive(Debug, Default)]
pub(super) struct Envelopes(Mutex<HashMap<RobotId, (u64, Desired)>>);

impl Envelopes {
    fn get(&self, robot: &RobotId, generation: Generation, signed_since_ms: u64) -> Option<Desired> {
        let kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (issued_at_ms, desired) = kept.get(robot)?;
        (desired.generation == generation && *issued_at_ms >= signed_since_ms).then(|| desired.clone())
    }

    fn keep(&self, robot: &RobotId, issued_at_ms: u64, desired: &Desired) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.len() >= MAX_KEPT {
            kept.clear();
        }
        kept.insert(robot.clone(), (issued_at_ms, desired.clone()));
    }

    pub(super) fn forget(&self, robot: &RobotId) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(robot);
    }
}

impl Actions {
    /// What `robot` should be running, signed. Refused as `diverged` while the robot is ahead of the database.
    pub async fn desired(&self, robot: &RobotId) -> Result<Desired, ActionError> {
        let not_found = || ActionError::RobotNotFound(robot.to_string());
        let (generation, observed) = self.store.generations(robot).await?.ok_or_else(not_found)?;
        if observed > generation {
            return Err(ActionError::Diverged(robot.clone()));
        }
        let now_ms = self.clock.now_ms();
        let signed_since_ms = now_ms.saturating_sub(self.settings.desired_lifetime_ms / 2);
        if let Some(desired) = self.envelopes.get(robot, generation, signed_since_ms) {
            return Ok(desired);
        }
        let found = self.store.desired_tasks(robot).await?.ok_or_else(not_found)?;
        if found.observed_generation > found.generation {
            return Err(ActionError::Diverged(robot.clone()));
        }
        let state = DesiredState {
            robot_id: robot.clone(),
            generation: found.generation,
            issued_at_ms: now_ms,
            expires_at_ms: now_ms + self.settings.desired_lifetime_ms,
            tasks: found.tasks,
        };
        let payload = serde_json::to_vec(&state).expect("a desired state always has a JSON form");
        let envelope = Envelope::seal(DESIRED_STATE_TYPE, &payload, &self.key);
        let desired = Desired { generation: found.generation, envelope };
        self.envelopes.keep(robot, now_ms, &desired);
        Ok(desired)
    }
}
