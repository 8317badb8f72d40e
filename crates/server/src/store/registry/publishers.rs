//! Signed documents of publishers: envelopes about packages, and lists of publishers. The registry
//! holds the bytes; this module selects the robots that are told of each. Nothing is verified here.

use std::collections::{BTreeSet, HashMap};

use sqlx::any::AnyRow;
use sqlx::{AssertSqlSafe, Row as _};
use task_proto::desired::{BlobRef, Evidence, SignatureRef};
use task_proto::packages::publisher::{MAX_LISTS, MAX_SIGNATURES};
use task_proto::{Digest, RepositoryName, RobotId};

use crate::store::repositories::Publishers;
use crate::store::{DesiredTasks, Store, StoreError, Transaction, rows};

/// The signed document of a manifest, in addition to the manifest itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SignedDocument {
    /// An envelope about the package with this manifest.
    Signature { package: Digest, envelope: BlobRef },
    /// A list of publishers.
    List {
        /// The version of the list.
        version: u64,
        envelope: BlobRef,
        /// Whether the keepers differ from those of the previous list.
        changes_keepers: bool,
    },
}

impl Publishers<&Store> {
    /// The list of publishers with this version, or the newest.
    pub async fn list(self, version: Option<u64>) -> Result<Option<BlobRef>, StoreError> {
        let sql = "SELECT envelope, size FROM publisher_lists WHERE version = $1 OR $1 < 0 ORDER BY version DESC LIMIT 1";
        let row = sqlx::query(sql)
            .bind(version.map_or(-1, rows::stored))
            .fetch_optional(&self.0.reads)
            .await?;
        row.as_ref().map(|row| envelope("publisher_lists.envelope", row)).transpose()
    }

    /// Whether `robot` may have to verify the blob: a list of publishers, or a signature of a
    /// package in the evidence of the robot's desired state.
    pub async fn is_evidence_for(self, robot: &RobotId, blob: &Digest) -> Result<bool, StoreError> {
        let packages: Vec<String> = sqlx::query_scalar(
            "SELECT package FROM signatures WHERE envelope = $1
             UNION ALL SELECT CAST('' AS TEXT) FROM publisher_lists WHERE envelope = $1",
        )
        .bind(blob.to_string())
        .fetch_all(&self.0.reads)
        .await?;
        if packages.iter().any(String::is_empty) {
            return Ok(true);
        }
        if packages.is_empty() {
            return Ok(false);
        }
        let wanted = self.0.robots().desired_tasks(std::slice::from_ref(robot)).await?;
        let mut signed = wanted.iter().flat_map(|wanted| &wanted.evidence.signatures);
        Ok(signed.any(|signature| packages.contains(&signature.manifest.to_string())))
    }

    /// Adds the signatures to the desired state of robots. `proven` are the manifests of packages
    /// that the robots may go back to. The documents about the ordered packages are sent along if
    /// any blobs are.
    pub(in crate::store) async fn add_evidence(
        self,
        found: &mut [DesiredTasks],
        proven: &HashMap<RobotId, Vec<Digest>>,
    ) -> Result<(), StoreError> {
        let lists = self.lists().await?;
        let ordered =
            found.iter().flat_map(|found| &found.tasks).map(|task| task.package.manifest.digest);
        let manifests = ordered.chain(proven.values().flatten().copied()).collect();
        let signatures = self.signatures(&manifests).await?;
        let signatures_of = |manifest: Digest| {
            let envelopes = signatures.get(&manifest).into_iter().flatten();
            envelopes.map(move |envelope| SignatureRef { manifest, envelope: *envelope })
        };
        for wanted in found {
            let mut evidence = Evidence { lists: lists.clone(), signatures: Vec::new() };
            for task in &wanted.tasks {
                evidence.signatures.extend(signatures_of(task.package.manifest.digest));
            }
            if !wanted.bundled_blobs.is_empty() {
                // The evidence goes first: without it the other blobs are of no use.
                wanted.bundled_blobs.splice(0..0, evidence.blobs());
            }
            for manifest in proven.get(&wanted.robot).into_iter().flatten() {
                let is_new =
                    evidence.signatures.iter().all(|signature| signature.manifest != *manifest);
                evidence.signatures.extend(signatures_of(*manifest).filter(|_| is_new));
            }
            wanted.evidence = evidence;
        }
        Ok(())
    }

    /// The lists that a robot may need to reach the newest, from any older one.
    async fn lists(self) -> Result<Vec<BlobRef>, StoreError> {
        if let Some(lists) = self.0.auth_cache.lists() {
            return Ok(lists);
        }
        let epoch = self.0.auth_cache.epoch();
        let rows = sqlx::query(
            "SELECT envelope, size FROM publisher_lists
             WHERE changes_keepers = 1 OR version = (SELECT MAX(version) FROM publisher_lists)
             ORDER BY version DESC LIMIT $1",
        )
        .bind(rows::stored(MAX_LISTS as u64))
        .fetch_all(&self.0.reads)
        .await?;
        let lists = rows.iter().rev().map(|row| envelope("publisher_lists.envelope", row));
        let lists = lists.collect::<Result<Vec<_>, _>>()?;
        self.0.auth_cache.cache_lists(epoch, &lists);
        Ok(lists)
    }

    /// The first envelopes about each of these packages.
    async fn signatures(
        self,
        manifests: &BTreeSet<Digest>,
    ) -> Result<HashMap<Digest, Vec<BlobRef>>, StoreError> {
        let epoch = self.0.auth_cache.epoch();
        let mut signatures: HashMap<Digest, Vec<BlobRef>> = HashMap::new();
        let mut unknown = Vec::new();
        for manifest in manifests {
            match self.0.auth_cache.signatures(manifest) {
                Some(known) => drop(signatures.insert(*manifest, known)),
                None => unknown.push(*manifest),
            }
        }
        for group in rows::groups(&unknown) {
            let mut query = sqlx::query(AssertSqlSafe(format!(
                "SELECT package, envelope, size FROM signatures WHERE package IN ({}) ORDER BY pushed_at_ms, manifest",
                rows::values(1, group.len(), &["TEXT"])
            )));
            for manifest in group {
                query = query.bind(manifest.to_string());
            }
            for row in query.fetch_all(&self.0.reads).await? {
                let package: Digest = rows::id("signatures.package", row.try_get("package")?)?;
                let of_package = signatures.entry(package).or_default();
                let found = envelope("signatures.envelope", &row)?;
                if of_package.len() < MAX_SIGNATURES && !of_package.contains(&found) {
                    of_package.push(found);
                }
            }
        }
        for manifest in unknown {
            self.0.auth_cache.cache_signatures(
                epoch,
                manifest,
                signatures.get(&manifest).cloned().unwrap_or_default(),
            );
        }
        Ok(signatures)
    }
}

impl Publishers<&mut Transaction> {
    /// Records a signed document. Returns false for a list that is not newer than all stored ones.
    pub(in crate::store) async fn insert_document(
        &mut self,
        repository: &RepositoryName,
        manifest: &Digest,
        document: &SignedDocument,
        now_ms: u64,
    ) -> Result<bool, StoreError> {
        match document {
            SignedDocument::Signature { package, envelope } => {
                sqlx::query(
                    "INSERT INTO signatures (repository, manifest, package, envelope, size, pushed_at_ms)
                     VALUES ($1, $2, $3, $4, $5, $6) ON CONFLICT DO NOTHING",
                )
                .bind(repository.as_str())
                .bind(manifest.to_string())
                .bind(package.to_string())
                .bind(envelope.digest.to_string())
                .bind(rows::stored(envelope.size))
                .bind(rows::stored(now_ms))
                .execute(self.0.connection())
                .await?;
                Ok(true)
            }
            SignedDocument::List { version, envelope, changes_keepers } => {
                let known: Option<String> = sqlx::query_scalar(
                    "SELECT envelope FROM publisher_lists WHERE version >= $1 ORDER BY version LIMIT 1",
                )
                .bind(rows::stored(*version))
                .fetch_optional(self.0.connection())
                .await?;
                if let Some(known) = known {
                    return Ok(known == envelope.digest.to_string());
                }
                sqlx::query(
                    "INSERT INTO publisher_lists (version, manifest, envelope, size, changes_keepers)
                     VALUES ($1, $2, $3, $4, $5)",
                )
                .bind(rows::stored(*version))
                .bind(manifest.to_string())
                .bind(envelope.digest.to_string())
                .bind(rows::stored(envelope.size))
                .bind(i64::from(*changes_keepers))
                .execute(self.0.connection())
                .await?;
                Ok(true)
            }
        }
    }

    /// Deletes the record of a manifest's signed document.
    pub(in crate::store) async fn delete_document(
        &mut self,
        repository: &RepositoryName,
        manifest: &Digest,
    ) -> Result<(), StoreError> {
        sqlx::query("DELETE FROM signatures WHERE repository = $1 AND manifest = $2")
            .bind(repository.as_str())
            .bind(manifest.to_string())
            .execute(self.0.connection())
            .await?;
        if repository.as_str() == task_proto::packages::publisher::LIST_REPOSITORY {
            let delete = sqlx::query("DELETE FROM publisher_lists WHERE manifest = $1")
                .bind(manifest.to_string());
            delete.execute(self.0.connection()).await?;
        }
        Ok(())
    }
}

fn envelope(column: &'static str, row: &AnyRow) -> Result<BlobRef, StoreError> {
    let digest = rows::id(column, row.try_get("envelope")?)?;
    Ok(BlobRef { digest, size: rows::number(row.try_get("size")?) })
}
