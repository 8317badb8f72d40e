//! The membership of this server: its heartbeat, the others' heartbeats, and the sessions of servers
//! that have ended. Every server does the same; none leads.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use task_proto::RobotId;

use super::Cluster;
use super::bus::Bus;
use crate::domain::fleet_event::FleetEvent;
use crate::orders::changes::Change;
use crate::store::{NewNode, Node, NodeLoad, StoreError};

/// Interval between two heartbeats.
const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(2);
/// Interval between checks for robots that have left and not come back.
const MISSING_INTERVAL: Duration = Duration::from_secs(1);
/// Time for robots of a server that has ended to connect to another, before they count as away.
const CLEAR_DELAY: Duration = Duration::from_secs(30);
/// Time for which the row of a server that has ended is kept, so that people see it.
const KEEP_TIME: Duration = Duration::from_secs(3600);

pub(super) struct Membership {
    cluster: Cluster,
    bus: Arc<dyn Bus>,
}

/// The servers that have ended.
#[derive(Default)]
struct EndedRuns {
    /// When each was found, and whether its sessions are ended.
    runs: HashMap<String, (Instant, bool)>,
}

impl Membership {
    pub(super) fn new(cluster: Cluster, bus: Arc<dyn Bus>) -> Self {
        cluster.nodes.join(&cluster.run);
        Self { cluster, bus }
    }

    /// Stores that this server serves.
    pub(super) async fn join(&self) {
        let Cluster { store, settings, run, .. } = &self.cluster;
        let node = NewNode {
            name: settings.name.as_str(),
            run,
            url: Some(&settings.url),
            version: env!("CARGO_PKG_VERSION"),
        };
        if let Err(error) = store.nodes().join(node).await {
            error.log("this server could not join its cluster yet");
        }
    }

    pub(super) async fn run(self) {
        let mut ticks = tokio::time::interval(HEARTBEAT_INTERVAL);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut ended = EndedRuns::default();
        let mut losses = self.cluster.store.lost_connections();
        loop {
            ticks.tick().await;
            self.cluster.nodes.set_bus_problem(self.bus.problem());
            let stored = self.heartbeat().await;
            match stored {
                Ok(nodes) => self.observe(&nodes, &mut ended).await,
                Err(error) => {
                    error.log("this server's heartbeat could not be stored");
                    continue;
                }
            }
            let lost = self.cluster.store.lost_connections();
            if std::mem::replace(&mut losses, lost) != lost {
                // The database may have lost the last rows with the connection.
                self.cluster.presence.share_all();
            }
            self.bus.announce(Vec::new()).await;
        }
    }

    /// Raises the own heartbeat, and reads all.
    async fn heartbeat(&self) -> Result<Vec<Node>, StoreError> {
        let Cluster { store, settings, run, load, listeners, .. } = &self.cluster;
        let (transfers, backlog) = load.here();
        let load = NodeLoad { listeners: listeners() as u64, transfers, backlog };
        let name = settings.name.as_str();
        let is_known = store.nodes().heartbeat(name, run, load).await?;
        let nodes = store.nodes().list().await?;
        if !is_known {
            match nodes.iter().find(|node| node.name == name) {
                Some(_) => {
                    store.record_takeover(&format!("another server with cluster.name {name}"))
                }
                None => self.join().await,
            }
        }
        Ok(nodes)
    }

    async fn observe(&self, nodes: &[Node], ended: &mut EndedRuns) {
        let Cluster { presence, changes, outbox, load, signals, run, .. } = &self.cluster;
        let now = Instant::now();
        let heartbeats = nodes.iter().map(|node| (node.run.as_str(), node.heartbeat));
        let observed = self.cluster.nodes.observe(heartbeats, now);
        for began in &observed.began {
            tracing::info!(run = began, "another server of the cluster serves");
            ended.runs.remove(began);
            signals.sessions.notify_one();
        }
        for run in observed.ended {
            tracing::warn!(run, "another server of the cluster has ended");
            if let Some(shared) = presence.shared() {
                let robots = shared.elsewhere.of_run(&run);
                robots.into_iter().for_each(|robot| changes.announce_here(Change::Robot(robot)));
            }
            ended.runs.insert(run, (now, false));
        }
        let others = nodes.iter().filter(|node| node.run != **run);
        let live: Vec<&Node> =
            others.filter(|node| self.cluster.nodes.is_live(&node.run)).collect();
        outbox.set_listeners(live.iter().any(|node| node.load.listeners > 0));
        let total = |of: fn(&NodeLoad) -> u64| live.iter().map(|node| of(&node.load)).sum();
        load.set_elsewhere(total(|load| load.transfers), total(|load| load.backlog));
        self.clear_ended(ended, now).await;
    }

    /// Ends the sessions of servers that have ended a while ago, and deletes the rows of those that
    /// ended long ago. The first server that does it announces the robots that are away.
    async fn clear_ended(&self, ended: &mut EndedRuns, now: Instant) {
        let Cluster { store, presence, clock, changes, .. } = &self.cluster;
        for run in ended.due(now) {
            let now_ms = clock.now_ms();
            match store.robot_sessions().end_run(&run, now_ms).await {
                Ok(robots) => {
                    let is_away = |robot: &RobotId| !presence.is_online(robot, now_ms);
                    for robot in robots.into_iter().filter(is_away) {
                        changes.announce_event(FleetEvent::Presence(robot, false));
                    }
                    if let Some(shared) = presence.shared() {
                        shared.elsewhere.end_run(&run, now_ms);
                    }
                    ended.runs.entry(run).and_modify(|(_, is_cleared)| *is_cleared = true);
                }
                Err(error) => error.log("sessions of a server that has ended could not be ended"),
            }
        }
        for run in ended.over(now) {
            match store.nodes().delete(&run).await {
                Ok(()) => drop(ended.runs.remove(&run)),
                Err(error) => error.log("a server that has ended could not be deleted"),
            }
        }
    }
}

impl EndedRuns {
    /// The runs whose sessions are to be ended.
    fn due(&self, now: Instant) -> Vec<String> {
        let is_due = |(at, is_cleared): &(Instant, bool)| {
            !is_cleared && now.saturating_duration_since(*at) >= CLEAR_DELAY
        };
        self.runs.iter().filter(|(_, run)| is_due(run)).map(|(run, _)| run.clone()).collect()
    }

    /// The runs whose rows are to be deleted.
    fn over(&self, now: Instant) -> Vec<String> {
        let is_over = |(at, _): &(Instant, bool)| now.saturating_duration_since(*at) >= KEEP_TIME;
        self.runs.iter().filter(|(_, run)| is_over(run)).map(|(run, _)| run.clone()).collect()
    }
}

/// Announces the robots that have left this server and come to no other, without end.
pub(super) async fn announce_missing(cluster: Cluster) {
    let Cluster { presence, changes, clock, .. } = &cluster;
    let Some(shared) = presence.shared() else { return std::future::pending().await };
    loop {
        tokio::time::sleep(MISSING_INTERVAL).await;
        for robot in shared.missing(Instant::now()) {
            if !presence.is_online(&robot, clock.now_ms()) {
                changes.announce_event(FleetEvent::Presence(robot, false));
            }
        }
    }
}
