//! Networks from which people have signed in with their password, so that they are known over a
//! restart and to all servers of the database. This module never sees a password.

use task_proto::UserName;

use crate::auth::sign_ins::NetworkDigest;
use crate::store::repositories::FamiliarNetworks;
use crate::store::rows::stored;
use crate::store::{Store, StoreError, Transaction};

impl FamiliarNetworks<&Store> {
    /// Whether the user has signed in from the network.
    pub async fn contains(
        self,
        user: &UserName,
        network: &NetworkDigest,
    ) -> Result<bool, StoreError> {
        let row = sqlx::query(
            "SELECT used_ms FROM familiar_networks WHERE user_name = $1 AND network_digest = $2",
        );
        let row = row.bind(user.as_str()).bind(network.as_str());
        Ok(row.fetch_optional(&self.0.reads).await?.is_some())
    }
}

impl FamiliarNetworks<&mut Transaction> {
    /// Stores a sign-in from the network. Of the user's networks the `max` used last are kept.
    pub async fn put(
        &mut self,
        user: &UserName,
        network: &NetworkDigest,
        max: u32,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO familiar_networks (user_name, network_digest, used_ms) VALUES ($1, $2, $3)
             ON CONFLICT (user_name, network_digest) DO UPDATE SET used_ms = excluded.used_ms",
        )
        .bind(user.as_str())
        .bind(network.as_str())
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        sqlx::query(
            "DELETE FROM familiar_networks WHERE user_name = $1 AND network_digest NOT IN
                 (SELECT network_digest FROM familiar_networks WHERE user_name = $1
                  ORDER BY used_ms DESC, network_digest LIMIT $2)",
        )
        .bind(user.as_str())
        .bind(i64::from(max))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Deletes the networks that were last used before `before_ms`.
    pub async fn delete_before(&mut self, before_ms: u64) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM familiar_networks WHERE used_ms < $1")
            .bind(stored(before_ms))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }
}
