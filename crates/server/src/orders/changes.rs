//! Announces changes after the commit: notices for the event stream, and the robots whose desired
//! state is new. Nothing here has to survive a crash: both sides compare again on connect.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use task_proto::{DeploymentId, RobotId, TaskName};
use tokio::sync::{Notify, broadcast, watch};

use crate::domain::happening::Happening;
use crate::fleet::part_requests::PartRequests;
use crate::store::KnownRobot;

/// Capacity of a notice channel: a listener that falls further behind misses notices.
const NOTICES: usize = 16 * 1024;

/// One created, changed or removed object. The listener reads the current value from the store.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Change {
    /// A robot is new or has changed.
    Robot(RobotId),
    /// A robot was removed.
    RobotRemoved(Box<KnownRobot>),
    /// A robot may have entered or left some user's scope.
    Scopes,
    /// A deployment is new or has changed.
    Deployment(DeploymentId),
    /// A package was pushed or deleted.
    Package(TaskName),
    /// The feed has an entry with this number.
    Feed(u64),
}

/// Changes of a write, collected on the way and announced after its commit.
#[derive(Debug, Default)]
pub struct Consequences {
    /// Robots that have changed as the operator sees them.
    pub robots: BTreeSet<RobotId>,
    /// Robots whose desired state is new.
    pub rings: BTreeSet<RobotId>,
    /// Deployments that are new or have changed.
    pub deployments: BTreeSet<DeploymentId>,
    /// Events for the feed.
    pub happenings: Vec<Happening>,
}

/// Where changes are announced. Clones announce to the same listeners.
#[derive(Debug, Clone)]
pub struct Changes {
    notices: broadcast::Sender<Change>,
    happenings: broadcast::Sender<Happening>,
    bells: Arc<Bells>,
    rights: Arc<watch::Sender<()>>,
    part_requests: PartRequests,
}

/// Robots to notify: a set, so a robot waits here once however often its desired state changes.
#[derive(Debug, Default)]
struct Bells {
    waiting: Mutex<Rings>,
    rung: Notify,
}

/// The robots to notify.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Rings {
    /// Whether all robots are to be notified.
    pub everyone: bool,
    pub robots: BTreeSet<RobotId>,
}

impl Changes {
    pub fn new() -> Self {
        Self {
            notices: broadcast::Sender::new(NOTICES),
            happenings: broadcast::Sender::new(NOTICES),
            bells: Arc::default(),
            rights: Arc::new(watch::Sender::new(())),
            part_requests: PartRequests::default(),
        }
    }

    /// Tells long-lived connections that users or their tokens have changed.
    pub fn announce_rights(&self) {
        self.rights.send_replace(());
    }

    /// Changes each time that people or their tokens have changed, from now on.
    pub fn rights(&self) -> watch::Receiver<()> {
        self.rights.subscribe()
    }

    /// The parts that robots have reported missing.
    pub fn part_requests(&self) -> &PartRequests {
        &self.part_requests
    }

    /// Every notice from now on.
    pub fn subscribe(&self) -> broadcast::Receiver<Change> {
        self.notices.subscribe()
    }

    /// Tells all listeners; no listener is fine.
    pub fn announce(&self, change: Change) {
        let _ = self.notices.send(change);
    }

    /// Tells the feed about an event; no listener is fine.
    pub fn happened(&self, happening: Happening) {
        let _ = self.happenings.send(happening);
    }

    /// Everything that happens from now on.
    pub fn happenings(&self) -> broadcast::Receiver<Happening> {
        self.happenings.subscribe()
    }

    /// Announces all that a write has changed. To be called after its commit.
    pub fn publish(&self, consequences: Consequences) {
        for robot in consequences.robots.union(&consequences.rings) {
            self.announce(Change::Robot(robot.clone()));
        }
        for deployment in consequences.deployments {
            self.announce(Change::Deployment(deployment));
        }
        consequences.happenings.into_iter().for_each(|happening| self.happened(happening));
        self.ring(consequences.rings);
    }

    /// Queues notifications to `robots` about their new desired state.
    pub fn ring(&self, robots: impl IntoIterator<Item = RobotId>) {
        let mut waiting = self.bells.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.robots.extend(robots);
        if !waiting.robots.is_empty() {
            self.bells.rung.notify_one();
        }
    }

    /// Queues notifications to all robots about their desired state.
    pub fn ring_everyone(&self) {
        self.bells.waiting.lock().unwrap_or_else(PoisonError::into_inner).everyone = true;
        self.bells.rung.notify_one();
    }

    /// Waits until robots are queued and takes them all. Made for one caller, the downlink;
    /// dropping the future loses none.
    pub async fn take_rings(&self) -> Rings {
        loop {
            let taken = std::mem::take(
                &mut *self.bells.waiting.lock().unwrap_or_else(PoisonError::into_inner),
            );
            if taken != Rings::default() {
                return taken;
            }
            self.bells.rung.notified().await;
        }
    }
}

impl Default for Changes {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_robot_rung_twice_is_taken_once() {
        let changes = Changes::new();
        let robot = RobotId::random();
        changes.ring([robot.clone()]);
        changes.ring([robot.clone()]);
        assert_eq!(changes.take_rings().await.robots, BTreeSet::from([robot.clone()]));
        let waiting = tokio::spawn({
            let changes = changes.clone();
            async move { changes.take_rings().await }
        });
        changes.ring([robot.clone()]);
        let taken = waiting.await.expect("no panic");
        assert_eq!(taken, Rings { everyone: false, robots: BTreeSet::from([robot.clone()]) });
        changes.ring_everyone();
        changes.ring([robot.clone()]);
        assert_eq!(
            changes.take_rings().await,
            Rings { everyone: true, robots: BTreeSet::from([robot]) }
        );
    }
}
