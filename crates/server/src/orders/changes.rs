//! Announces changes after the commit: notices for the event stream, and the robots whose desired
//! state is new. Nothing here has to survive a crash: both sides compare again on connect. In a
//! cluster, each announcement also goes into an outbox for the other servers.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use task_proto::{DeploymentId, RobotId, UserName};
use tokio::sync::{Notify, broadcast, watch};

pub use super::change::{Change, RobotsToNotify};
use super::outbox::Outbox;
use crate::domain::fleet_event::FleetEvent;
use crate::fleet::part_requests::PartRequests;

/// Capacity of a channel: a receiver that falls further behind misses entries.
const CHANNEL_CAPACITY: usize = 16 * 1024;
/// Capacity of the channel of deployments and removed robots.
const HERE_CAPACITY: usize = 4 * 1024;

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
    /// The notices of changes at this server.
    notices_here: broadcast::Sender<Change>,
    origin: Origin,
    fleet_events: broadcast::Sender<FleetEvent>,
    wake_queue: Arc<WakeQueue>,
    rights: Arc<watch::Sender<()>>,
    part_requests: PartRequests,
}

/// Where the announced changes happen.
#[derive(Debug, Clone)]
enum Origin {
    /// At this server; the outbox is for the others of its cluster.
    Here(Option<Outbox>),
    Elsewhere,
}

/// Robots to notify: a set, so a robot waits here once however often its desired state changes.
#[derive(Debug, Default)]
struct WakeQueue {
    waiting: Mutex<RobotsToNotify>,
    added: Notify,
}

impl Changes {
    pub fn new() -> Self {
        Self {
            notices: broadcast::Sender::new(CHANNEL_CAPACITY),
            notices_here: broadcast::Sender::new(HERE_CAPACITY),
            origin: Origin::Here(None),
            fleet_events: broadcast::Sender::new(CHANNEL_CAPACITY),
            wake_queue: Arc::default(),
            rights: Arc::new(watch::Sender::new(())),
            part_requests: PartRequests::default(),
        }
    }

    /// Also puts each announcement into `outbox`, for the other servers of the cluster.
    pub fn with_outbox(self, outbox: Outbox) -> Self {
        Self { origin: Origin::Here(Some(outbox)), ..self }
    }

    /// A handle that announces changes at another server to the same listeners.
    pub fn from_elsewhere(&self) -> Self {
        Self { origin: Origin::Elsewhere, ..self.clone() }
    }

    fn outbox(&self) -> Option<&Outbox> {
        match &self.origin {
            Origin::Here(outbox) => outbox.as_ref(),
            Origin::Elsewhere => None,
        }
    }

    /// Tells long-lived connections that users or their tokens have changed.
    pub fn announce_rights(&self) {
        self.rights.send_replace(());
        if let Some(outbox) = self.outbox() {
            outbox.add(|updates| updates.rights = true);
        }
    }

    /// Has the other servers of the cluster end the robot's connections, except those by the token
    /// `kept`.
    pub fn end_robot_elsewhere(&self, robot: &RobotId, kept: Option<u64>) {
        if let Some(outbox) = self.outbox() {
            outbox.add(|updates| {
                updates.robots_to_end.insert(robot.clone(), kept);
            });
        }
    }

    /// Has the other servers of the cluster end the person's MQTT sessions.
    pub fn end_person_elsewhere(&self, user: &UserName) {
        if let Some(outbox) = self.outbox() {
            outbox.add(|updates| {
                updates.people_to_end.insert(user.clone());
            });
        }
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

    /// Every notice from now on of a change at this server.
    pub fn subscribe_here(&self) -> broadcast::Receiver<Change> {
        self.notices_here.subscribe()
    }

    /// Tells all listeners; no listener is fine.
    pub fn announce(&self, change: Change) {
        if let Origin::Here(outbox) = &self.origin {
            // Only the feed listens, and only to these.
            if matches!(change, Change::Deployment(_) | Change::RobotRemoved(_)) {
                let _ = self.notices_here.send(change.clone());
            }
            if let Some(outbox) = outbox {
                outbox.add_change(&change);
            }
        }
        let _ = self.notices.send(change);
    }

    /// Tells the listeners of this server only.
    pub fn announce_here(&self, change: Change) {
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

    /// Queues notifications to `robots` about their new desired state, wherever they are connected.
    pub fn notify_robots(&self, robots: impl IntoIterator<Item = RobotId>) {
        let robots: Vec<RobotId> = robots.into_iter().collect();
        if let Some(outbox) = self.outbox().filter(|_| !robots.is_empty()) {
            outbox.add(|updates| updates.to_notify.robots.extend(robots.iter().cloned()));
        }
        self.notify_robots_here(robots);
    }

    /// Queues notifications to `robots`, if they are connected to this server.
    pub fn notify_robots_here(&self, robots: impl IntoIterator<Item = RobotId>) {
        let mut waiting = self.wake_queue.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.robots.extend(robots);
        if !waiting.robots.is_empty() {
            self.wake_queue.added.notify_one();
        }
    }

    /// Queues notifications to all robots about their desired state.
    pub fn notify_all_robots(&self) {
        if let Some(outbox) = self.outbox() {
            outbox.add(|updates| updates.to_notify.all = true);
        }
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
    use super::super::outbox::Updates;
    use super::*;

    #[test]
    fn change_at_another_server_is_announced_and_not_sent_again() {
        let outbox = Outbox::default();
        let changes = Changes::new().with_outbox(outbox.clone());
        outbox.set_listeners(true);
        let (mut all, mut here) = (changes.subscribe(), changes.subscribe_here());
        let (robot, deployment) = (RobotId::random(), DeploymentId::random());
        let announce = |changes: &Changes| {
            changes.announce(Change::Deployment(deployment.clone()));
            changes.notify_robots([robot.clone()]);
            changes.announce_rights();
        };
        announce(&changes.from_elsewhere());
        assert_eq!(outbox.take(), Updates::default());
        assert!(all.try_recv().is_ok() && here.try_recv().is_err());
        announce(&changes);
        let expected = Updates {
            to_notify: RobotsToNotify { all: false, robots: BTreeSet::from([robot]) },
            rights: true,
            changes: BTreeSet::from([Change::Deployment(deployment)]),
            ..Updates::default()
        };
        assert_eq!(outbox.take(), expected);
        assert!(all.try_recv().is_ok() && here.try_recv().is_ok());
    }

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
