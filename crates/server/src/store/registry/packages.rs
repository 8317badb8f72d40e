//! Repositories, manifests, tags and task packages: the registry's records of the bytes in the blob
//! store. This module never touches those bytes, and never decides whether a manifest is valid.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use sqlx::Row as _;
use sqlx::any::AnyRow;
use task_proto::api::PackageView;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::packages::manifest::TaskManifest;
use task_proto::{Digest, RepositoryName, Tag, TaskName};

use crate::store::repositories::{Blobs, Manifests, Packages, Tags};
use crate::store::{
    AuditEvent, NewOutput, PackageUsers, SignedDocument, Store, StoreError, Transaction, rows,
};

/// A manifest's reference inside its repository.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reference {
    /// A tag, which may move.
    Tag(Tag),
    /// The digest of the manifest.
    Digest(Digest),
}

/// A manifest in a repository.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredManifest {
    pub digest: Digest,
    /// Its size in bytes.
    pub size: u64,
    /// The content type given by the push.
    pub media_type: String,
}

/// A manifest to be stored, with its parsed facts.
#[derive(Debug, Clone)]
pub struct NewManifest {
    pub manifest: StoredManifest,
    /// The artifact type, as shown in a list of referrers.
    pub artifact_type: Option<String>,
    /// The annotations, as shown in a list of referrers.
    pub annotations: BTreeMap<String, String>,
    /// The manifest that this one refers to: any digest, stored here or not.
    pub subject: Option<String>,
    /// The blobs and manifests that this manifest consists of.
    pub parts: Vec<Digest>,
    /// The tags to point to the manifest.
    pub tags: Vec<Tag>,
    /// Whether the package may take its version from another one, which is outdated by that.
    pub takes_version: bool,
    /// The package and its task manifest, if this is a task package.
    pub package: Option<(PackageRef, TaskManifest)>,
    /// The output, if this is the output of a run.
    pub output: Option<NewOutput>,
    /// The signed document, if publishers have signed this.
    pub document: Option<SignedDocument>,
}

/// The outcome of storing a manifest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PutManifest {
    /// The manifest is stored.
    Stored,
    /// Not stored: this is a package, and this other one has its version.
    VersionTaken(Digest),
    /// Not stored: these parts are not in the repository.
    PartsMissing(Vec<Digest>),
    /// Not stored: this is a list of publishers, and a stored one has the same version or a later
    /// one.
    Outdated,
    /// Not stored: this tag points to a package in use by robots outside the person's scope.
    TagInUse(Tag, PackageUsers),
}

impl Manifests<&Store> {
    /// Stores a manifest and points its tags to it, if all its parts are in the repository. A
    /// `event` is recorded in the audit log in the same write.
    pub async fn put(
        self,
        repository: &RepositoryName,
        new: &NewManifest,
        event: Option<&AuditEvent>,
        now_ms: u64,
    ) -> Result<PutManifest, StoreError> {
        let mut write = self.0.begin().await?;
        let mut missing = Vec::new();
        for part in &new.parts {
            if !write.manifests().repository_holds(repository, part).await? {
                missing.push(*part);
            }
        }
        if !missing.is_empty() {
            return Ok(PutManifest::PartsMissing(missing));
        }
        if let Some(document) = &new.document
            && !write
                .publishers()
                .insert_document(repository, &new.manifest.digest, document, now_ms)
                .await?
        {
            return Ok(PutManifest::Outdated);
        }
        // A package stored for a single order is addressed by its digest, and takes no version.
        if let Some((package, _)) = new.package.as_ref().filter(|_| !new.tags.is_empty())
            && let Some(other) = write.packages().with_version(package).await?
        {
            if !new.takes_version {
                return Ok(PutManifest::VersionTaken(other));
            }
            if new.tags.iter().any(|tag| tag.as_str() == package.version.as_str()) {
                write.packages().replace(package, &other).await?;
            }
        }
        write.manifests().insert(repository, new, now_ms).await?;
        for tag in &new.tags {
            if let Some(users) = write
                .packages()
                .users_blocking_tag_move(repository, tag, Some(&new.manifest.digest), event)
                .await?
            {
                return Ok(PutManifest::TagInUse(tag.clone(), users));
            }
            write.tags().point(repository, tag, &new.manifest.digest).await?;
        }
        if let Some((package, task_manifest)) = &new.package {
            write.packages().insert(package, task_manifest, now_ms).await?;
        }
        if let Some(output) = &new.output {
            for (repository, surplus) in
                write.outputs().insert(repository, &new.manifest.digest, output, now_ms).await?
            {
                write.manifests().delete(&repository, &surplus).await?;
            }
        }
        write.commit_with_audit(event, now_ms).await?;
        Ok(PutManifest::Stored)
    }

    /// Reads a manifest by tag or digest.
    pub async fn get(
        self,
        repository: &RepositoryName,
        reference: &Reference,
    ) -> Result<Option<StoredManifest>, StoreError> {
        let query = match reference {
            Reference::Digest(digest) => {
                sqlx::query("SELECT digest, size, media_type FROM manifests WHERE repository = $1 AND digest = $2")
                    .bind(repository.as_str())
                    .bind(digest.to_string())
            }
            Reference::Tag(tag) => sqlx::query(
                "SELECT m.digest, m.size, m.media_type FROM tags t
                 JOIN manifests m ON m.repository = t.repository AND m.digest = t.manifest
                 WHERE t.repository = $1 AND t.tag = $2",
            )
            .bind(repository.as_str())
            .bind(tag.as_str()),
        };
        let row = query.fetch_optional(&self.0.reads).await?;
        row.map(|row| {
            Ok(StoredManifest {
                digest: rows::id("manifests.digest", row.try_get("digest")?)?,
                size: rows::number(row.try_get("size")?),
                media_type: row.try_get("media_type")?,
            })
        })
        .transpose()
    }
}

impl Tags<&Store> {
    /// A repository's tags in byte order; `None` if there is no such repository.
    pub async fn list(self, repository: &RepositoryName) -> Result<Option<Vec<Tag>>, StoreError> {
        let known: Option<i64> = sqlx::query_scalar(
            "SELECT CAST(1 AS BIGINT) WHERE EXISTS (SELECT 1 FROM manifests WHERE repository = $1)
             OR EXISTS (SELECT 1 FROM repository_blobs WHERE repository = $1)",
        )
        .bind(repository.as_str())
        .fetch_optional(&self.0.reads)
        .await?;
        if known.is_none() {
            return Ok(None);
        }
        let names: Vec<String> = sqlx::query_scalar("SELECT tag FROM tags WHERE repository = $1")
            .bind(repository.as_str())
            .fetch_all(&self.0.reads)
            .await?;
        let mut tags =
            names.iter().map(|name| rows::id("tags.tag", name)).collect::<Result<Vec<Tag>, _>>()?;
        // Sorted here, because a database sorts by its locale.
        tags.sort();
        Ok(Some(tags))
    }
}

impl Blobs<&Store> {
    /// Adds a blob to a repository.
    pub async fn link(self, repository: &RepositoryName, blob: &BlobRef) -> Result<(), StoreError> {
        let mut write = self.0.begin().await?;
        let is_known = write.robot_blobs().count(repository, blob).await?;
        let linked =
            sqlx::query("INSERT INTO repository_blobs (repository, digest) VALUES ($1, $2) ON CONFLICT DO NOTHING")
                .bind(repository.as_str())
                .bind(blob.digest.to_string())
                .execute(write.connection())
                .await?;
        if is_known && linked.rows_affected() > 0 {
            write.robot_blobs().count_link(repository, blob).await?;
        }
        write.commit().await
    }

    /// Whether `repository` has the blob; with `None`, whether any repository has it.
    pub async fn has(
        self,
        repository: Option<&RepositoryName>,
        digest: &Digest,
    ) -> Result<bool, StoreError> {
        let query = match repository {
            Some(repository) => sqlx::query(
                "SELECT digest FROM repository_blobs WHERE digest = $1 AND repository = $2",
            )
            .bind(digest.to_string())
            .bind(repository.as_str()),
            None => sqlx::query("SELECT digest FROM repository_blobs WHERE digest = $1 LIMIT 1")
                .bind(digest.to_string()),
        };
        Ok(query.fetch_optional(&self.0.reads).await?.is_some())
    }
}

impl Packages<&Store> {
    /// All packages, sorted by name. Within a name, tagged packages come first, and each group is
    /// sorted newest first.
    pub async fn list(self) -> Result<Vec<PackageView>, StoreError> {
        let rows = sqlx::query(PACKAGE_ROWS).fetch_all(&self.0.reads).await?;
        let mut packages = sorted_views(&rows)?;
        // The sort is stable and keeps the rank within a name.
        packages.sort_by(|one, other| one.package.name.cmp(&other.package.name));
        Ok(packages)
    }

    pub async fn get(
        self,
        name: &TaskName,
        manifest: &Digest,
    ) -> Result<Option<PackageView>, StoreError> {
        let row =
            sqlx::query("SELECT package, task_manifest, pushed_at_ms FROM packages WHERE name = $1 AND manifest = $2")
                .bind(name.as_str())
                .bind(manifest.to_string())
                .fetch_optional(&self.0.reads)
                .await?;
        row.as_ref().map(package_view).transpose()
    }
}

impl Tags<&mut Transaction> {
    /// Removes a tag; false if there is none.
    pub(in crate::store) async fn delete(
        &mut self,
        repository: &RepositoryName,
        tag: &Tag,
    ) -> Result<bool, StoreError> {
        let query = sqlx::query("DELETE FROM tags WHERE repository = $1 AND tag = $2");
        let query = query.bind(repository.as_str()).bind(tag.as_str());
        Ok(query.execute(self.0.connection()).await?.rows_affected() > 0)
    }

    async fn point(
        &mut self,
        repository: &RepositoryName,
        tag: &Tag,
        manifest: &Digest,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO tags (repository, tag, manifest) VALUES ($1, $2, $3)
             ON CONFLICT (repository, tag) DO UPDATE SET manifest = excluded.manifest",
        )
        .bind(repository.as_str())
        .bind(tag.as_str())
        .bind(manifest.to_string())
        .execute(self.0.connection())
        .await?;
        Ok(())
    }
}

impl Blobs<&mut Transaction> {
    /// Removes a blob from a repository; false if the repository does not have the blob.
    pub(in crate::store) async fn unlink(
        &mut self,
        repository: &RepositoryName,
        digest: &Digest,
    ) -> Result<bool, StoreError> {
        let query =
            sqlx::query("DELETE FROM repository_blobs WHERE repository = $1 AND digest = $2");
        let query = query.bind(repository.as_str()).bind(digest.to_string());
        Ok(query.execute(self.0.connection()).await?.rows_affected() > 0)
    }
}

impl Manifests<&mut Transaction> {
    /// Removes a manifest with all its tags, and returns its parts; `None` if there is no such
    /// manifest.
    pub(in crate::store) async fn delete(
        &mut self,
        repository: &RepositoryName,
        digest: &Digest,
    ) -> Result<Option<Vec<Digest>>, StoreError> {
        self.0.robot_blobs().mark_dropped(repository, digest).await?;
        let parts: Vec<String> = sqlx::query_scalar(
            "DELETE FROM manifest_parts WHERE repository = $1 AND manifest = $2 RETURNING digest",
        )
        .bind(repository.as_str())
        .bind(digest.to_string())
        .fetch_all(self.0.connection())
        .await?;
        self.0.publishers().delete_document(repository, digest).await?;
        let mut deleted = 0;
        for sql in [
            "DELETE FROM packages WHERE name = $1 AND manifest = $2",
            "DELETE FROM outputs WHERE repository = $1 AND manifest = $2",
            "DELETE FROM tags WHERE repository = $1 AND manifest = $2",
            "DELETE FROM manifests WHERE repository = $1 AND digest = $2",
        ] {
            let query = sqlx::query(sql).bind(repository.as_str()).bind(digest.to_string());
            deleted = query.execute(self.0.connection()).await?.rows_affected();
        }
        if deleted == 0 {
            return Ok(None);
        }
        parts
            .iter()
            .map(|part| rows::id("manifest_parts.digest", part))
            .collect::<Result<_, _>>()
            .map(Some)
    }

    async fn repository_holds(
        &mut self,
        repository: &RepositoryName,
        part: &Digest,
    ) -> Result<bool, StoreError> {
        let found = sqlx::query(
            "SELECT digest FROM repository_blobs WHERE repository = $1 AND digest = $2
             UNION ALL SELECT digest FROM manifests WHERE repository = $1 AND digest = $2",
        )
        .bind(repository.as_str())
        .bind(part.to_string())
        .fetch_optional(self.0.connection());
        Ok(found.await?.is_some())
    }

    async fn insert(
        &mut self,
        repository: &RepositoryName,
        new: &NewManifest,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO manifests
                 (repository, digest, size, media_type, artifact_type, annotations, subject, pushed_at_ms)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8)
             ON CONFLICT (repository, digest) DO UPDATE
             SET media_type = excluded.media_type, artifact_type = excluded.artifact_type",
        )
        .bind(repository.as_str())
        .bind(new.manifest.digest.to_string())
        .bind(rows::stored(new.manifest.size))
        .bind(&new.manifest.media_type)
        .bind(new.artifact_type.as_ref())
        .bind(rows::json(&new.annotations))
        .bind(new.subject.as_ref())
        .bind(rows::stored(now_ms))
        .execute(self.0.connection())
        .await?;
        for part in &new.parts {
            sqlx::query(
                "INSERT INTO manifest_parts (repository, manifest, digest) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING",
            )
            .bind(repository.as_str())
            .bind(new.manifest.digest.to_string())
            .bind(part.to_string())
            .execute(self.0.connection())
            .await?;
        }
        Ok(())
    }
}

impl Packages<&mut Transaction> {
    /// The digest of another package that has the version of this one.
    async fn with_version(&mut self, package: &PackageRef) -> Result<Option<Digest>, StoreError> {
        let other: Option<String> = sqlx::query_scalar(
            "SELECT t.manifest FROM tags t JOIN packages p ON p.name = t.repository AND p.manifest = t.manifest
             WHERE t.repository = $1 AND t.tag = $2 AND t.manifest <> $3",
        )
        .bind(package.name.as_str())
        .bind(package.version.as_str())
        .bind(package.manifest.digest.to_string())
        .fetch_optional(self.0.connection())
        .await?;
        other.map(|digest| rows::id("tags.manifest", &digest)).transpose()
    }

    /// Marks the package `outdated` as replaced by `package`, and `package` as not replaced.
    async fn replace(&mut self, package: &PackageRef, outdated: &Digest) -> Result<(), StoreError> {
        for (manifest, replaced_by) in
            [(outdated, Some(&package.manifest.digest)), (&package.manifest.digest, None)]
        {
            sqlx::query("UPDATE packages SET replaced_by = $3 WHERE name = $1 AND manifest = $2")
                .bind(package.name.as_str())
                .bind(manifest.to_string())
                .bind(replaced_by.map(Digest::to_string))
                .execute(self.0.connection())
                .await?;
        }
        Ok(())
    }

    /// A package that is pushed again keeps the time of its first push.
    async fn insert(
        &mut self,
        package: &PackageRef,
        task_manifest: &TaskManifest,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO packages (name, manifest, package, task_manifest, pushed_at_ms) VALUES ($1, $2, $3, $4, $5)
             ON CONFLICT DO NOTHING",
        )
        .bind(package.name.as_str())
        .bind(package.manifest.digest.to_string())
        .bind(rows::json(package))
        .bind(rows::json(task_manifest))
        .bind(rows::stored(now_ms))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }
}

/// Packages, and whether a tag points to each. A package stored for a single order has no tag, as
/// with `taskd run`.
pub(in crate::store) const PACKAGE_ROWS: &str = "SELECT p.package, p.task_manifest, p.pushed_at_ms,
    (SELECT COUNT(*) FROM tags t WHERE t.repository = p.name AND t.manifest = p.manifest) AS tags FROM packages p";

/// Tagged packages before the others, each group newest first. A name or a version thus means the
/// package that was pushed under it.
pub(in crate::store) fn sorted_views(rows: &[AnyRow]) -> Result<Vec<PackageView>, StoreError> {
    let views =
        rows.iter().map(|row| Ok((row.try_get::<i64, _>("tags")? == 0, package_view(row)?)));
    let mut views = views.collect::<Result<Vec<_>, StoreError>>()?;
    views.sort_by_key(|(is_bare, view)| {
        (*is_bare, Reverse(view.pushed_at_ms), view.package.manifest.digest)
    });
    Ok(views.into_iter().map(|(_, view)| view).collect())
}

pub(in crate::store) fn package_view(row: &AnyRow) -> Result<PackageView, StoreError> {
    Ok(PackageView {
        package: rows::from_json("packages.package", row.try_get("package")?)?,
        pushed_at_ms: rows::number(row.try_get("pushed_at_ms")?),
        manifest: rows::from_json("packages.task_manifest", row.try_get("task_manifest")?)?,
    })
}
