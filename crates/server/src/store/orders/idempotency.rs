//! Idempotency keys of orders, and the answers to them.

use crate::store::repositories::Idempotency;
use crate::store::rows::stored;
use crate::store::{StoreError, Transaction};

/// An order that was carried out before.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotencyRecord {
    pub request: String,
    pub answer: String,
}

impl Idempotency<&mut Transaction> {
    /// The order that came with `key`.
    pub async fn get(&mut self, key: &str) -> Result<Option<IdempotencyRecord>, StoreError> {
        let row: Option<(String, String)> =
            sqlx::query_as("SELECT request, answer FROM orders WHERE key = $1")
                .bind(key)
                .fetch_optional(self.0.connection())
                .await?;
        Ok(row.map(|(request, answer)| IdempotencyRecord { request, answer }))
    }

    /// Stores the order that came with `key`.
    pub async fn insert(
        &mut self,
        key: &str,
        order: &IdempotencyRecord,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO orders (key, request, answer, created_at_ms) VALUES ($1, $2, $3, $4)",
        )
        .bind(key)
        .bind(order.request.as_str())
        .bind(order.answer.as_str())
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Deletes the keys that came before `before_ms`.
    pub async fn delete_before(&mut self, before_ms: u64) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM orders WHERE created_at_ms < $1")
            .bind(stored(before_ms))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }
}
