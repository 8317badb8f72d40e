//! Limits the number of connections. At the limit, the longest silent connection is closed to admit
//! a new one, so silent clients keep no client out. This module never touches a socket.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

use crate::net::unauthenticated::UnauthenticatedConnections;

/// Maximum new connections that wait for a permit, beyond the limit of connections.
const MAX_QUEUED: usize = 128;
/// Time limit of each wait. The connection that is closed is gone sooner.
const PATIENCE: Duration = Duration::from_secs(3);

/// The connection limit of a listener.
pub(in crate::broker::front) struct ConnectionLimit {
    free: Arc<Semaphore>,
    queue: Arc<Semaphore>,
}

/// A new connection's permit, or its turn to wait for one.
pub(in crate::broker::front) enum PendingPermit {
    Granted(OwnedSemaphorePermit),
    /// A turn to wait for the permit of a connection that is being closed.
    Queued(Arc<Semaphore>, OwnedSemaphorePermit),
}

impl ConnectionLimit {
    /// Starts with this number of permits.
    pub(in crate::broker::front) fn new(max: usize) -> Self {
        Self { free: Arc::new(Semaphore::new(max)), queue: Arc::new(Semaphore::new(MAX_QUEUED)) }
    }

    /// Acquires a permit for one more connection; `None` if there is none, and no unauthenticated
    /// connection can be closed.
    pub(in crate::broker::front) fn acquire(
        &self,
        unauthenticated: &UnauthenticatedConnections,
    ) -> Option<PendingPermit> {
        if let Ok(permit) = self.free.clone().try_acquire_owned() {
            return Some(PendingPermit::Granted(permit));
        }
        let queue_permit = self.queue.clone().try_acquire_owned().ok()?;
        unauthenticated
            .evict_oldest(Instant::now())
            .then(|| PendingPermit::Queued(self.free.clone(), queue_permit))
    }
}

impl PendingPermit {
    /// Returns the permit, once there is one.
    pub(in crate::broker::front) async fn permit(self) -> Option<OwnedSemaphorePermit> {
        match self {
            Self::Granted(permit) => Some(permit),
            Self::Queued(free, _queue_permit) => {
                timeout(PATIENCE, free.acquire_owned()).await.ok()?.ok()
            }
        }
    }
}
