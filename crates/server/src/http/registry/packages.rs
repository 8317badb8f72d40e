//! Packages, for the operator's commands and the page: versions, contents, differences, and the
//! robots that run them. The bytes belong to the registry.

use std::collections::HashSet;
use std::fmt;
use std::str::FromStr;

use axum::Json;
use axum::extract::State;
use axum::response::NoContent;
use http::StatusCode;
use serde::Deserialize;
use task_archive::UnpackError;
use task_macros::operation;
use task_package::contents;
use task_proto::api::{
    PackageDiff, PackageFile, PackageFiles, PackageList, PackageVersions, PackageView,
};
use task_proto::{Digest, RepositoryName, RobotId, TaskName};
use utoipa::{IntoParams, ToSchema};

use super::Registry;
use crate::domain::person::Person;
use crate::http::error::ApiError;
use crate::http::extract::{PathParam, PathParams, QueryParams};
use crate::orders::changes::Change;
use crate::store::{AuditAction, AuditEvent, Deletion, PackageUsers, Reference, Store};

/// The most robots, and the most deployments, that the message about a package in use names.
const MAX_NAMED: usize = 5;

/// A version, or a manifest's digest.
#[derive(Debug, Clone, ToSchema)]
#[schema(value_type = String, example = "1.2.0")]
pub(in crate::http) struct PackageReference(Reference);

/// The error for a text that is neither.
#[derive(Debug, thiserror::Error)]
#[error("{0:?} is neither a version nor a manifest's digest")]
pub(in crate::http) struct InvalidReference(String);

impl FromStr for PackageReference {
    type Err = InvalidReference;
    fn from_str(text: &str) -> Result<Self, InvalidReference> {
        let reference = match text.parse::<Digest>() {
            Ok(digest) => Ok(Reference::Digest(digest)),
            Err(_) => text.parse().map(Reference::Tag),
        };
        reference.map(Self).map_err(|_| InvalidReference(text.chars().take(80).collect()))
    }
}

impl fmt::Display for PackageReference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Reference::Tag(tag) => tag.fmt(f),
            Reference::Digest(digest) => digest.fmt(f),
        }
    }
}

/// Lists all package versions.
#[operation(tag = "packages")]
pub(in crate::http) async fn list(
    State(store): State<Store>,
) -> Result<Json<PackageList>, ApiError> {
    Ok(Json(PackageList { packages: store.packages().list().await? }))
}

/// Lists the versions of a package and how many robots should have each.
#[operation(tag = "packages")]
pub(in crate::http) async fn show(
    State(store): State<Store>,
    by: Person,
    PathParam(name): PathParam<TaskName>,
) -> Result<Json<PackageVersions>, ApiError> {
    let versions = store.packages().versions(&name).await?;
    let robots = match by.scope.is_everything() {
        true => None,
        false => Some(store.robots().ids_in(&by.scope).await?.into_iter().collect::<HashSet<_>>()),
    };
    let running = store.packages().uses(&name, robots.as_ref()).await?;
    if versions.is_empty() && running.is_empty() {
        return Err(ApiError::not_found(format!("there is no package {name}")));
    }
    Ok(Json(PackageVersions { name, versions, running }))
}

/// Lists the contents of a package.
#[operation(tag = "packages",
    responses((status = 422, description = "`archive_refused`: robots would refuse to unpack the content.")))]
pub(in crate::http) async fn files(
    State(registry): State<Registry>,
    PathParams(name, version): PathParams<TaskName, PackageReference>,
) -> Result<Json<PackageFiles>, ApiError> {
    let package = find(&registry.store, &name, &version).await?;
    Ok(Json(PackageFiles { files: listed(&registry, &package).await? }))
}

/// The query of `GET /packages/{package}/diff`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct DiffQuery {
    /// A version, or a manifest's digest.
    from: String,
    /// The version, or manifest's digest, to compare with.
    to: String,
}

/// Compares two versions of a package.
#[operation(tag = "packages",
    responses((status = 422, description = "`archive_refused`: robots would refuse to unpack one of the contents.")))]
pub(in crate::http) async fn diff(
    State(registry): State<Registry>,
    PathParam(name): PathParam<TaskName>,
    QueryParams(query): QueryParams<DiffQuery>,
) -> Result<Json<PackageDiff>, ApiError> {
    let named = |key: &str, text: &str| {
        text.parse::<PackageReference>()
            .map_err(|error| ApiError::invalid(format!("{key}: {error}")))
    };
    let (from, to) = (named("from", &query.from)?, named("to", &query.to)?);
    let (from, to) =
        (find(&registry.store, &name, &from).await?, find(&registry.store, &name, &to).await?);
    let manifest_changed = !contents::is_same_except_version(&from.manifest, &to.manifest);
    if from.package.content == to.package.content {
        return Ok(Json(PackageDiff { manifest_changed, ..PackageDiff::default() }));
    }
    let diff = contents::diff(listed(&registry, &from).await?, listed(&registry, &to).await?);
    Ok(Json(PackageDiff { manifest_changed, ..diff }))
}

/// Deletes a version of a package that no robot should have.
#[operation(tag = "packages",
    responses((status = 409, description = "`package_in_use`: robots have the package, or will get it.")))]
pub(in crate::http) async fn remove(
    State(registry): State<Registry>,
    by: Person,
    PathParams(name, version): PathParams<TaskName, PackageReference>,
) -> Result<NoContent, ApiError> {
    let _hold = registry.blobs.hold_collection().await;
    let package = find(&registry.store, &name, &version).await?.package;
    let (digest, now_ms) = (package.manifest.digest, registry.clock.now_ms());
    let event = AuditEvent::by(&by, AuditAction::ManifestDelete, &name)
        .with("manifest", digest)
        .with("version", &package.version);
    match registry
        .store
        .manifests()
        .delete(&RepositoryName::of_package(&name), &digest, &event, now_ms)
        .await?
    {
        Deletion::Unknown => return Err(unknown(&name, &version)),
        Deletion::InUse(users) => {
            let message = in_use_message(&by, &format!("{name} {}", package.version), &users);
            return Err(ApiError::conflict("package_in_use", message));
        }
        Deletion::Deleted(parts) => {
            registry.changes.announce(Change::Package(name));
            // An order that looked the package up a moment ago still finds its bytes, because the
            // bytes are kept for a while.
            for blob in parts.into_iter().chain([digest]) {
                registry.blobs.touch(blob, now_ms).await?;
            }
        }
    }
    Ok(NoContent)
}

async fn find(
    store: &Store,
    name: &TaskName,
    version: &PackageReference,
) -> Result<PackageView, ApiError> {
    store.packages().find(name, &version.0).await?.ok_or_else(|| unknown(name, version))
}

fn unknown(name: &TaskName, version: &PackageReference) -> ApiError {
    ApiError::new(
        StatusCode::NOT_FOUND,
        "package_not_found",
        format!("there is no package {name} {version}"),
    )
}

/// Names the users of a package that is in use. Robots outside the person's scope, and deployments
/// without robots in that scope, are only counted.
pub(in crate::http) fn in_use_message(by: &Person, package: &str, users: &PackageUsers) -> String {
    let own =
        users.robots.iter().filter(|robot| by.scope.covers(&robot.id, &robot.name, &robot.labels));
    let (ids, names): (HashSet<&RobotId>, Vec<&str>) =
        own.map(|robot| (&robot.id, robot.name.as_str())).unzip();
    let is_own = |robots: &[RobotId]| {
        by.scope.is_everything() || robots.iter().any(|robot| ids.contains(robot))
    };
    let deployments = users.deployments.iter().filter(|(_, robots)| is_own(robots));
    let deployments: Vec<&str> = deployments.map(|(id, _)| id.as_str()).take(MAX_NAMED).collect();
    let robots: Vec<&str> = names.into_iter().take(MAX_NAMED).collect();
    let named = |names: Vec<&str>, of: usize| match of > names.len() {
        true if names.is_empty() => String::new(),
        true => format!(": {}, …", names.join(", ")),
        false => format!(": {}", names.join(", ")),
    };
    format!(
        "{package} is in use by {} robots{}, through {} deployments{}; deploy another version or remove the task first",
        users.robots.len(),
        named(robots, users.robots.len()),
        users.deployments.len(),
        named(deployments, users.deployments.len()),
    )
}

/// The entries of a package, read from its archive.
async fn listed(registry: &Registry, view: &PackageView) -> Result<Vec<PackageFile>, ApiError> {
    let content = view.package.content;
    let gone = || ApiError::not_found(format!("the content of {} is missing", view.package.name));
    let blob = registry.blobs.get(content.digest).await?.ok_or_else(gone)?;
    let facts = view.manifest.content;
    let listed = registry
        .readers
        .read(&blob, move |bytes| contents::list(bytes, content.size, &facts))
        .await;
    listed.map_err(|error| match error {
        UnpackError::Refused(refusal) => {
            ApiError::new(StatusCode::UNPROCESSABLE_ENTITY, "archive_refused", refusal.to_string())
        }
        UnpackError::Source(_) | UnpackError::Disk { .. } => ApiError::internal(&error),
    })
}
