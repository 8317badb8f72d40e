//! A robot's desired state: read, signed, and cached until the state changes or half its lifetime
//! is over.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use task_proto::desired::{BlobRef, DesiredState, Evidence};
use task_proto::envelope::{DESIRED_STATE_TYPE, Envelope};
use task_proto::{Generation, RobotId};

use super::{ActionError, Actions};
use crate::store::DesiredTasks;

/// Capacity of the cache of signed states. At the limit all are dropped: signing again is cheap.
const MAX_KEPT: usize = 16 * 1024;

/// A robot's signed desired state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Desired {
    pub generation: Generation,
    pub envelope: Envelope,
    /// Blobs that are sent along with a pushed state.
    pub along: Vec<BlobRef>,
}

/// A signed state and the time of its signature.
#[derive(Debug)]
struct Kept {
    issued_at_ms: u64,
    generation: Generation,
    evidence: Evidence,
    envelope: Envelope,
}

/// Signed states by robot.
#[derive(Debug, Default)]
pub(super) struct Envelopes(Mutex<HashMap<RobotId, Kept>>);

impl Envelopes {
    fn get(
        &self,
        robot: &RobotId,
        generation: Generation,
        evidence: &Evidence,
        signed_since_ms: u64,
    ) -> Option<Envelope> {
        let kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let kept = kept.get(robot)?;
        let is_same = kept.generation == generation && kept.evidence == *evidence;
        (is_same && kept.issued_at_ms >= signed_since_ms).then(|| kept.envelope.clone())
    }

    fn keep(&self, robot: &RobotId, state: Kept) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.len() >= MAX_KEPT {
            kept.clear();
        }
        kept.insert(robot.clone(), state);
    }

    pub(super) fn forget(&self, robot: &RobotId) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(robot);
    }
}

impl Actions {
    /// All robots that may have a desired state.
    pub async fn every_robot(&self) -> Result<Vec<RobotId>, ActionError> {
        Ok(self.store.robot_ids().await?)
    }

    /// The signed desired state of `robot`. Refused as `diverged` while the robot is ahead of the
    /// database.
    pub async fn desired(&self, robot: &RobotId) -> Result<Desired, ActionError> {
        let found = self.store.desired_tasks(std::slice::from_ref(robot)).await?.pop();
        self.sign(found.ok_or_else(|| ActionError::RobotNotFound(robot.to_string()))?)
    }

    /// The signed states of many robots; removed and diverged robots are left out.
    pub async fn desired_of(
        &self,
        robots: &[RobotId],
    ) -> Result<Vec<(RobotId, Desired)>, ActionError> {
        let found = self.store.desired_tasks(robots).await?;
        let signed = found
            .into_iter()
            .filter_map(|found| Some((found.robot.clone(), self.sign(found).ok()?)));
        Ok(signed.collect())
    }

    fn sign(&self, found: DesiredTasks) -> Result<Desired, ActionError> {
        let DesiredTasks {
            robot,
            generation,
            observed_generation,
            tasks,
            along,
            evidence,
            settings,
        } = found;
        if observed_generation > generation {
            return Err(ActionError::Diverged(robot));
        }
        let now_ms = self.clock.now_ms();
        let lifetime_ms = self.settings.desired_lifetime_ms;
        let signed_since_ms = now_ms.saturating_sub(lifetime_ms / 2);
        if let Some(envelope) = self.envelopes.get(&robot, generation, &evidence, signed_since_ms) {
            return Ok(Desired { generation, envelope, along });
        }
        let state = DesiredState {
            robot_id: robot.clone(),
            generation,
            issued_at_ms: now_ms,
            expires_at_ms: now_ms + lifetime_ms,
            tasks,
            evidence: evidence.clone(),
            settings,
        };
        let payload = serde_json::to_vec(&state).expect("a desired state always has a JSON form");
        let envelope = Envelope::seal(DESIRED_STATE_TYPE, &payload, &self.key);
        self.envelopes.keep(
            &robot,
            Kept { issued_at_ms: now_ms, generation, evidence, envelope: envelope.clone() },
        );
        Ok(Desired { generation, envelope, along })
    }
}
