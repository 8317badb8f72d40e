//! Limits the number of connections. At the limit, the longest silent connection is closed to admit
//! a new one, so silent clients keep no client out. This module never touches a socket.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

use crate::net::anteroom::Anteroom;

/// Maximum new connections that wait for a place, beyond the limit of connections.
const MAX_WAITING: usize = 128;
/// Time limit of each wait. The connection that is closed is gone sooner.
const PATIENCE: Duration = Duration::from_secs(3);

/// The places of a listener.
pub(super) struct Places {
    free: Arc<Semaphore>,
    turns: Arc<Semaphore>,
}

/// The claim of a new connection.
pub(super) enum Claim {
    Place(OwnedSemaphorePermit),
    /// A turn to wait for the place of a connection that is being closed.
    Turn(Arc<Semaphore>, OwnedSemaphorePermit),
}

impl Places {
    /// Starts with this number of places.
    pub(super) fn new(most: usize) -> Self {
        Self { free: Arc::new(Semaphore::new(most)), turns: Arc::new(Semaphore::new(MAX_WAITING)) }
    }

    /// Claims a place for one more connection; `None` if there is no place, and no connection in
    /// the anteroom that can be closed.
    pub(super) fn claim(&self, anteroom: &Anteroom) -> Option<Claim> {
        if let Ok(place) = self.free.clone().try_acquire_owned() {
            return Some(Claim::Place(place));
        }
        let turn = self.turns.clone().try_acquire_owned().ok()?;
        anteroom.make_room(Instant::now()).then(|| Claim::Turn(self.free.clone(), turn))
    }
}

impl Claim {
    /// Returns the place, once it is free.
    pub(super) async fn place(self) -> Option<OwnedSemaphorePermit> {
        match self {
            Self::Place(place) => Some(place),
            Self::Turn(free, _turn) => timeout(PATIENCE, free.acquire_owned()).await.ok()?.ok(),
        }
    }
}
