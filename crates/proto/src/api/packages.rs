//! Bodies about packages: their versions, what is in them, and what differs.

use serde::{Deserialize, Serialize};

use crate::desired::PackageRef;
use crate::manifest::TaskManifest;
use crate::{Digest, TaskName};

/// `GET /packages` (read).
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageList {
    /// Sorted by name; of one name those with a tag first, each the newest first.
    pub packages: Vec<PackageView>,
}

/// One package version.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageView {
    /// The pinned package.
    pub package: PackageRef,
    /// When it was pushed.
    pub pushed_at_ms: u64,
    /// Its manifest.
    pub manifest: TaskManifest,
}

/// `GET /packages/{package}` (read).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageVersions {
    /// Its name.
    pub name: TaskName,
    /// Those with a tag first, each the newest first.
    pub versions: Vec<PackageView>,
    /// Which of them robots should have now, and how many of the robots that the person may see. A
    /// manifest may be here that is not among the versions: robots go on with what was deleted.
    pub running: Vec<PackageUse>,
}

/// How many robots should have a package now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageUse {
    /// Which package.
    pub manifest: Digest,
    /// How many robots.
    pub robots: u64,
}

/// `GET /packages/{package}/{version}/files` (read), where the version is a version or a manifest's
/// digest.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageFiles {
    /// Sorted by path.
    pub files: Vec<PackageFile>,
}

/// One entry of a package.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageFile {
    /// Where, below the package's directory, joined by `/`.
    pub path: String,
    /// What it is.
    pub kind: PackageFileKind,
    /// Its permission bits.
    pub mode: u32,
    /// Bytes of a file; 0 for the others.
    pub size: u64,
    /// SHA-256 of a file's bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub digest: Option<Digest>,
    /// Where a link leads.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target: Option<String>,
}

/// What an entry of a package is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum PackageFileKind {
    /// A file.
    File,
    /// A directory.
    Directory,
    /// A symbolic link.
    Link,
}

/// `GET /packages/{package}/diff?from=&to=` (read): what differs between two of its versions. All
/// are sorted by path.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageDiff {
    /// What only the second has.
    pub added: Vec<PackageFile>,
    /// What only the first has.
    pub removed: Vec<PackageFile>,
    /// What both have, but not the same.
    pub changed: Vec<ChangedFile>,
    /// Whether the task manifests differ in more than the version and what describes the files.
    pub manifest_changed: bool,
}

/// An entry that differs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ChangedFile {
    /// Where.
    pub path: String,
    /// What the first has there.
    pub from: PackageFile,
    /// What the second has there.
    pub to: PackageFile,
}
