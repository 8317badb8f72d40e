//! How many connections there may be. When there are as many, whoever has been silent for longest
//! gives way to a newcomer, so that those who say nothing keep nobody out. It never touches a
//! socket.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

use crate::net::anteroom::Anteroom;

/// Newcomers that wait for a place at a time: connections beyond those there may be.
const MAX_WAITING: usize = 128;
/// How long each waits. Who gives way is gone sooner.
const PATIENCE: Duration = Duration::from_secs(3);

/// The places of a listener.
pub(super) struct Places {
    free: Arc<Semaphore>,
    turns: Arc<Semaphore>,
}

/// What a newcomer gets.
pub(super) enum Claim {
    /// A place.
    Place(OwnedSemaphorePermit),
    /// A turn to wait for the place of somebody who has to leave.
    Turn(Arc<Semaphore>, OwnedSemaphorePermit),
}

impl Places {
    /// So many.
    pub(super) fn new(most: usize) -> Self {
        Self { free: Arc::new(Semaphore::new(most)), turns: Arc::new(Semaphore::new(MAX_WAITING)) }
    }

    /// For one more connection; `None` if there is no place, and nobody in the anteroom who could
    /// give way.
    pub(super) fn claim(&self, anteroom: &Anteroom) -> Option<Claim> {
        if let Ok(place) = self.free.clone().try_acquire_owned() {
            return Some(Claim::Place(place));
        }
        let turn = self.turns.clone().try_acquire_owned().ok()?;
        anteroom.make_room(Instant::now()).then(|| Claim::Turn(self.free.clone(), turn))
    }
}

impl Claim {
    /// The place, once it is free.
    pub(super) async fn place(self) -> Option<OwnedSemaphorePermit> {
        match self {
            Self::Place(place) => Some(place),
            Self::Turn(free, _turn) => timeout(PATIENCE, free.acquire_owned()).await.ok()?.ok(),
        }
    }
}
