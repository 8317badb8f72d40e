//! Sends this server's updates to the others, and feeds theirs into the channels of local changes.
//! It never sends another server's update again.

use std::sync::Arc;
use std::time::Duration;

use super::Cluster;
use super::bus::{Bus, Received};
use super::message::{ClusterMessage, messages};
use crate::orders::changes::{Change, Changes};

/// Time in which updates are gathered before they are sent.
const GATHER_TIME: Duration = Duration::from_millis(25);

/// Both directions. Clones share the bus.
#[derive(Clone)]
pub(super) struct Messenger {
    cluster: Cluster,
    /// Announces changes at other servers.
    elsewhere: Changes,
    bus: Arc<dyn Bus>,
}

impl Messenger {
    pub(super) fn new(cluster: Cluster, bus: Arc<dyn Bus>) -> Self {
        Self { elsewhere: cluster.changes.from_elsewhere(), cluster, bus }
    }

    /// Sends updates without end.
    pub(super) async fn send(self) {
        let outbox = &self.cluster.outbox;
        let mut admissions = self.cluster.store.changed_admissions();
        loop {
            tokio::select! {
                () = outbox.filled() => {}
                _ = admissions.changed() => outbox.add(|updates| updates.auth = true),
            }
            tokio::time::sleep(GATHER_TIME).await;
            // A change of admissions that came with other updates belongs before them.
            if admissions.has_changed().unwrap_or(false) {
                admissions.mark_unchanged();
                outbox.add(|updates| updates.auth = true);
            }
            self.bus.announce(messages(outbox.take())).await;
        }
    }

    pub(super) async fn receive(self) {
        loop {
            match self.bus.receive().await {
                Received::Messages(messages) => {
                    messages.into_iter().for_each(|message| self.pass_on(message));
                }
                Received::Gap => self.look_everywhere(),
            }
        }
    }

    fn pass_on(&self, message: ClusterMessage) {
        let Cluster { store, signals, .. } = &self.cluster;
        match message {
            ClusterMessage::AdmissionsChanged => store.forget_admissions(),
            ClusterMessage::RightsChanged => self.elsewhere.announce_rights(),
            ClusterMessage::EndRobot { robot, kept: Some(kept) } => {
                store.forget_admissions();
                self.cluster.broker.disconnect_other_tokens(&robot, kept);
                self.cluster.http_connections.end(&robot);
                self.cluster.presence.end_other_instances(&robot);
            }
            ClusterMessage::EndRobot { robot, kept: None } => self.cluster.end_robot(&robot),
            ClusterMessage::EndPerson(user) => {
                store.forget_admissions();
                self.cluster.broker.disconnect_person(&user);
            }
            ClusterMessage::NotifyRobots(robots) => self.elsewhere.notify_robots(robots),
            ClusterMessage::NotifyAllRobots => self.elsewhere.notify_all_robots(),
            ClusterMessage::Sweep => signals.sweep.notify_one(),
            ClusterMessage::SessionsChanged => signals.sessions.notify_one(),
            ClusterMessage::Changed(change) => self.elsewhere.announce(change),
        }
    }

    /// Handles every message that may have been missed.
    fn look_everywhere(&self) {
        let Cluster { store, signals, broker, .. } = &self.cluster;
        store.forget_admissions();
        signals.sessions.notify_one();
        signals.sweep.notify_one();
        broker.disconnect_people();
        self.elsewhere.announce_rights();
        self.elsewhere.announce(Change::Missed);
    }
}
