//! Moves rollouts on, inside the write that may have settled something: carries out what [`crate::rollout`] decides.

use std::collections::BTreeSet;

use task_proto::DeploymentId;
use task_proto::desired::Delivery;

use crate::changes::Consequences;
use crate::chooser::Chooser;
use crate::rollout::{Move, next_move};
use crate::store::{StoreError, Write};

/// Begins the next batch of each of `touched` that is due, or pauses it. A batch that takes another deployment's place on
/// some robot may settle that one's batch, so that one is looked at as well.
pub async fn advance(
    write: &mut Write,
    chooser: &Chooser,
    touched: BTreeSet<DeploymentId>,
    now_ms: u64,
    consequences: &mut Consequences,
) -> Result<(), StoreError> {
    let mut waiting = touched;
    // Ends, because each turn but the last of a deployment releases an assignment, and none is ever taken back.
    while let Some(deployment) = waiting.pop_first() {
        let Some((rollout, tally)) = write.rollout(&deployment).await? else { continue };
        match next_move(&rollout, &tally) {
            Move::Wait => continue,
            Move::Pause => write.pause(&deployment).await?,
            Move::Release(count) => {
                let released = write.release(&deployment, count, now_ms).await?;
                consequences.deployments.extend(released.superseded.iter().cloned());
                for (robot, mechanism) in chooser.decide(write, &deployment, &released.robots, now_ms).await? {
                    // Robots that are to ask by themselves are not rung.
                    match mechanism {
                        Delivery::Poll => consequences.robots.insert(robot),
                        Delivery::PushPull | Delivery::DirectPush | Delivery::Inline => {
                            consequences.rings.insert(robot)
                        }
                    };
                }
                waiting.extend(released.superseded);
                // Should it have begun on robots only that nothing is waited for.
                waiting.insert(deployment.clone());
            }
        }
        consequences.deployments.insert(deployment);
    }
    Ok(())
}
