//! Robots' desired states in the form that robots receive: read from the store, signed, and cached
//! until the state changes or half its lifetime is over. Never decides what a robot should run, and
//! never sends anything.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use task_proto::desired::{BlobRef, DesiredState, Evidence, RobotDescription};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use task_proto::{Generation, RobotId};

use crate::store::{DesiredTasks, Store, StoreError};
use crate::system::clock::Clock;

/// Capacity of the cache of signed states. At the limit all are dropped: signing again is cheap.
const MAX_CACHED: usize = 16 * 1024;

/// The source of signed desired states. Clones share their cache.
#[derive(Clone)]
pub struct DesiredStates {
    store: Store,
    clock: Clock,
    key: Arc<SigningKey>,
    lifetime_ms: u64,
    cache: Arc<EnvelopeCache>,
}

/// A robot's signed desired state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignedState {
    pub generation: Generation,
    pub envelope: Envelope,
    /// Blobs that are sent along with a pushed state.
    pub bundled_blobs: Vec<BlobRef>,
}

/// Why a robot has no signed state.
#[derive(Debug, thiserror::Error)]
pub enum DesiredStateError {
    /// The robot is not registered, was revoked or waits for approval.
    #[error("there is no robot {:?}", .0.as_str())]
    RobotNotFound(RobotId),
    /// The robot's generation is higher than ours: the database was restored. The robot is left
    /// alone until its next order.
    #[error(
        "robot {0} reports a later state than the server knows; the server sends it nothing until its next order"
    )]
    Diverged(RobotId),
    #[error("the database failed")]
    Store(#[from] StoreError),
}

/// A signed state and the time of its signature.
#[derive(Debug)]
struct CachedEnvelope {
    issued_at_ms: u64,
    generation: Generation,
    evidence: Evidence,
    description: RobotDescription,
    envelope: Envelope,
}

/// Signed states by robot.
#[derive(Debug, Default)]
struct EnvelopeCache(Mutex<HashMap<RobotId, CachedEnvelope>>);

impl EnvelopeCache {
    fn get(&self, found: &DesiredTasks, signed_since_ms: u64) -> Option<Envelope> {
        let cached = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let cached = cached.get(&found.robot)?;
        let is_same = cached.generation == found.generation
            && cached.evidence == found.evidence
            && cached.description == found.description;
        (is_same && cached.issued_at_ms >= signed_since_ms).then(|| cached.envelope.clone())
    }

    fn insert(&self, robot: &RobotId, state: CachedEnvelope) {
        let mut cached = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if cached.len() >= MAX_CACHED {
            cached.clear();
        }
        cached.insert(robot.clone(), state);
    }

    fn remove(&self, robot: &RobotId) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(robot);
    }
}

impl DesiredStates {
    /// States from `store`, signed with `key` and valid for `lifetime_ms`.
    pub fn new(store: Store, clock: Clock, key: Arc<SigningKey>, lifetime_ms: u64) -> Self {
        Self { store, clock, key, lifetime_ms, cache: Arc::default() }
    }

    /// All robots that may have a desired state.
    pub async fn robot_ids(&self) -> Result<Vec<RobotId>, StoreError> {
        self.store.robots().ids().await
    }

    /// The signed state of `robot`.
    pub async fn get(&self, robot: &RobotId) -> Result<SignedState, DesiredStateError> {
        let found = self.store.robots().desired_tasks(std::slice::from_ref(robot)).await?.pop();
        let found = found.ok_or_else(|| DesiredStateError::RobotNotFound(robot.clone()))?;
        self.sign(found).ok_or_else(|| DesiredStateError::Diverged(robot.clone()))
    }

    /// The signed states of many robots. Robots without a state are left out.
    pub async fn get_many(
        &self,
        robots: &[RobotId],
    ) -> Result<Vec<(RobotId, SignedState)>, StoreError> {
        let found = self.store.robots().desired_tasks(robots).await?;
        let signed =
            found.into_iter().filter_map(|found| Some((found.robot.clone(), self.sign(found)?)));
        Ok(signed.collect())
    }

    /// The robot was removed.
    pub fn forget(&self, robot: &RobotId) {
        self.cache.remove(robot);
    }

    /// Signs a state, unless the robot has diverged.
    fn sign(&self, found: DesiredTasks) -> Option<SignedState> {
        if found.observed_generation > found.generation {
            return None;
        }
        let issued_at_ms = self.clock.now_ms();
        let signed_since_ms = issued_at_ms.saturating_sub(self.lifetime_ms / 2);
        let cached = self.cache.get(&found, signed_since_ms);
        let DesiredTasks { robot, generation, tasks, bundled_blobs, evidence, .. } = found;
        if let Some(envelope) = cached {
            return Some(SignedState { generation, envelope, bundled_blobs });
        }
        let state = DesiredState {
            robot_id: robot.clone(),
            generation,
            issued_at_ms,
            expires_at_ms: issued_at_ms + self.lifetime_ms,
            tasks,
            evidence: evidence.clone(),
            settings: found.settings,
            robot: found.description.clone(),
        };
        let payload = serde_json::to_vec(&state).expect("a desired state always has a JSON form");
        let envelope = Envelope::seal(DESIRED_STATE_TYPE, &payload, &self.key);
        let signed = CachedEnvelope {
            issued_at_ms,
            generation,
            evidence,
            description: found.description,
            envelope: envelope.clone(),
        };
        self.cache.insert(&robot, signed);
        Some(SignedState { generation, envelope, bundled_blobs })
    }
}
