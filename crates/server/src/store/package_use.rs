//! Which packages there are of a name, who should have them, and that none is deleted that someone should have.

use std::collections::{BTreeMap, HashMap, HashSet};

use sqlx::AssertSqlSafe;
use task_proto::api::{PackageUse, PackageView};
use task_proto::desired::PackageRef;
use task_proto::{DeploymentId, Digest, RepositoryName, RobotId, TaskName};

use super::packages::{PACKAGE_ROWS, Reference, ranked};
use super::robots::{KNOWN, known_robot};
use super::rows::{from_json, id};
use super::{Deed, KnownRobot, Store, StoreError, Write};

/// How deleting a package ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DeletePackage {
    /// It is gone; these blobs were parts of it.
    Deleted(Vec<Digest>),
    /// Nothing is deleted: robots should have it, or are to get it.
    InUse(PackageUsers),
    /// There is no such package.
    Unknown,
}

/// Who keeps a package in use.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PackageUsers {
    /// By which orders, each with those of the robots that it is for.
    pub deployments: Vec<(DeploymentId, Vec<RobotId>)>,
    /// The robots, sorted by name.
    pub robots: Vec<KnownRobot>,
}

impl Store {
    /// Every package of a name: those with a tag first, each the newest first.
    pub async fn package_versions(&self, name: &TaskName) -> Result<Vec<PackageView>, StoreError> {
        let rows = sqlx::query(AssertSqlSafe(format!("{PACKAGE_ROWS} WHERE p.name = $1")))
            .bind(name.as_str())
            .fetch_all(&self.reads)
            .await?;
        ranked(&rows)
    }

    /// The package that a version or a digest means: a version is what its tag points to, or the newest that says so.
    pub async fn find_package(
        &self,
        name: &TaskName,
        reference: &Reference,
    ) -> Result<Option<PackageView>, StoreError> {
        let tag = match reference {
            Reference::Digest(digest) => return self.package(name, digest).await,
            Reference::Tag(tag) => tag,
        };
        let tagged = self.manifest(&RepositoryName::of_package(name), reference).await?.map(|found| found.digest);
        let mut versions = self.package_versions(name).await?;
        let at = versions
            .iter()
            .position(|view| Some(view.package.manifest.digest) == tagged)
            .or_else(|| versions.iter().position(|view| view.package.version.as_str() == tag.as_str()));
        Ok(at.map(|at| versions.swap_remove(at)))
    }

    /// How many robots, of all or of `robots`, should have which package of a name.
    pub async fn package_uses(
        &self,
        name: &TaskName,
        robots: Option<&HashSet<RobotId>>,
    ) -> Result<Vec<PackageUse>, StoreError> {
        let rows: Vec<(String, String)> =
            sqlx::query_as("SELECT deployment_id, robot_id FROM assignments WHERE task = $1 AND desired = 1")
                .bind(name.as_str())
                .fetch_all(&self.reads)
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
        .fetch_all(&self.reads)
        .await?;
        let mut uses: BTreeMap<Digest, u64> = BTreeMap::new();
        for (deployment, package) in rows {
            let package: PackageRef = from_json("deployments.package", &package)?;
            *uses.entry(package.manifest.digest).or_default() += by_deployment.remove(&deployment).unwrap_or(0);
        }
        let uses = uses.into_iter().filter(|(_, robots)| *robots > 0);
        Ok(uses.map(|(manifest, robots)| PackageUse { manifest, robots }).collect())
    }

    /// Deletes a package with its tags, unless a robot should have it or is to get it.
    pub async fn delete_package(
        &self,
        name: &TaskName,
        manifest: &Digest,
        deed: &Deed,
        now_ms: u64,
    ) -> Result<DeletePackage, StoreError> {
        let mut write = self.begin().await?;
        let users = write.package_users(name, manifest).await?;
        if users != PackageUsers::default() {
            return Ok(DeletePackage::InUse(users));
        }
        let Some(parts) = write.delete_manifest(&RepositoryName::of_package(name), manifest).await? else {
            return Ok(DeletePackage::Unknown);
        };
        write.commit_with(Some(deed), now_ms).await?;
        Ok(DeletePackage::Deleted(parts))
    }
}

impl Write {
    async fn package_users(&mut self, name: &TaskName, manifest: &Digest) -> Result<PackageUsers, StoreError> {
        let rows: Vec<(String, String)> = sqlx::query_as(
            "SELECT id, package FROM deployments WHERE id IN (
                 SELECT deployment_id FROM assignments WHERE (desired = 1 OR ended = 0) AND task = $1)
             ORDER BY number",
        )
        .bind(name.as_str())
        .fetch_all(self.connection())
        .await?;
        let mut users = PackageUsers::default();
        for (deployment, package) in rows {
            let package: PackageRef = from_json("deployments.package", &package)?;
            if package.manifest.digest != *manifest {
                continue;
            }
            let assigned = "SELECT robot_id FROM assignments WHERE deployment_id = $1 AND (desired = 1 OR ended = 0)";
            let sql = format!("{KNOWN} AND id IN ({assigned})");
            let rows = sqlx::query(AssertSqlSafe(sql)).bind(&deployment).fetch_all(self.connection()).await?;
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
