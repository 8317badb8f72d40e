//! Finds the robots at this server that missed something: a new desired state, or the end of their
//! rights. It asks the database and needs no message.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use task_proto::RobotId;

use super::Cluster;
use crate::config::Bus as BusKind;
use crate::store::StoreError;

/// Interval between two sweeps beside the bus.
const INTERVAL: Duration = Duration::from_secs(10);
/// Interval between two sweeps without a bus.
const INTERVAL_WITHOUT_BUS: Duration = Duration::from_secs(5);
/// The shortest interval, whatever is missed.
const PAUSE: Duration = Duration::from_millis(250);
/// Interval between two looks for sessions without a right.
const RIGHTS_INTERVAL: Duration = Duration::from_secs(30);
/// Time before a robot that is behind is notified again, unless its state is newer.
const RENOTIFY_INTERVAL: Duration = Duration::from_secs(30);

/// The findings of earlier sweeps.
pub(super) struct Sweep {
    cluster: Cluster,
    notified: Notified,
}

/// The robots that were notified, each with its generation and the time.
#[derive(Default)]
struct Notified(HashMap<RobotId, (u64, Instant)>);

impl Sweep {
    pub(super) fn new(cluster: Cluster) -> Self {
        Self { cluster, notified: Notified::default() }
    }

    pub(super) async fn run(mut self) {
        let interval = match self.cluster.settings.bus {
            BusKind::Postgres => INTERVAL,
            BusKind::Off => INTERVAL_WITHOUT_BUS,
        };
        let woken = self.cluster.signals.sweep.clone();
        let mut rights_at = Instant::now();
        loop {
            let was_woken = tokio::time::timeout(interval, woken.notified()).await.is_ok();
            if let Err(error) = self.notify_behind().await {
                error.log("robots that are behind could not be read; trying again");
            }
            if was_woken || rights_at.elapsed() >= RIGHTS_INTERVAL {
                rights_at = Instant::now();
                if let Err(error) = self.end_without_right().await {
                    error.log("sessions without a right could not be read; trying again");
                }
            }
            tokio::time::sleep(PAUSE).await;
        }
    }

    async fn notify_behind(&mut self) -> Result<(), StoreError> {
        let behind = self.cluster.store.robot_sessions().behind(&self.cluster.run).await?;
        let due = self.notified.due(behind, Instant::now());
        if !due.is_empty() {
            tracing::debug!(robots = due.len(), "robots that are behind are notified");
            self.cluster.changes.notify_robots_here(due);
        }
        Ok(())
    }

    async fn end_without_right(&self) -> Result<(), StoreError> {
        let robots = self.cluster.store.robot_sessions().without_right(&self.cluster.run).await?;
        for robot in robots {
            tracing::info!(%robot, "the robot's session ends, because its token has");
            self.cluster.end_robot(&robot);
        }
        Ok(())
    }
}

impl Cluster {
    /// Ends what a robot has open here, because its tokens have ended.
    pub(super) fn end_robot(&self, robot: &RobotId) {
        self.store.forget_admissions();
        self.broker.disconnect(robot);
        self.http_connections.end(robot);
        // A robot that polled would otherwise count as online for a while.
        self.presence.forget(robot);
    }
}

impl Notified {
    /// Those of the robots that are behind that are to be notified now.
    fn due(&mut self, behind: Vec<(RobotId, u64)>, now: Instant) -> Vec<RobotId> {
        let mut notified = HashMap::with_capacity(behind.len());
        let mut due = Vec::new();
        for (robot, generation) in behind {
            let before = self.0.get(&robot).copied().filter(|(known, at)| {
                *known == generation && now.saturating_duration_since(*at) < RENOTIFY_INTERVAL
            });
            if before.is_none() {
                due.push(robot.clone());
            }
            notified.insert(robot, before.unwrap_or((generation, now)));
        }
        self.0 = notified;
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn robot_is_notified_once_for_each_generation_and_interval() {
        let (mut notified, start) = (Notified::default(), Instant::now());
        let robot = RobotId::random();
        let mut due = |generation, seconds| {
            let now = start + Duration::from_secs(seconds);
            notified.due(vec![(robot.clone(), generation)], now).len()
        };
        assert_eq!([due(1, 0), due(1, 10), due(2, 11), due(2, 40), due(2, 41)], [1, 0, 1, 0, 1]);
        assert!(notified.due(Vec::new(), start).is_empty());
        assert_eq!(notified.due(vec![(robot, 2)], start).len(), 1, "it was up to date meanwhile");
    }
}
