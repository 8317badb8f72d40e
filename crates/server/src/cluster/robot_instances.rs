//! Compares the agents that robots have here with those that they had at any server, so that two
//! machines with one identity are found wherever they connect.

use std::time::Duration;

use super::Cluster;
use crate::fleet::shared_presence::Observed;
use crate::orders::changes::Change;

/// Pause after a failed comparison. The next message of the robot is compared again.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

pub(super) async fn compare(cluster: Cluster) {
    let Cluster { store, presence, changes, clock, .. } = &cluster;
    let Some(shared) = presence.shared() else { return std::future::pending().await };
    loop {
        let (robot, observed) = shared.instances.take().await;
        let compared = store.robot_sessions().change_instances(&robot, |history| match &observed {
            Observed::Instance(instance, at_ms) => history.observe(instance, *at_ms),
            Observed::Reset => std::mem::take(history) != Default::default(),
        });
        match compared.await {
            Ok(history) => {
                let now_ms = clock.now_ms();
                let was_duplicate = presence.is_duplicate(&robot, now_ms);
                presence.set_instances(&robot, history);
                if presence.is_duplicate(&robot, now_ms) != was_duplicate {
                    changes.announce(Change::Robot(robot));
                }
            }
            Err(error) => {
                error.log("a robot's agent could not be compared with those at other servers");
                tokio::time::sleep(RETRY_INTERVAL).await;
            }
        }
    }
}
