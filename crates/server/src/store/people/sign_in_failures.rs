//! Wrong passwords: one window for each name, with or without an account, so that the limit of
//! attempts holds over a restart and for all servers of the database. This module knows no limit.

use sqlx::Row as _;
use sqlx::any::AnyRow;

use crate::auth::sign_ins::{NameDigest, WINDOW_MS, Window};
use crate::store::repositories::SignInFailures;
use crate::store::rows::{number, stored};
use crate::store::{Store, StoreError, Transaction};

const WINDOW: &str = "SELECT began_ms, count FROM sign_in_failures WHERE name_digest = $1";

impl SignInFailures<&Store> {
    /// The latest window of the name, which may be over.
    pub async fn get(self, name: &NameDigest) -> Result<Option<Window>, StoreError> {
        let row = sqlx::query(WINDOW).bind(name.as_str()).fetch_optional(&self.0.reads).await?;
        row.as_ref().map(window).transpose()
    }
}

impl SignInFailures<&mut Transaction> {
    /// The latest window of the name, which may be over.
    pub async fn get(&mut self, name: &NameDigest) -> Result<Option<Window>, StoreError> {
        let row =
            sqlx::query(WINDOW).bind(name.as_str()).fetch_optional(self.0.connection()).await?;
        row.as_ref().map(window).transpose()
    }

    /// Stores the window of the name, in place of an earlier one.
    pub async fn put(&mut self, name: &NameDigest, window: Window) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO sign_in_failures (name_digest, began_ms, count) VALUES ($1, $2, $3)
             ON CONFLICT (name_digest) DO UPDATE
             SET began_ms = excluded.began_ms, count = excluded.count",
        )
        .bind(name.as_str())
        .bind(stored(window.began_ms))
        .bind(stored(window.count))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Deletes the window of the name.
    pub async fn delete(&mut self, name: &NameDigest) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM sign_in_failures WHERE name_digest = $1")
            .bind(name.as_str())
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    /// Deletes the windows that are over.
    pub async fn delete_ended(&mut self, now_ms: u64) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM sign_in_failures WHERE began_ms <= $1 OR began_ms >= $2")
            .bind(stored(now_ms.saturating_sub(WINDOW_MS)))
            .bind(stored(now_ms.saturating_add(WINDOW_MS)))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }
}

fn window(row: &AnyRow) -> Result<Window, StoreError> {
    Ok(Window { began_ms: number(row.try_get("began_ms")?), count: number(row.try_get("count")?) })
}
