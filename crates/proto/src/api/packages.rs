//! Bodies about packages, their versions and files, and about the outputs of runs.

use serde::{Deserialize, Serialize};

use crate::desired::PackageRef;
use crate::packages::manifest::TaskManifest;
use crate::packages::output::OutputSet;
use crate::{Digest, RobotName, TaskName};

/// `GET /packages` (read).
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageList {
    /// Sorted by name; within a name, versions with a tag first, each group with the newest first.
    pub packages: Vec<PackageView>,
}

/// One package version.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageView {
    /// The pinned package.
    pub package: PackageRef,
    /// When the package was pushed.
    pub pushed_at_ms: u64,
    /// The package's task manifest.
    pub manifest: TaskManifest,
}

/// `GET /packages/{package}` (read).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageVersions {
    /// The package's name.
    pub name: TaskName,
    /// Versions with a tag first, each group with the newest first.
    pub versions: Vec<PackageView>,
    /// The manifests that robots should have now, with the number of robots visible to the user. A
    /// manifest may be missing from the versions: robots keep running deleted packages.
    pub running: Vec<PackageUse>,
}

/// Number of robots that should have a package now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageUse {
    /// The package's manifest.
    pub manifest: Digest,
    /// Number of robots.
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
    /// Path below the package's directory, joined by `/`.
    pub path: String,
    /// Type of the entry.
    pub kind: PackageFileKind,
    /// Permission bits of the entry.
    pub mode: u32,
    /// Bytes of a file; 0 for the others.
    pub size: u64,
    /// SHA-256 of a file's bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub digest: Option<Digest>,
    /// Target of a link.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target: Option<String>,
}

/// Type of a package's entry.
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

/// `GET /packages/{package}/diff?from=&to=` (read): differences between two versions of a package.
/// All lists are sorted by path.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PackageDiff {
    /// Entries that only the second version has.
    pub added: Vec<PackageFile>,
    /// Entries that only the first version has.
    pub removed: Vec<PackageFile>,
    /// Entries that both versions have, with differences.
    pub changed: Vec<ChangedFile>,
    /// Whether the task manifests differ beyond the version and the description of the files.
    pub manifest_changed: bool,
}

/// An entry that differs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ChangedFile {
    /// Path of the entry.
    pub path: String,
    /// The entry in the first version.
    pub from: PackageFile,
    /// The entry in the second version.
    pub to: PackageFile,
}

/// `GET /outputs` (read), optionally `?robot=` (id or name) and `?task=`. The files are read from
/// `/v2/outputs/<robot id>/<task>/blobs/<digest>`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OutputList {
    /// The newest first, at most 1,000.
    pub outputs: Vec<OutputView>,
}

/// Files that one run uploaded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OutputView {
    /// The robot's name.
    pub robot_name: RobotName,
    /// Digest of the artifact's manifest.
    pub manifest: Digest,
    /// When the output was pushed.
    pub pushed_at_ms: u64,
    /// The run and its files.
    #[serde(flatten)]
    pub output: OutputSet,
}
