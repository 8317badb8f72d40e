//! The server's own order, about once a minute: ends what has lasted too long.

use std::collections::BTreeSet;

use task_proto::UserName;
use task_proto::messages::report::Phase;

use super::deployments::revert;
use super::robots::expire_pending;
use super::{Actions, DAY_MS, DeploymentActions};
use crate::orders::changes::Change;
use crate::store::StoreError;

/// Lifetime of an idempotency key.
const KEY_LIFETIME_MS: u64 = 30 * DAY_MS;
/// Time for which a network stays familiar after a sign-in from there.
const FAMILIAR_LIFETIME_MS: u64 = 90 * DAY_MS;

impl Actions {
    /// Ends assignments past their time limit, and removes old idempotency keys, tokens and page
    /// sessions that have ended, old wrong passwords, networks of old sign-ins and robots that were
    /// never approved. To be
    /// called about once a minute. Returns the users of those tokens.
    pub async fn expire(&self) -> Result<BTreeSet<UserName>, StoreError> {
        let DeploymentActions { store, clock, changes, .. } = &self.deployments;
        let now_ms = clock.now_ms();
        let mut write = store.begin().await?;
        write.idempotency().delete_before(now_ms.saturating_sub(KEY_LIFETIME_MS)).await?;
        let users = write.tokens().forget_ended(now_ms).await?;
        write.page_sessions().delete_ended(now_ms).await?;
        write.sign_in_failures().delete_ended(now_ms).await?;
        let unused_ms = now_ms.saturating_sub(FAMILIAR_LIFETIME_MS);
        write.familiar_networks().delete_before(unused_ms).await?;
        let given_up = expire_pending(&mut write, now_ms).await?;
        write.commit().await?;
        given_up
            .into_iter()
            .for_each(|robot| changes.announce(Change::RobotRemoved(Box::new(robot))));
        while self.expire_assignments(now_ms).await? {}
        Ok(users)
    }

    /// Ends assignments past their time limit, as many as fit into one write. Returns whether there
    /// may be more.
    async fn expire_assignments(&self, now_ms: u64) -> Result<bool, StoreError> {
        let DeploymentActions { store, changes, planner, chunk_robots: most, .. } =
            &self.deployments;
        let mut write = store.begin().await?;
        let overdue = write.assignments().overdue(now_ms, *most).await?;
        if overdue.is_empty() {
            return Ok(false);
        }
        let notifications = revert(&mut write, planner, &overdue, Phase::Expired, now_ms).await?;
        write.commit().await?;
        changes.publish(notifications);
        Ok(overdue.len() == *most)
    }
}
