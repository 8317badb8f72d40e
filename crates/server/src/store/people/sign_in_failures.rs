//! Wrong passwords of accounts: one window for each account, so that the limit of attempts holds
//! over a restart and for all servers of the database. This module knows no limit.

use sqlx::Row as _;
use sqlx::any::AnyRow;
use task_proto::UserName;

use crate::auth::sign_ins::Window;
use crate::store::repositories::SignInFailures;
use crate::store::rows::{number, stored};
use crate::store::{Store, StoreError, Transaction};

const WINDOW: &str = "SELECT began_ms, count FROM sign_in_failures WHERE user_name = $1";

impl SignInFailures<&Store> {
    /// The latest window of the account, which may be over.
    pub async fn get(self, user: &UserName) -> Result<Option<Window>, StoreError> {
        let row = sqlx::query(WINDOW).bind(user.as_str()).fetch_optional(&self.0.reads).await?;
        row.as_ref().map(window).transpose()
    }
}

impl SignInFailures<&mut Transaction> {
    /// The latest window of the account, which may be over.
    pub async fn get(&mut self, user: &UserName) -> Result<Option<Window>, StoreError> {
        let row =
            sqlx::query(WINDOW).bind(user.as_str()).fetch_optional(self.0.connection()).await?;
        row.as_ref().map(window).transpose()
    }

    /// Stores the window of the account, in place of an earlier one.
    pub async fn put(&mut self, user: &UserName, window: Window) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO sign_in_failures (user_name, began_ms, count) VALUES ($1, $2, $3)
             ON CONFLICT (user_name) DO UPDATE
             SET began_ms = excluded.began_ms, count = excluded.count",
        )
        .bind(user.as_str())
        .bind(stored(window.began_ms))
        .bind(stored(window.count))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Deletes the windows that began before `before_ms`.
    pub async fn delete_before(&mut self, before_ms: u64) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM sign_in_failures WHERE began_ms < $1")
            .bind(stored(before_ms))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }
}

fn window(row: &AnyRow) -> Result<Window, StoreError> {
    Ok(Window { began_ms: number(row.try_get("began_ms")?), count: number(row.try_get("count")?) })
}
