//! The first use of a robot's token, which ends the robot's other tokens. When a fleet connects for
//! the first time, thousands of first uses happen at once. A caller that finds no write in progress
//! writes for all waiting callers, so that they share one commit. Caches of the database are then
//! invalidated once and not thousands of times.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use sqlx::Row as _;
use task_proto::RobotId;
use task_proto::trust::token::Token;
use tokio::sync::oneshot;

use crate::store::repositories::Tokens;
use crate::store::rows::{id, stored};
use crate::store::{Store, StoreError, Transaction};

/// The most first uses of one write: others wait for that write as well.
const MAX_BATCH: usize = 256;

/// The queue of first uses to be written. Clones share one queue.
#[derive(Debug, Clone, Default)]
pub(in crate::store) struct FirstUses {
    waiting: Arc<Mutex<Vec<QueuedUse>>>,
    write_lock: Arc<tokio::sync::Mutex<()>>,
}

#[derive(Debug)]
struct QueuedUse {
    token_id: String,
    now_ms: u64,
    reply: oneshot::Sender<Result<bool, StoreError>>,
}

impl FirstUses {
    fn waiting(&self) -> MutexGuard<'_, Vec<QueuedUse>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next batch of the queue; `None` if the queue is empty.
    fn next_batch(&self) -> Option<Vec<QueuedUse>> {
        let mut waiting = self.waiting();
        let rest = waiting.len().min(MAX_BATCH);
        let batch: Vec<QueuedUse> = waiting.drain(..rest).collect();
        (!batch.is_empty()).then_some(batch)
    }
}

impl Tokens<&Store> {
    /// Marks a robot's token as the one in use; false if the token is already used or ended. The
    /// write runs to its end even if the caller does not wait for it.
    pub(in crate::store) async fn use_first(
        self,
        token: &Token,
        now_ms: u64,
    ) -> Result<bool, StoreError> {
        let (reply, mut receiver) = oneshot::channel();
        self.0.first_uses.waiting().push(QueuedUse { token_id: token.id(), now_ms, reply });
        let lost = |_| Err(StoreError::Statement(sqlx::Error::WorkerCrashed));
        tokio::select! {
            biased;
            used = &mut receiver => return used.unwrap_or_else(lost),
            write_lock = self.0.first_uses.write_lock.clone().lock_owned() => {
                let store = self.0.clone();
                tokio::spawn(async move {
                    let _write_lock = write_lock;
                    store.tokens().use_queued().await;
                });
            }
        }
        receiver.await.unwrap_or_else(lost)
    }

    async fn use_queued(self) {
        while let Some(batch) = self.0.first_uses.next_batch() {
            match self.use_batch(&batch).await {
                Ok(used) => {
                    for (queued, used) in batch.into_iter().zip(used) {
                        // A caller that has gone away does not need the result.
                        let _ = queued.reply.send(Ok(used));
                    }
                }
                Err(error) => {
                    let error = Arc::new(error);
                    for queued in batch {
                        let _ = queued.reply.send(Err(StoreError::Batch(error.clone())));
                    }
                }
            }
        }
    }

    async fn use_batch(self, batch: &[QueuedUse]) -> Result<Vec<bool>, StoreError> {
        let mut write = self.0.begin().await?;
        let mut used = Vec::with_capacity(batch.len());
        for queued in batch {
            used.push(write.tokens().use_first(&queued.token_id, queued.now_ms).await?);
        }
        write.commit().await?;
        Ok(used)
    }
}

impl Tokens<&mut Transaction> {
    async fn use_first(&mut self, token_id: &str, now_ms: u64) -> Result<bool, StoreError> {
        let row = sqlx::query(
            "UPDATE tokens SET used_at_ms = $2 WHERE id = $1 AND used_at_ms IS NULL AND revoked_at_ms IS NULL
             RETURNING robot_id, made_by, number",
        )
        .bind(token_id)
        .bind(stored(now_ms))
        .fetch_optional(self.0.connection())
        .await?;
        let Some(row) = row else { return Ok(false) };
        let robot: RobotId = id("tokens.robot_id", row.try_get("robot_id")?)?;
        let (made_by, number): (Option<String>, i64) =
            (row.try_get("made_by")?, row.try_get("number")?);
        sqlx::query(
            "UPDATE tokens SET revoked_at_ms = $3
             WHERE robot_id = $1 AND kind = 'robot' AND id <> $2 AND revoked_at_ms IS NULL",
        )
        .bind(robot.as_str())
        .bind(token_id)
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        sqlx::query("UPDATE robots SET token_number = $2 WHERE id = $1")
            .bind(robot.as_str())
            .bind(number)
            .execute(self.0.connection())
            .await?;
        if made_by.is_some() {
            self.0.robots().forget_report(&robot).await?;
        }
        Ok(true)
    }
}
