//! Blobs that are still needed: parts of a manifest, manifests themselves, and blobs of a package
//! that a robot should have or may get back. References to unneeded blobs are deleted here; other
//! modules delete the bytes.

use std::collections::HashSet;

use sqlx::AssertSqlSafe;
use task_proto::Digest;
use task_proto::desired::{BlobRef, PackageRef};

use crate::store::rows::{groups, id, values};
use crate::store::{Store, StoreError};

impl Store {
    /// Every blob that is needed now. More blobs may be needed by the time the caller has the
    /// result.
    pub async fn needed_blobs(&self) -> Result<HashSet<Digest>, StoreError> {
        let texts: Vec<String> = sqlx::query_scalar(
            "SELECT digest FROM manifests UNION SELECT digest FROM manifest_parts",
        )
        .fetch_all(&self.reads)
        .await?;
        let needed = texts.iter().map(|text| id("manifests.digest", text));
        let mut needed = needed.collect::<Result<HashSet<Digest>, _>>()?;
        needed.extend(self.blobs_in_use().await?);
        Ok(needed)
    }

    /// Those of `candidates` that are unneeded. Repositories drop their references to them; if
    /// there is no such reference, nothing is written. The caller blocks all callers that could
    /// come to rely on such a blob.
    pub async fn forget_unneeded(
        &self,
        candidates: Vec<Digest>,
    ) -> Result<Vec<Digest>, StoreError> {
        if candidates.is_empty() {
            return Ok(candidates);
        }
        let mut needed: HashSet<Digest> = self.blobs_in_use().await?.into_iter().collect();
        for group in groups(&candidates) {
            let listed = values(1, group.len(), &["TEXT"]);
            let mut query = sqlx::query_scalar(AssertSqlSafe(format!(
                "SELECT digest FROM manifests WHERE digest IN ({listed})
                 UNION SELECT digest FROM manifest_parts WHERE digest IN ({listed})"
            )));
            for digest in group {
                query = query.bind(digest.to_string());
            }
            let texts: Vec<String> = query.fetch_all(&self.reads).await?;
            for text in &texts {
                needed.insert(id("manifests.digest", text)?);
            }
        }
        let unneeded: Vec<Digest> =
            candidates.into_iter().filter(|digest| !needed.contains(digest)).collect();
        if unneeded.is_empty() {
            return Ok(unneeded);
        }
        let mut write = self.begin().await?;
        for digest in &unneeded {
            let query = sqlx::query("DELETE FROM repository_blobs WHERE digest = $1")
                .bind(digest.to_string());
            query.execute(write.connection()).await?;
            write.uncount_blob(digest).await?;
        }
        write.commit().await?;
        Ok(unneeded)
    }

    async fn blobs_in_use(&self) -> Result<Vec<Digest>, StoreError> {
        let packages = self.packages_in_use().await?;
        Ok(packages.iter().flat_map(blobs_of).map(|blob| blob.digest).collect())
    }
}

fn blobs_of(package: &PackageRef) -> [BlobRef; 3] {
    [package.manifest, package.config, package.content]
}
