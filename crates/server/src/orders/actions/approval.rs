//! Robots that wait for approval: approving and rejecting them.

use task_proto::RobotId;
use task_proto::api::PendingRobotList;

use super::robots::known_robot;
use super::{ActionError, Actions, DAY_MS};
use crate::domain::person::Person;
use crate::orders::changes::Change;
use crate::store::{Act, Deed, KnownRobot, StoreError, Write};

/// How long a robot may wait for approval.
const PENDING_LIFETIME_MS: u64 = 7 * DAY_MS;

impl Actions {
    /// The robots that wait to be approved.
    pub async fn pending_robots(&self) -> Result<PendingRobotList, ActionError> {
        Ok(PendingRobotList { robots: self.store.pending_robots().await? })
    }

    /// Approves a waiting robot. The call is idempotent.
    pub async fn approve_robot(&self, by: &Person, robot: &RobotId) -> Result<(), ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let known = known_robot(&mut write, robot.as_str()).await?;
        if !write.is_pending(robot).await? {
            return Ok(());
        }
        write.approve_robot(robot).await?;
        let deed =
            Deed::by(by, Act::RobotApprove, robot).with("name", &known.name).with("mac", known.mac);
        write.audit(&deed, now_ms).await?;
        write.commit().await?;
        self.changes.announce(Change::Robot(known.id));
        Ok(())
    }

    /// Rejects a waiting robot and removes its records. A robot that does not wait is not affected:
    /// that would be a removal.
    pub async fn reject_robot(&self, by: &Person, robot: &RobotId) -> Result<(), ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let known = known_robot(&mut write, robot.as_str()).await?;
        if !write.is_pending(robot).await? {
            return Err(ActionError::NotPending(known.name));
        }
        turn_away(&mut write, &known, Deed::by(by, Act::RobotReject, robot), now_ms).await?;
        write.commit().await?;
        self.changes.announce(Change::RobotRemoved(Box::new(known)));
        Ok(())
    }
}

/// Rejects robots that have waited for too long, and returns them.
pub(super) async fn give_up_pending(
    write: &mut Write,
    now_ms: u64,
) -> Result<Vec<KnownRobot>, StoreError> {
    let given_up = write.pending_since(now_ms.saturating_sub(PENDING_LIFETIME_MS)).await?;
    for known in &given_up {
        let deed = Deed::new("server".to_owned(), None, None, Act::RobotReject, &known.id)
            .with("because", "nobody approved it");
        turn_away(write, known, deed, now_ms).await?;
    }
    Ok(given_up)
}

async fn turn_away(
    write: &mut Write,
    known: &KnownRobot,
    deed: Deed,
    now_ms: u64,
) -> Result<(), StoreError> {
    let robots = std::slice::from_ref(&known.id);
    write.revoke_tokens(robots, now_ms).await?;
    write.remove_robots(robots, now_ms).await?;
    write.audit(&deed.with("name", &known.name).with("mac", known.mac), now_ms).await
}
