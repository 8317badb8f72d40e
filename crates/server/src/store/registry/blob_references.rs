//! Blobs that are still needed: parts of a manifest, manifests themselves, and blobs of a package
//! that a robot should have or may get back. References to unneeded blobs are deleted here; other
//! modules delete the bytes.

use std::collections::HashSet;

use sqlx::AssertSqlSafe;
use task_proto::Digest;
use task_proto::desired::{BlobRef, PackageRef};

use crate::store::repositories::Blobs;
use crate::store::rows::{groups, id, values};
use crate::store::{Store, StoreError, Transaction};

impl Blobs<&Store> {
    /// Every blob that is needed now. More blobs may be needed by the time the caller has the
    /// result.
    pub async fn referenced(self) -> Result<HashSet<Digest>, StoreError> {
        let texts: Vec<String> = sqlx::query_scalar(
            "SELECT digest FROM manifests UNION SELECT digest FROM manifest_parts",
        )
        .fetch_all(&self.0.reads)
        .await?;
        let referenced = texts.iter().map(|text| id("manifests.digest", text));
        let mut referenced = referenced.collect::<Result<HashSet<Digest>, _>>()?;
        referenced.extend(self.in_use().await?);
        Ok(referenced)
    }

    /// Those of `candidates` that are unneeded. Repositories drop their references to them; if
    /// there is no such reference, nothing is written. The caller blocks all callers that could
    /// come to rely on such a blob.
    pub async fn drop_unreferenced(
        self,
        candidates: Vec<Digest>,
    ) -> Result<Vec<Digest>, StoreError> {
        let unreferenced = self.unreferenced(candidates).await?;
        if unreferenced.is_empty() {
            return Ok(unreferenced);
        }
        let mut write = self.0.begin().await?;
        for digest in &unreferenced {
            write.blobs().unlink_everywhere(digest).await?;
        }
        write.commit().await?;
        Ok(unreferenced)
    }

    /// Those of `candidates` that are unneeded now.
    pub(in crate::store) async fn unreferenced(
        self,
        candidates: Vec<Digest>,
    ) -> Result<Vec<Digest>, StoreError> {
        if candidates.is_empty() {
            return Ok(candidates);
        }
        let mut referenced: HashSet<Digest> = self.in_use().await?.into_iter().collect();
        for group in groups(&candidates) {
            let listed = values(1, group.len(), &["TEXT"]);
            let mut query = sqlx::query_scalar(AssertSqlSafe(format!(
                "SELECT digest FROM manifests WHERE digest IN ({listed})
                 UNION SELECT digest FROM manifest_parts WHERE digest IN ({listed})"
            )));
            for digest in group {
                query = query.bind(digest.to_string());
            }
            let texts: Vec<String> = query.fetch_all(&self.0.reads).await?;
            for text in &texts {
                referenced.insert(id("manifests.digest", text)?);
            }
        }
        Ok(candidates.into_iter().filter(|digest| !referenced.contains(digest)).collect())
    }

    async fn in_use(self) -> Result<Vec<Digest>, StoreError> {
        let packages = self.0.deployments().packages_in_use().await?;
        Ok(packages.iter().flat_map(blobs_of).map(|blob| blob.digest).collect())
    }
}

impl Blobs<&mut Transaction> {
    /// Removes the blob from all repositories, and from the disk usage of robots.
    pub(in crate::store) async fn unlink_everywhere(
        &mut self,
        digest: &Digest,
    ) -> Result<(), StoreError> {
        let query =
            sqlx::query("DELETE FROM repository_blobs WHERE digest = $1").bind(digest.to_string());
        query.execute(self.0.connection()).await?;
        self.0.robot_blobs().uncount(digest).await
    }
}

fn blobs_of(package: &PackageRef) -> [BlobRef; 3] {
    [package.manifest, package.config, package.content]
}
