//! Reads the sessions of robots at the other servers: for each live server, the rows that it has
//! written since the last look. This module never writes.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Cluster;
use super::session_writer::SessionWriter;
use crate::fleet::sessions_elsewhere::SessionElsewhere;
use crate::orders::changes::Change;
use crate::store::{RobotSession, SessionPosition, StoreError};

/// The longest interval between two looks.
const INTERVAL: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(100);

/// Reads sessions of other servers, and remembers the last one of each.
pub(super) struct SessionReader {
    cluster: Cluster,
    writer: Arc<SessionWriter>,
    /// How far the sessions of each live run were read.
    positions: HashMap<Arc<str>, Position>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Position {
    /// The last change that was read.
    change: u64,
    /// Whether all earlier ones were read, so that the next are new.
    is_caught_up: bool,
}

impl SessionReader {
    pub(super) fn new(cluster: Cluster, writer: Arc<SessionWriter>) -> Self {
        Self { cluster, writer, positions: HashMap::new() }
    }

    pub(super) async fn run(mut self) {
        let woken = self.cluster.signals.sessions.clone();
        loop {
            if let Err(error) = self.read().await {
                error.log("the robots at other servers could not be read; trying again");
            }
            tokio::time::sleep(PAUSE).await;
            // The time limit only means that there was no hint.
            let _ = tokio::time::timeout(INTERVAL, woken.notified()).await;
        }
    }

    async fn read(&mut self) -> Result<(), StoreError> {
        loop {
            let positions = self.live_positions();
            let (sessions, has_more) =
                self.cluster.store.robot_sessions().changed(&positions).await?;
            for session in sessions {
                self.take(session);
            }
            if !has_more {
                for SessionPosition { run, .. } in positions {
                    self.positions.entry(run.into()).or_default().is_caught_up = true;
                }
                return Ok(());
            }
        }
    }

    /// The positions in the live runs of other servers. Those of ended runs are forgotten.
    fn live_positions(&mut self) -> Vec<SessionPosition> {
        let runs = self.cluster.nodes.runs();
        self.positions.retain(|run, _| runs.iter().any(|live| **live == **run));
        let others = runs.into_iter().filter(|run| **run != *self.cluster.run);
        let position = |run: String| {
            let change = self.positions.get(run.as_str()).map_or(0, |position| position.change);
            SessionPosition { run, change }
        };
        others.map(position).collect()
    }

    fn take(&mut self, session: RobotSession) {
        let RobotSession { robot, run, epoch, change, since_ms, seen_ms, left_ms, address, agent } =
            session;
        let run: Arc<str> = run.into();
        let position = self.positions.entry(run.clone()).or_default();
        position.change = change.max(position.change);
        let is_new = position.is_caught_up;
        let left_at = left_ms.filter(|_| is_new).map(|_| Instant::now());
        let address = address.and_then(|address| address.parse().ok());
        let agent = agent.and_then(|agent| serde_json::from_str(&agent).ok());
        let elsewhere =
            SessionElsewhere { run, since_ms, seen_ms, left_ms, address, agent, left_at };
        let Some(shared) = self.cluster.presence.shared() else { return };
        if self.writer.has_newer(&robot, epoch) {
            return;
        }
        match left_ms {
            None => self.writer.taken(&robot, epoch),
            Some(_) if is_new && since_ms.is_some() => {
                self.cluster.presence.disconnected_elsewhere(&robot);
            }
            Some(_) => {}
        }
        if shared.elsewhere.put(&robot, elsewhere) {
            self.cluster.changes.announce_here(Change::Robot(robot));
        }
    }
}
