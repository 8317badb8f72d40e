//! The disk usage of each robot: the bytes of blobs and manifests in its repositories, from their
//! arrival until they are collected. This module knows no limit.

use std::collections::BTreeMap;

use task_proto::desired::BlobRef;
use task_proto::packages::output::{OutputSet, owner};
use task_proto::{Digest, RepositoryName, RobotId};

use crate::store::repositories::RobotBlobs;
use crate::store::{Store, StoreError, Transaction, rows};

/// The size that the smallest file counts: storing a file costs more than its bytes.
const MIN_FILE_BYTES: u64 = 64 * 1024;

/// The disk usage of one output with its manifest and config, in bytes. Small files count as
/// [`MIN_FILE_BYTES`] each.
pub fn disk_usage(output: &OutputSet) -> u64 {
    let blobs: BTreeMap<Digest, u64> =
        output.files.iter().map(|file| (file.blob.digest, file.blob.size)).collect();
    blobs
        .values()
        .fold(2 * MIN_FILE_BYTES, |sum, size| sum.saturating_add((*size).max(MIN_FILE_BYTES)))
}

impl RobotBlobs<&Store> {
    /// Adds a manifest or a blob to its robot's disk usage, if the repository is a robot's.
    pub async fn count(
        self,
        repository: &RepositoryName,
        blob: &BlobRef,
    ) -> Result<(), StoreError> {
        if owner(repository).is_none() {
            return Ok(());
        }
        let mut write = self.0.begin().await?;
        write.robot_blobs().count(repository, blob).await?;
        write.commit().await
    }

    /// The disk usage of a robot's uploads, in bytes. Small files count as [`MIN_FILE_BYTES`] each.
    pub async fn disk_usage(self, robot: &RobotId) -> Result<u64, StoreError> {
        let bytes: Option<i64> =
            sqlx::query_scalar("SELECT bytes FROM robot_bytes WHERE robot_id = $1")
                .bind(robot.as_str())
                .fetch_optional(&self.0.reads)
                .await?;
        Ok(rows::number(bytes.unwrap_or(0)))
    }

    /// Blobs of deleted manifests of robots, except those that a known push may be about to list.
    /// Manifests of others may still need them.
    pub async fn dropped(self) -> Result<Vec<Digest>, StoreError> {
        let texts: Vec<String> = sqlx::query_scalar(
            "SELECT DISTINCT d.digest FROM robot_blobs d WHERE d.dropped = 1
             AND NOT EXISTS (SELECT 1 FROM robot_blobs b WHERE b.digest = d.digest AND b.dropped = 0)
             AND NOT EXISTS (SELECT 1 FROM repository_blobs r
                             WHERE r.digest = d.digest AND r.repository NOT LIKE 'outputs/%')",
        )
        .fetch_all(&self.0.reads)
        .await?;
        texts.iter().map(|text| rows::id("robot_blobs.digest", text)).collect()
    }
}

impl RobotBlobs<&mut Transaction> {
    /// Records that a manifest is about to be deleted, if the repository is a robot's.
    pub(in crate::store) async fn mark_dropped(
        &mut self,
        repository: &RepositoryName,
        manifest: &Digest,
    ) -> Result<(), StoreError> {
        let Some((robot, _)) = owner(repository) else { return Ok(()) };
        sqlx::query(
            "UPDATE robot_blobs SET dropped = 1 WHERE robot_id = $1 AND (digest = $2 OR digest IN
                 (SELECT digest FROM manifest_parts WHERE repository = $3 AND manifest = $2))",
        )
        .bind(robot.as_str())
        .bind(manifest.to_string())
        .bind(repository.as_str())
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Adds a manifest or a blob to its robot's disk usage, if the repository is a robot's. A blob
    /// stays counted until it is collected. Returns whether the blob was counted already.
    pub(in crate::store) async fn count(
        &mut self,
        repository: &RepositoryName,
        blob: &BlobRef,
    ) -> Result<bool, StoreError> {
        let Some((robot, _)) = owner(repository) else { return Ok(false) };
        let known =
            sqlx::query("UPDATE robot_blobs SET dropped = 0 WHERE robot_id = $1 AND digest = $2")
                .bind(robot.as_str())
                .bind(blob.digest.to_string())
                .execute(self.0.connection())
                .await?;
        if known.rows_affected() > 0 {
            return Ok(true);
        }
        let bytes = rows::stored(blob.size.max(MIN_FILE_BYTES));
        sqlx::query("INSERT INTO robot_blobs (robot_id, digest, bytes) VALUES ($1, $2, $3)")
            .bind(robot.as_str())
            .bind(blob.digest.to_string())
            .bind(bytes)
            .execute(self.0.connection())
            .await?;
        self.add_to_robot(robot.as_str(), bytes).await?;
        Ok(false)
    }

    /// Counts that one repository of a robot got a blob which another of its repositories has.
    pub(in crate::store) async fn count_link(
        &mut self,
        repository: &RepositoryName,
        blob: &BlobRef,
    ) -> Result<(), StoreError> {
        let Some((robot, _)) = owner(repository) else { return Ok(()) };
        let bytes = rows::stored(MIN_FILE_BYTES);
        sqlx::query(
            "UPDATE robot_blobs SET bytes = bytes + $1 WHERE robot_id = $2 AND digest = $3",
        )
        .bind(bytes)
        .bind(robot.as_str())
        .bind(blob.digest.to_string())
        .execute(self.0.connection())
        .await?;
        self.add_to_robot(robot.as_str(), bytes).await
    }

    /// Removes a collected blob from the disk usage.
    pub(in crate::store) async fn uncount(&mut self, digest: &Digest) -> Result<(), StoreError> {
        let counted: Vec<(String, i64)> =
            sqlx::query_as("DELETE FROM robot_blobs WHERE digest = $1 RETURNING robot_id, bytes")
                .bind(digest.to_string())
                .fetch_all(self.0.connection())
                .await?;
        for (robot, bytes) in counted {
            self.add_to_robot(&robot, -bytes).await?;
        }
        Ok(())
    }

    async fn add_to_robot(&mut self, robot: &str, bytes: i64) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO robot_bytes (robot_id, bytes) VALUES ($1, $2)
             ON CONFLICT (robot_id) DO UPDATE SET bytes = robot_bytes.bytes + excluded.bytes",
        )
        .bind(robot)
        .bind(bytes)
        .execute(self.0.connection())
        .await?;
        Ok(())
    }
}
