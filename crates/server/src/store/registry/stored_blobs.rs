//! The objects of the servers' common store, by the blob that each of them holds. A blob is stored
//! if it has a row here; other modules write and delete the objects.

use std::collections::HashSet;

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::Digest;

use crate::store::repositories::StoredBlobs;
use crate::store::rows::{groups, id, number, stored, values};
use crate::store::{Store, StoreError};

/// A blob, and the object that holds its bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredBlob {
    pub digest: Digest,
    pub bytes: u64,
    /// The object's name, which no other object ever had.
    pub object: String,
}

impl StoredBlobs<&Store> {
    pub async fn find(self, digest: &Digest) -> Result<Option<StoredBlob>, StoreError> {
        let found: Option<(i64, String)> =
            sqlx::query_as("SELECT bytes, object FROM blobs WHERE digest = $1")
                .bind(digest.to_string())
                .fetch_optional(&self.0.reads)
                .await?;
        Ok(found.map(|(bytes, object)| StoredBlob {
            digest: *digest,
            bytes: number(bytes),
            object,
        }))
    }

    /// Records that a pusher relies on the blob; false if the blob is absent.
    pub async fn touch(self, digest: &Digest, now_ms: u64) -> Result<bool, StoreError> {
        let mut write = self.0.begin_without_auth_invalidation().await?;
        let sql = "UPDATE blobs SET touched_ms = $2 WHERE digest = $1";
        let query = sqlx::query(sql).bind(digest.to_string()).bind(stored(now_ms));
        let touched = query.execute(write.connection()).await?.rows_affected() > 0;
        write.commit().await?;
        Ok(touched)
    }

    /// Records a blob whose object is complete, as of a pusher's request. Returns the name of the
    /// object that holds the blob: the blob's earlier one, if another pusher was first.
    pub async fn insert(self, blob: &StoredBlob, now_ms: u64) -> Result<String, StoreError> {
        let mut write = self.0.begin_without_auth_invalidation().await?;
        let object: String = sqlx::query_scalar(
            "INSERT INTO blobs (digest, bytes, object, touched_ms) VALUES ($1, $2, $3, $4)
             ON CONFLICT (digest) DO UPDATE SET touched_ms = excluded.touched_ms RETURNING object",
        )
        .bind(blob.digest.to_string())
        .bind(stored(blob.bytes))
        .bind(blob.object.as_str())
        .bind(stored(now_ms))
        .fetch_one(write.connection())
        .await?;
        write.commit().await?;
        Ok(object)
    }

    /// Removes a blob whose object does not hold its bytes, so that a push stores it again. False
    /// if another object holds the blob by now.
    pub async fn remove_damaged(self, blob: &StoredBlob) -> Result<bool, StoreError> {
        let mut write = self.0.begin_without_auth_invalidation().await?;
        let query = sqlx::query("DELETE FROM blobs WHERE digest = $1 AND object = $2")
            .bind(blob.digest.to_string())
            .bind(blob.object.as_str());
        let removed = query.execute(write.connection()).await?.rows_affected() > 0;
        write.commit().await?;
        Ok(removed)
    }

    /// The blobs last touched before `before_ms`.
    pub async fn untouched_since(self, before_ms: u64) -> Result<Vec<Digest>, StoreError> {
        let texts: Vec<String> =
            sqlx::query_scalar("SELECT digest FROM blobs WHERE touched_ms < $1")
                .bind(stored(before_ms))
                .fetch_all(&self.0.reads)
                .await?;
        texts.iter().map(|text| id("blobs.digest", text)).collect()
    }

    /// The total size of all blobs, in bytes.
    pub async fn used_bytes(self) -> Result<u64, StoreError> {
        let bytes: i64 =
            sqlx::query_scalar("SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM blobs")
                .fetch_one(&self.0.reads)
                .await?;
        Ok(number(bytes))
    }

    /// Removes those of `candidates` that are unneeded and were last touched before `before_ms`, and
    /// the repositories' references to them. Returns their objects, which nothing refers to any
    /// more. Nothing else is written meanwhile, so a push either finds a blob and keeps it, or finds
    /// it absent.
    pub async fn remove_unneeded(
        self,
        candidates: &[Digest],
        before_ms: u64,
    ) -> Result<Vec<StoredBlob>, StoreError> {
        let mut write = self.0.begin().await?;
        // Read on another connection: what is committed can't change during this write.
        let unneeded = self.0.blobs().unreferenced(candidates.to_vec()).await?;
        let mut removed = Vec::new();
        for digest in unneeded {
            let sql = "DELETE FROM blobs WHERE digest = $1 AND touched_ms < $2
                       RETURNING bytes, object";
            let row = sqlx::query(sql)
                .bind(digest.to_string())
                .bind(stored(before_ms))
                .fetch_optional(write.connection())
                .await?;
            let Some(row) = row else { continue };
            write.blobs().unlink_everywhere(&digest).await?;
            let (bytes, object) = (number(row.try_get("bytes")?), row.try_get("object")?);
            removed.push(StoredBlob { digest, bytes, object });
        }
        if !removed.is_empty() {
            write.commit().await?;
        }
        Ok(removed)
    }

    /// Those of `objects` that hold no blob.
    pub async fn unknown_objects(self, objects: Vec<String>) -> Result<Vec<String>, StoreError> {
        let mut known = HashSet::new();
        for group in groups(&objects) {
            let listed = values(1, group.len(), &["TEXT"]);
            let sql = format!("SELECT object FROM blobs WHERE object IN ({listed})");
            let mut query = sqlx::query_scalar(AssertSqlSafe(sql));
            for object in group {
                query = query.bind(object.as_str());
            }
            let found: Vec<String> = query.fetch_all(&self.0.reads).await?;
            known.extend(found);
        }
        Ok(objects.into_iter().filter(|object| !known.contains(object)).collect())
    }

    pub async fn has_any(self) -> Result<bool, StoreError> {
        let query = sqlx::query("SELECT digest FROM blobs LIMIT 1");
        Ok(query.fetch_optional(&self.0.reads).await?.is_some())
    }

    /// The name of the store that holds the objects; `None` before the first use of a store.
    pub async fn store_name(self) -> Result<Option<String>, StoreError> {
        let query = sqlx::query_scalar("SELECT name FROM blob_store WHERE id = 1");
        Ok(query.fetch_optional(&self.0.reads).await?)
    }

    /// Records the name of the store. Returns the recorded name: an earlier one, if there is one.
    pub async fn name_store(self, name: &str) -> Result<String, StoreError> {
        let mut write = self.0.begin_without_auth_invalidation().await?;
        sqlx::query("INSERT INTO blob_store (id, name) VALUES (1, $1) ON CONFLICT (id) DO NOTHING")
            .bind(name)
            .execute(write.connection())
            .await?;
        let recorded = sqlx::query_scalar("SELECT name FROM blob_store WHERE id = 1")
            .fetch_one(write.connection())
            .await?;
        write.commit().await?;
        Ok(recorded)
    }
}
