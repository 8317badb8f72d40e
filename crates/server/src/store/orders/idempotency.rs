//! Idempotency keys of orders, and the answers to them.

use task_proto::UserName;

use crate::store::repositories::Idempotency;
use crate::store::rows::{number, stored};
use crate::store::{StoreError, Transaction};

/// Size of a row besides its texts.
const ROW_BYTES: usize = 256;

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

    /// Stores the order of `person` that came with `key`. Of the person's orders those in the last
    /// `max_bytes` are kept, the one at the limit whole.
    pub async fn insert(
        &mut self,
        key: &str,
        order: &IdempotencyRecord,
        person: &UserName,
        max_bytes: u64,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let sum: Option<i64> =
            sqlx::query_scalar("SELECT MAX(bytes_until) FROM orders WHERE person = $1")
                .bind(person.as_str())
                .fetch_one(self.0.connection())
                .await?;
        let size = ROW_BYTES + key.len() + order.request.len() + order.answer.len();
        let bytes_until = sum.map_or(0, number).saturating_add(size as u64);
        sqlx::query(
            "INSERT INTO orders (key, request, answer, created_at_ms, person, bytes_until)
             VALUES ($1, $2, $3, $4, $5, $6)",
        )
        .bind(key)
        .bind(order.request.as_str())
        .bind(order.answer.as_str())
        .bind(stored(now_ms))
        .bind(person.as_str())
        .bind(stored(bytes_until))
        .execute(self.0.connection())
        .await?;
        sqlx::query("DELETE FROM orders WHERE person = $1 AND bytes_until <= $2")
            .bind(person.as_str())
            .bind(stored(bytes_until.saturating_sub(max_bytes)))
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
