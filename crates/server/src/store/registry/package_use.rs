//! The packages of a name and the robots that should have them. Every deletion is decided here: no
//! part of a package is deleted while a robot should have the package.

use std::collections::{BTreeMap, HashMap, HashSet};

use sqlx::AssertSqlSafe;
use task_proto::api::{PackageUse, PackageView};
use task_proto::desired::PackageRef;
use task_proto::{DeploymentId, Digest, RepositoryName, RobotId, Tag, TaskName};

use super::packages::{PACKAGE_ROWS, Reference, sorted_views};
use crate::store::fleet::robots::{KNOWN, known_robot};
use crate::store::repositories::{Blobs, Manifests, Packages, Tags};
use crate::store::rows::{from_json, id};
use crate::store::{AuditEvent, KnownRobot, Store, StoreError, Transaction};

/// The outcome of deleting a manifest, a tag or a blob.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Deletion {
    /// Deleted; these blobs were parts of it.
    Deleted(Vec<Digest>),
    /// Not deleted: robots should have the package, or are to get it.
    InUse(PackageUsers),
    /// There is no such manifest, tag or blob.
    Unknown,
}

/// The users of a package.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PackageUsers {
    /// The deployments that use the package, each with its robots.
    pub deployments: Vec<(DeploymentId, Vec<RobotId>)>,
    /// The robots, sorted by name.
    pub robots: Vec<KnownRobot>,
}

impl PackageUsers {
    fn is_empty(&self) -> bool {
        self.deployments.is_empty() && self.robots.is_empty()
    }

    /// Whether some of the robots are outside the acting person's scope.
    fn exceed_scope_of(&self, event: &AuditEvent) -> bool {
        self.robots.iter().any(|robot| !event.covers(robot))
    }
}

impl Packages<&Store> {
    /// Every package of a name: tagged ones first, each group newest first.
    pub async fn versions(self, name: &TaskName) -> Result<Vec<PackageView>, StoreError> {
        let rows = sqlx::query(AssertSqlSafe(format!("{PACKAGE_ROWS} WHERE p.name = $1")))
            .bind(name.as_str())
            .fetch_all(&self.0.reads)
            .await?;
        sorted_views(&rows)
    }

    /// The package of a version or a digest. A version means the target of its tag, or else the
    /// newest package with that version.
    pub async fn find(
        self,
        name: &TaskName,
        reference: &Reference,
    ) -> Result<Option<PackageView>, StoreError> {
        let tag = match reference {
            Reference::Digest(digest) => return self.get(name, digest).await,
            Reference::Tag(tag) => tag,
        };
        let tagged = self
            .0
            .manifests()
            .get(&RepositoryName::of_package(name), reference)
            .await?
            .map(|found| found.digest);
        let mut versions = self.versions(name).await?;
        let at =
            versions.iter().position(|view| Some(view.package.manifest.digest) == tagged).or_else(
                || versions.iter().position(|view| view.package.version.as_str() == tag.as_str()),
            );
        Ok(at.map(|at| versions.swap_remove(at)))
    }

    /// The number of robots that should have each package of a name, among all robots or among
    /// `robots`.
    pub async fn uses(
        self,
        name: &TaskName,
        robots: Option<&HashSet<RobotId>>,
    ) -> Result<Vec<PackageUse>, StoreError> {
        let rows: Vec<(String, String)> = sqlx::query_as(
            "SELECT deployment_id, robot_id FROM assignments WHERE task = $1 AND desired = 1",
        )
        .bind(name.as_str())
        .fetch_all(&self.0.reads)
        .await?;
        let mut by_deployment: HashMap<String, u64> = HashMap::new();
        for (deployment, robot) in rows {
            let robot: RobotId = id("assignments.robot_id", &robot)?;
            let counts = robots.is_none_or(|robots| robots.contains(&robot));
            *by_deployment.entry(deployment).or_default() += u64::from(counts);
        }
        let rows: Vec<(String, String)> = sqlx::query_as(
            "SELECT id, package FROM deployments
             WHERE id IN (SELECT deployment_id FROM assignments WHERE task = $1 AND desired = 1)",
        )
        .bind(name.as_str())
        .fetch_all(&self.0.reads)
        .await?;
        let mut uses: BTreeMap<Digest, u64> = BTreeMap::new();
        for (deployment, package) in rows {
            let package: PackageRef = from_json("deployments.package", &package)?;
            *uses.entry(package.manifest.digest).or_default() +=
                by_deployment.remove(&deployment).unwrap_or(0);
        }
        let uses = uses.into_iter().filter(|(_, robots)| *robots > 0);
        Ok(uses.map(|(manifest, robots)| PackageUse { manifest, robots }).collect())
    }
}

impl Manifests<&Store> {
    /// Removes a manifest with all its tags. Refuses if robots should have a package that the
    /// manifest is, is a part of, or signs. A person whose scope has all of those robots may remove
    /// a signature.
    pub async fn delete(
        self,
        repository: &RepositoryName,
        digest: &Digest,
        event: &AuditEvent,
        now_ms: u64,
    ) -> Result<Deletion, StoreError> {
        let mut write = self.0.begin().await?;
        if let Some(users) =
            write.packages().users_blocking_deletion(repository, digest, event).await?
        {
            return Ok(Deletion::InUse(users));
        }
        let Some(parts) = write.manifests().delete(repository, digest).await? else {
            return Ok(Deletion::Unknown);
        };
        write.commit_with_audit(Some(event), now_ms).await?;
        Ok(Deletion::Deleted(parts))
    }
}

impl Tags<&Store> {
    /// Removes a tag, unless [`Packages::users_blocking_tag_move`] refuses.
    pub async fn delete(
        self,
        repository: &RepositoryName,
        tag: &Tag,
        event: &AuditEvent,
        now_ms: u64,
    ) -> Result<Deletion, StoreError> {
        let mut write = self.0.begin().await?;
        if let Some(users) =
            write.packages().users_blocking_tag_move(repository, tag, None, Some(event)).await?
        {
            return Ok(Deletion::InUse(users));
        }
        if !write.tags().delete(repository, tag).await? {
            return Ok(Deletion::Unknown);
        }
        write.commit_with_audit(Some(event), now_ms).await?;
        Ok(Deletion::Deleted(Vec::new()))
    }
}

impl Blobs<&Store> {
    /// Removes a blob from a repository, on the terms of [`Manifests::delete`].
    pub async fn unlink(
        self,
        repository: &RepositoryName,
        digest: &Digest,
        event: &AuditEvent,
        now_ms: u64,
    ) -> Result<Deletion, StoreError> {
        let mut write = self.0.begin().await?;
        if let Some(users) =
            write.packages().users_blocking_deletion(repository, digest, event).await?
        {
            return Ok(Deletion::InUse(users));
        }
        if !write.blobs().unlink(repository, digest).await? {
            return Ok(Deletion::Unknown);
        }
        write.commit_with_audit(Some(event), now_ms).await?;
        Ok(Deletion::Deleted(Vec::new()))
    }
}

impl Packages<&mut Transaction> {
    /// The users that prevent the deletion of this manifest or blob from `repository`.
    async fn users_blocking_deletion(
        &mut self,
        repository: &RepositoryName,
        digest: &Digest,
        event: &AuditEvent,
    ) -> Result<Option<PackageUsers>, StoreError> {
        let Ok(name) = repository.as_str().parse::<TaskName>() else { return Ok(None) };
        let packages =
            "SELECT manifest FROM packages WHERE name = $1 AND (manifest = $2 OR manifest IN
                 (SELECT manifest FROM manifest_parts WHERE repository = $1 AND digest = $2))";
        for package in self.digests(packages, repository, digest).await? {
            let users = self.users(&name, &package).await?;
            if !users.is_empty() {
                return Ok(Some(users));
            }
        }
        let signed = "SELECT package FROM signatures WHERE repository = $1 AND (manifest = $2 OR envelope = $2)";
        for package in self.digests(signed, repository, digest).await? {
            let users = self.users(&name, &package).await?;
            if users.exceed_scope_of(event) {
                return Ok(Some(users));
            }
        }
        Ok(None)
    }

    /// The users that prevent deleting a tag, or pointing it to another manifest than `to`: robots
    /// that should have the tagged package, and are outside the person's scope.
    pub(in crate::store) async fn users_blocking_tag_move(
        &mut self,
        repository: &RepositoryName,
        tag: &Tag,
        to: Option<&Digest>,
        event: Option<&AuditEvent>,
    ) -> Result<Option<PackageUsers>, StoreError> {
        let (Some(event), Ok(name)) = (event, repository.as_str().parse::<TaskName>()) else {
            return Ok(None);
        };
        let tagged: Option<String> =
            sqlx::query_scalar("SELECT manifest FROM tags WHERE repository = $1 AND tag = $2")
                .bind(repository.as_str())
                .bind(tag.as_str())
                .fetch_optional(self.0.connection())
                .await?;
        let Some(tagged) =
            tagged.map(|digest| id::<Digest>("tags.manifest", &digest)).transpose()?
        else {
            return Ok(None);
        };
        if to == Some(&tagged) {
            return Ok(None);
        }
        let users = self.users(&name, &tagged).await?;
        Ok(users.exceed_scope_of(event).then_some(users))
    }

    async fn digests(
        &mut self,
        sql: &'static str,
        repository: &RepositoryName,
        digest: &Digest,
    ) -> Result<Vec<Digest>, StoreError> {
        let query = sqlx::query_scalar(sql).bind(repository.as_str()).bind(digest.to_string());
        let found: Vec<String> = query.fetch_all(self.0.connection()).await?;
        found.iter().map(|found| id("packages.manifest", found)).collect()
    }

    async fn users(
        &mut self,
        name: &TaskName,
        manifest: &Digest,
    ) -> Result<PackageUsers, StoreError> {
        let rows: Vec<(String, String)> = sqlx::query_as(
            "SELECT id, package FROM deployments WHERE id IN (
                 SELECT deployment_id FROM assignments WHERE (desired = 1 OR ended = 0) AND task = $1
                 UNION SELECT c.deployment_id FROM order_chunks c JOIN deployments d ON d.id = c.deployment_id
                 WHERE d.task = $1)
             ORDER BY number",
        )
        .bind(name.as_str())
        .fetch_all(self.0.connection())
        .await?;
        let mut users = PackageUsers::default();
        for (deployment, package) in rows {
            let package: PackageRef = from_json("deployments.package", &package)?;
            if package.manifest.digest != *manifest {
                continue;
            }
            let assigned = "SELECT robot_id FROM assignments WHERE deployment_id = $1 AND (desired = 1 OR ended = 0)";
            let sql = format!("{KNOWN} AND id IN ({assigned})");
            let rows = sqlx::query(AssertSqlSafe(sql))
                .bind(&deployment)
                .fetch_all(self.0.connection())
                .await?;
            let robots = rows.iter().map(known_robot).collect::<Result<Vec<_>, _>>()?;
            let ids = robots.iter().map(|robot| robot.id.clone()).collect();
            users.deployments.push((id("deployments.id", &deployment)?, ids));
            users.robots.extend(robots);
        }
        users.robots.sort_by(|one, other| one.name.cmp(&other.name));
        users.robots.dedup();
        Ok(users)
    }
}
