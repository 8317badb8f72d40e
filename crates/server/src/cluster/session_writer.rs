//! Writes the sessions of robots at this server as rows, in batches. It compares what was written
//! with the present state, so a failed or late write is only tried again.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::RobotId;

use super::Cluster;
use crate::fleet::shared_presence::SessionHere;
use crate::store::{LeftSession, NewRobotSession, StoreError};

/// The most robots of one batch.
const MAX_BATCH: usize = 512;
/// Interval between two batches.
const BATCH_INTERVAL: Duration = Duration::from_millis(100);
/// Pause after a failed batch.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// The rows as this server wrote them last.
pub(super) struct SessionWriter {
    cluster: Cluster,
    written: Mutex<HashMap<RobotId, Written>>,
}

/// A row that belongs to this server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Written {
    epoch: u64,
    /// The number of the MQTT connection.
    connection: Option<u64>,
}

impl SessionWriter {
    pub(super) fn new(cluster: Cluster) -> Self {
        Self { cluster, written: Mutex::default() }
    }

    pub(super) async fn run(&self) {
        let Some(shared) = self.cluster.presence.shared() else {
            return std::future::pending().await;
        };
        // Readers follow these numbers, so they go on from statement to statement.
        let mut change = 0;
        loop {
            let robots = shared.unwritten.take(MAX_BATCH).await;
            if let Err(error) = self.write(&robots, &mut change).await {
                error.log("sessions of robots could not be stored; trying again");
                robots.iter().for_each(|robot| shared.unwritten.add(robot));
                tokio::time::sleep(RETRY_INTERVAL).await;
            }
            tokio::time::sleep(BATCH_INTERVAL).await;
        }
    }

    async fn write(&self, robots: &[RobotId], change: &mut u64) -> Result<(), StoreError> {
        let Cluster { store, presence, clock, run, nodes, outbox, .. } = &self.cluster;
        let now_ms = clock.now_ms();
        let (mut here, mut left) = (Vec::new(), Vec::new());
        for robot in robots {
            match presence.session_here(robot, now_ms) {
                Some(session) => here.push((robot.clone(), session)),
                None => left.extend(self.left(robot, now_ms)),
            }
        }
        let new: Vec<NewRobotSession> =
            here.iter().map(|(robot, session)| self.new_row(robot, session)).collect();
        let stored = store.robot_sessions().put(run, change, &new, &nodes.runs()).await?;
        let stored: HashMap<RobotId, u64> = stored.into_iter().collect();
        for (robot, session) in &here {
            self.settle(robot, session, stored.get(robot).copied());
        }
        store.robot_sessions().leave(run, change, &left).await?;
        for session in &left {
            self.written().remove(&session.robot);
        }
        if !left.is_empty() || new.iter().any(|session| session.known_epoch.is_none()) {
            outbox.add(|updates| updates.sessions = true);
        }
        Ok(())
    }

    fn new_row(&self, robot: &RobotId, session: &SessionHere) -> NewRobotSession {
        let known = self.written().get(robot).copied();
        NewRobotSession {
            robot: robot.clone(),
            known_epoch: known
                .filter(|known| known.connection == session.connection)
                .map(|known| known.epoch),
            token_number: session.token_number,
            since_ms: session.since_ms,
            seen_ms: session.seen_ms,
            address: session.address.map(|address| address.to_string()),
            agent: session.agent.as_ref().and_then(|agent| serde_json::to_string(agent).ok()),
        }
    }

    fn left(&self, robot: &RobotId, now_ms: u64) -> Option<LeftSession> {
        let epoch = self.written().get(robot)?.epoch;
        Some(LeftSession { robot: robot.clone(), epoch, left_ms: now_ms })
    }

    /// Remembers the stored epoch. A session whose row was not stored has a newer one at another
    /// server.
    fn settle(&self, robot: &RobotId, session: &SessionHere, epoch: Option<u64>) {
        match epoch {
            Some(epoch) => {
                let written = Written { epoch, connection: session.connection };
                self.written().insert(robot.clone(), written);
                if let Some(shared) = self.cluster.presence.shared() {
                    shared.elsewhere.remove(robot);
                }
            }
            None => {
                self.written().remove(robot);
                if let Some(connection) = session.connection {
                    self.cluster.broker.disconnect_session(robot, connection);
                }
            }
        }
    }

    /// Whether this server has written the robot's row since it had this epoch.
    pub(super) fn has_newer(&self, robot: &RobotId, epoch: u64) -> bool {
        self.written().get(robot).is_some_and(|known| known.epoch >= epoch)
    }

    /// Another server has stored a session of the robot with this epoch. An older MQTT session here
    /// has to end.
    pub(super) fn taken(&self, robot: &RobotId, epoch: u64) {
        let mut written = self.written();
        let Some(known) = written.get(robot).copied().filter(|known| known.epoch < epoch) else {
            return;
        };
        written.remove(robot);
        drop(written);
        if let Some(connection) = known.connection {
            tracing::debug!(%robot, "the robot has a newer session at another server");
            self.cluster.broker.disconnect_session(robot, connection);
        }
    }

    fn written(&self) -> MutexGuard<'_, HashMap<RobotId, Written>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.written.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
