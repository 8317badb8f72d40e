//! Announces changes after the commit: notices for the event stream, and the robots whose desired
//! state is new. Nothing here has to survive a crash: both sides compare again on connect.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use task_proto::{DeploymentId, RobotId, TaskName};
use tokio::sync::{Notify, broadcast, watch};

use crate::domain::fleet_event::FleetEvent;
use crate::fleet::part_requests::PartRequests;
use crate::store::KnownRobot;

/// Capacity of a channel: a receiver that falls further behind misses entries.
const CHANNEL_CAPACITY: usize = 16 * 1024;

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
    /// The feed has entries with these numbers.
    Feed { first: u64, last: u64 },
}

/// Changes of a write, collected on the way and announced after its commit.
#[derive(Debug, Default)]
pub struct PendingNotifications {
    /// Robots that have changed as the operator sees them.
    pub robots: BTreeSet<RobotId>,
    /// Robots whose desired state is new.
    pub to_notify: BTreeSet<RobotId>,
    /// Deployments that are new or have changed.
    pub deployments: BTreeSet<DeploymentId>,
    /// Events for the feed.
    pub fleet_events: Vec<FleetEvent>,
}

/// Where changes are announced. Clones announce to the same listeners.
#[derive(Debug, Clone)]
pub struct Changes {
    notices: broadcast::Sender<Change>,
    fleet_events: broadcast::Sender<FleetEvent>,
    wake_queue: Arc<WakeQueue>,
    rights: Arc<watch::Sender<()>>,
    part_requests: PartRequests,
}

/// Robots to notify: a set, so a robot waits here once however often its desired state changes.
#[derive(Debug, Default)]
struct WakeQueue {
    waiting: Mutex<RobotsToNotify>,
    added: Notify,
}

/// The robots to notify.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct RobotsToNotify {
    /// Whether all robots are to be notified.
    pub all: bool,
    pub robots: BTreeSet<RobotId>,
}

impl Changes {
    pub fn new() -> Self {
        Self {
            notices: broadcast::Sender::new(CHANNEL_CAPACITY),
            fleet_events: broadcast::Sender::new(CHANNEL_CAPACITY),
            wake_queue: Arc::default(),
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
    pub fn announce_event(&self, event: FleetEvent) {
        let _ = self.fleet_events.send(event);
    }

    /// Everything that happens from now on.
    pub fn fleet_events(&self) -> broadcast::Receiver<FleetEvent> {
        self.fleet_events.subscribe()
    }

    /// Announces all that a write has changed. To be called after its commit.
    pub fn publish(&self, notifications: PendingNotifications) {
        for robot in notifications.robots.union(&notifications.to_notify) {
            self.announce(Change::Robot(robot.clone()));
        }
        for deployment in notifications.deployments {
            self.announce(Change::Deployment(deployment));
        }
        notifications.fleet_events.into_iter().for_each(|event| self.announce_event(event));
        self.notify_robots(notifications.to_notify);
    }

    /// Queues notifications to `robots` about their new desired state.
    pub fn notify_robots(&self, robots: impl IntoIterator<Item = RobotId>) {
        let mut waiting = self.wake_queue.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.robots.extend(robots);
        if !waiting.robots.is_empty() {
            self.wake_queue.added.notify_one();
        }
    }

    /// Queues notifications to all robots about their desired state.
    pub fn notify_all_robots(&self) {
        self.wake_queue.waiting.lock().unwrap_or_else(PoisonError::into_inner).all = true;
        self.wake_queue.added.notify_one();
    }

    /// Waits until robots are queued and takes them all. Made for one caller, the downlink;
    /// dropping the future loses none.
    pub async fn take_robots_to_notify(&self) -> RobotsToNotify {
        loop {
            let taken = std::mem::take(
                &mut *self.wake_queue.waiting.lock().unwrap_or_else(PoisonError::into_inner),
            );
            if taken != RobotsToNotify::default() {
                return taken;
            }
            self.wake_queue.added.notified().await;
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
    async fn robot_queued_twice_is_taken_once() {
        let changes = Changes::new();
        let robot = RobotId::random();
        changes.notify_robots([robot.clone()]);
        changes.notify_robots([robot.clone()]);
        assert_eq!(changes.take_robots_to_notify().await.robots, BTreeSet::from([robot.clone()]));
        let waiting = tokio::spawn({
            let changes = changes.clone();
            async move { changes.take_robots_to_notify().await }
        });
        changes.notify_robots([robot.clone()]);
        let taken = waiting.await.expect("no panic");
        assert_eq!(taken, RobotsToNotify { all: false, robots: BTreeSet::from([robot.clone()]) });
        changes.notify_all_robots();
        changes.notify_robots([robot.clone()]);
        assert_eq!(
            changes.take_robots_to_notify().await,
            RobotsToNotify { all: true, robots: BTreeSet::from([robot]) }
        );
    }
}
