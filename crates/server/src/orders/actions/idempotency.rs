//! Orders that are safe to repeat: the answer to an order is stored under the key that came with
//! the order, and a repeated order gets that answer.

use std::collections::HashSet;
use std::fmt;
use std::str::FromStr;

use serde::Serialize;
use serde::de::DeserializeOwned;
use task_proto::{DeploymentId, Digest, RobotId};

use super::error::OrderError;
use crate::domain::person::Person;
use crate::store::{IdempotencyRecord, SelectedRobot, StoreError, Transaction};

/// The most that the orders of one person take in the database. Each further order takes the place
/// of the oldest ones.
pub const MAX_BYTES_OF_PERSON: u64 = 16 * 1024 * 1024;

/// Makes an order safe to repeat: 1 to 128 visible ASCII characters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotencyKey(String);

/// The error for a text that is no idempotency key.
#[derive(Debug, thiserror::Error)]
#[error("an idempotency key has 1 to 128 visible ASCII characters")]
pub struct InvalidIdempotencyKey;

impl FromStr for IdempotencyKey {
    type Err = InvalidIdempotencyKey;
    fn from_str(text: &str) -> Result<Self, InvalidIdempotencyKey> {
        let valid =
            (1..=128).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic());
        if valid { Ok(Self(text.to_owned())) } else { Err(InvalidIdempotencyKey) }
    }
}

impl fmt::Display for IdempotencyKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// An answer that is stored and returned when its order is repeated.
pub(super) trait StoredAnswer: Serialize + DeserializeOwned {
    /// Removes all robots except `own`.
    fn keep_robots(&mut self, own: &HashSet<RobotId>);
}

impl StoredAnswer for Vec<SelectedRobot> {
    fn keep_robots(&mut self, own: &HashSet<RobotId>) {
        self.retain(|robot| own.contains(&robot.id));
    }
}

impl StoredAnswer for DeploymentId {
    /// No robots to remove: the deployment's view is read separately.
    fn keep_robots(&mut self, _own: &HashSet<RobotId>) {}
}

/// The stored answer if `key` came with this `request` before; an error if the key came with
/// another request, or from another user. Robots that the person may no longer see are left out.
pub(super) async fn stored_answer<T: StoredAnswer>(
    write: &mut Transaction,
    by: &Person,
    key: impl Into<Option<&IdempotencyKey>>,
    request: &str,
) -> Result<Option<T>, OrderError> {
    let Some(key) = key.into() else { return Ok(None) };
    let Some(stored) = write.idempotency().get(&key.0).await? else { return Ok(None) };
    if stored.request != request_digest(by, request) {
        return Err(OrderError::IdempotencyKeyReused(key.to_string()));
    }
    let answer = serde_json::from_str(&stored.answer);
    let mut answer: T = answer.map_err(|_| StoreError::Unreadable { column: "orders.answer" })?;
    if !by.scope.is_everything() {
        let own: HashSet<RobotId> =
            write.robots().ids_ever_in(&by.scope).await?.into_iter().collect();
        answer.keep_robots(&own);
    }
    Ok(Some(answer))
}

/// Stores the answer to `request`, so that a retry gets the same answer.
pub(super) async fn store_answer<T: StoredAnswer>(
    write: &mut Transaction,
    by: &Person,
    key: impl Into<Option<&IdempotencyKey>>,
    request: &str,
    answer: &T,
    now_ms: u64,
) -> Result<(), StoreError> {
    let Some(key) = key.into() else { return Ok(()) };
    let answer = serde_json::to_string(answer).expect("an answer always has a JSON form");
    let order = IdempotencyRecord { request: request_digest(by, request), answer };
    write.idempotency().insert(&key.0, &order, &by.name, MAX_BYTES_OF_PERSON, now_ms).await
}

/// The request text stored with its answer. Requests of the first token are stored in the form used
/// before users existed.
fn request_digest(by: &Person, request: &str) -> String {
    let text = if by.is_first() { request.to_owned() } else { format!("{} {request}", by.name) };
    Digest::of(text.as_bytes()).to_string()
}
