//! Who may hear the parts of which package, and how far each listener has come: a publisher waits for the slowest of
//! them. It never holds a part and never touches a socket.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use task_proto::{Digest, RobotId};
use tokio::sync::Notify;

/// Packages that are fanned out at the same time. With [`WINDOW`] and the largest part it stays within the router's log.
const MAX_FAN_OUTS: usize = 4;
/// Parts that the slowest listener may be behind.
const WINDOW: u64 = 8;

/// Every package that is being fanned out.
#[derive(Default)]
pub(in crate::broker) struct Grants(Mutex<HashMap<Digest, Arc<Grant>>>);

/// One package, and the robots that may hear it.
pub(in crate::broker) struct Grant {
    digest: Digest,
    progress: Mutex<Progress>,
    moved: Notify,
}

#[derive(Default)]
struct Progress {
    /// The number of the last part that went out; the first is 1.
    sent: u64,
    /// The last part that each robot took; `None`: it may listen and does not.
    robots: HashMap<RobotId, Option<u64>>,
}

/// Why there is no grant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::broker) enum NotGranted {
    /// This package is being fanned out already.
    UnderWay,
    /// As many packages as there may be.
    Full,
}

impl Grants {
    /// Opens the package to the robots.
    pub(in crate::broker) fn open(&self, digest: Digest, robots: Vec<RobotId>) -> Result<Arc<Grant>, NotGranted> {
        let mut table = lock(&self.0);
        if table.contains_key(&digest) {
            return Err(NotGranted::UnderWay);
        }
        if table.len() >= MAX_FAN_OUTS {
            return Err(NotGranted::Full);
        }
        let robots = robots.into_iter().map(|robot| (robot, None)).collect();
        let progress = Mutex::new(Progress { sent: 0, robots });
        let grant = Arc::new(Grant { digest, progress, moved: Notify::new() });
        table.insert(digest, grant.clone());
        Ok(grant)
    }

    /// Closes it to everybody.
    pub(in crate::broker) fn close(&self, grant: &Grant) {
        lock(&self.0).remove(&grant.digest);
        grant.progress().robots.clear();
    }

    /// The package's grant, if `robot` has one.
    pub(super) fn of(&self, digest: &Digest, robot: &RobotId) -> Option<Arc<Grant>> {
        lock(&self.0).get(digest).filter(|grant| grant.progress().robots.contains_key(robot)).cloned()
    }
}

impl Grant {
    pub(in crate::broker) fn digest(&self) -> Digest {
        self.digest
    }

    /// Closes it to one robot.
    pub(in crate::broker) fn withdraw(&self, robot: &RobotId) {
        self.progress().robots.remove(robot);
        self.moved.notify_one();
    }

    /// Robots that listen now.
    pub(in crate::broker) fn listeners(&self) -> usize {
        self.progress().robots.values().flatten().count()
    }

    /// The number of the next part, once no listener is too far behind. For one caller at a time; cancel-safe.
    pub(in crate::broker) async fn room(&self) -> u64 {
        loop {
            {
                let progress = self.progress();
                let slowest = progress.robots.values().flatten().min().copied().unwrap_or(progress.sent);
                if progress.sent.saturating_sub(slowest) < WINDOW {
                    return progress.sent + 1;
                }
            }
            self.moved.notified().await;
        }
    }

    /// The part of this number went out.
    pub(in crate::broker) fn sent(&self, number: u64) {
        self.progress().sent = number;
    }

    /// Closes it to those who hold up all others, and says who they were.
    pub(in crate::broker) fn put_out_stragglers(&self) -> Vec<RobotId> {
        let mut progress = self.progress();
        let sent = progress.sent;
        let is_straggler = |taken: &Option<u64>| taken.is_some_and(|taken| sent.saturating_sub(taken) >= WINDOW);
        progress.robots.extract_if(|_, taken| is_straggler(taken)).map(|(robot, _)| robot).collect()
    }

    fn progress(&self) -> MutexGuard<'_, Progress> {
        lock(&self.progress)
    }
}

/// A robot's session that listens; it counts as behind until this is dropped.
pub(super) struct Member {
    grant: Arc<Grant>,
    robot: RobotId,
}

impl Member {
    /// The robot hears everything from now on. `None` if the grant was withdrawn meanwhile.
    pub(super) fn join(grant: Arc<Grant>, robot: &RobotId) -> Option<Self> {
        let mut progress = grant.progress();
        let sent = progress.sent;
        *progress.robots.get_mut(robot)? = Some(sent);
        drop(progress);
        Some(Self { grant, robot: robot.clone() })
    }

    /// The robot takes a part; false if it may no longer have it.
    pub(super) fn take(&self, number: u64) -> bool {
        let mut progress = self.grant.progress();
        let Some(taken) = progress.robots.get_mut(&self.robot) else { return false };
        *taken = (*taken).max(Some(number));
        drop(progress);
        self.grant.moved.notify_one();
        true
    }
}

impl Drop for Member {
    fn drop(&mut self) {
        if let Some(taken) = self.grant.progress().robots.get_mut(&self.robot) {
            *taken = None;
        }
        self.grant.moved.notify_one();
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing half-done.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;

    use super::*;

    #[test]
    fn the_slowest_listener_holds_the_publisher_up_until_it_goes() {
        let grants = Grants::default();
        let (quick, slow) = (RobotId::random(), RobotId::random());
        let digest = Digest::of(b"package");
        let grant = grants.open(digest, vec![quick.clone(), slow.clone()]).expect("room");
        assert_eq!(grants.open(digest, Vec::new()).err(), Some(NotGranted::UnderWay));
        assert!(grants.of(&digest, &RobotId::random()).is_none());
        let join = |robot| Member::join(grants.of(&digest, robot).expect("granted"), robot).expect("granted");
        let (first, second) = (join(&quick), join(&slow));
        let send = || grant.room().now_or_never().map(|number| grant.sent(number)).is_some();
        assert_eq!((0..WINDOW + 5).filter(|_| send()).count() as u64, WINDOW);
        assert!(first.take(WINDOW));
        assert!(!send(), "the slow one has taken nothing");
        assert!(second.take(1));
        assert!(send() && !send());
        assert_eq!(grant.put_out_stragglers(), [slow]);
        assert!(!second.take(2), "it may no longer have it");
        assert!(send());
        drop(first);
        assert_eq!((grant.listeners(), (0..100).filter(|_| send()).count()), (0, 100), "nobody to wait for");
        grants.close(&grant);
        assert!(grants.of(&digest, &quick).is_none());
    }
}
