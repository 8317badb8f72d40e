//! Idempotency keys of orders, and the answers to them.

use crate::store::rows::stored;
use crate::store::{StoreError, Write};

/// An order that was carried out before.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PastOrder {
    pub request: String,
    pub answer: String,
}

impl Write {
    /// The order that came with `key`.
    pub async fn past_order(&mut self, key: &str) -> Result<Option<PastOrder>, StoreError> {
        let row: Option<(String, String)> =
            sqlx::query_as("SELECT request, answer FROM orders WHERE key = $1")
                .bind(key)
                .fetch_optional(self.connection())
                .await?;
        Ok(row.map(|(request, answer)| PastOrder { request, answer }))
    }

    /// Stores the order that came with `key`.
    pub async fn remember_order(
        &mut self,
        key: &str,
        order: &PastOrder,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO orders (key, request, answer, created_at_ms) VALUES ($1, $2, $3, $4)",
        )
        .bind(key)
        .bind(order.request.as_str())
        .bind(order.answer.as_str())
        .bind(stored(now_ms))
        .execute(self.connection())
        .await?;
        Ok(())
    }

    /// Deletes the keys that came before `before_ms`.
    pub async fn forget_orders(&mut self, before_ms: u64) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM orders WHERE created_at_ms < $1")
            .bind(stored(before_ms))
            .execute(self.connection())
            .await?;
        Ok(())
    }
}
