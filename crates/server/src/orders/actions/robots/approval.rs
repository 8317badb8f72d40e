//! Robots that wait for approval: approving and rejecting them.

use task_proto::RobotId;
use task_proto::api::PendingRobotList;

use super::{RobotActions, RobotError, known_robot};
use crate::domain::person::Person;
use crate::orders::actions::DAY_MS;
use crate::orders::changes::Change;
use crate::store::{AuditAction, AuditEvent, KnownRobot, StoreError, Transaction};

/// How long a robot may wait for approval.
const PENDING_LIFETIME_MS: u64 = 7 * DAY_MS;

impl RobotActions {
    /// The robots that wait to be approved.
    pub async fn pending(&self) -> Result<PendingRobotList, RobotError> {
        Ok(PendingRobotList { robots: self.store.enrollments().pending().await? })
    }

    /// Approves a waiting robot. The call is idempotent.
    pub async fn approve(&self, by: &Person, robot: &RobotId) -> Result<(), RobotError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let known = known_robot(&mut write, robot.as_str()).await?;
        if !write.enrollments().is_pending(robot).await? {
            return Ok(());
        }
        write.enrollments().approve(robot).await?;
        let event = AuditEvent::by(by, AuditAction::RobotApprove, robot)
            .with("name", &known.name)
            .with("mac", known.mac);
        write.audit().record(&event, now_ms).await?;
        write.commit().await?;
        self.changes.announce(Change::Robot(known.id));
        Ok(())
    }

    /// Rejects a waiting robot and removes its records. A robot that does not wait is not affected:
    /// that would be a removal.
    pub async fn reject(&self, by: &Person, robot: &RobotId) -> Result<(), RobotError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let known = known_robot(&mut write, robot.as_str()).await?;
        if !write.enrollments().is_pending(robot).await? {
            return Err(RobotError::NotPending(known.name));
        }
        reject(&mut write, &known, AuditEvent::by(by, AuditAction::RobotReject, robot), now_ms)
            .await?;
        write.commit().await?;
        self.changes.announce(Change::RobotRemoved(Box::new(known)));
        Ok(())
    }
}

/// Rejects robots that have waited for too long, and returns them.
pub(in crate::orders::actions) async fn expire_pending(
    write: &mut Transaction,
    now_ms: u64,
) -> Result<Vec<KnownRobot>, StoreError> {
    let expired =
        write.enrollments().pending_since(now_ms.saturating_sub(PENDING_LIFETIME_MS)).await?;
    for known in &expired {
        let event =
            AuditEvent::new("server".to_owned(), None, None, AuditAction::RobotReject, &known.id)
                .with("because", "it was not approved in time");
        reject(write, known, event, now_ms).await?;
    }
    Ok(expired)
}

async fn reject(
    write: &mut Transaction,
    known: &KnownRobot,
    event: AuditEvent,
    now_ms: u64,
) -> Result<(), StoreError> {
    let robots = std::slice::from_ref(&known.id);
    write.tokens().revoke_all_of(robots, now_ms).await?;
    write.robots().remove(robots, now_ms).await?;
    write.audit().record(&event.with("name", &known.name).with("mac", known.mac), now_ms).await
}
