//! Owns the way from a directory to a package's bytes and back; it never knows a network or a
//! server.
//!
//! The directory's own description, whether that can run, and the bytes to distribute. The crate
//! reads the directory and writes one temporary file.

#![warn(missing_docs)]

use std::path::PathBuf;

use task_proto::desired::PackageRef;
use task_proto::packages::manifest::TaskManifest;
use tempfile::NamedTempFile;

mod archive;
pub mod contents;
mod launch;
mod pack;
pub mod package_xml;
mod rules;
mod source;
pub mod task_toml;
mod text_file;
mod tree;

pub use launch::Launch;
pub use pack::{PackageDescription, describe, pack, pack_into, pack_with_launch};

/// A package, ready to travel.
#[derive(Debug)]
pub struct Packed {
    /// The reference that pins the package.
    pub package: PackageRef,
    /// The package's identity and how to run the package.
    pub manifest: TaskManifest,
    /// The manifest as the OCI config blob.
    pub config_bytes: Vec<u8>,
    /// The OCI manifest that names both blobs.
    pub manifest_bytes: Vec<u8>,
    /// The content blob, deleted when this is dropped.
    pub content: NamedTempFile,
}

/// One reason why a directory is not a package: the file, the key or path in the file, and the
/// error.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{file}: {reason}")]
pub struct Problem {
    /// The file, relative to the package's directory.
    pub file: String,
    /// The error, beginning with the key if there is one.
    pub reason: String,
}

/// Why a directory could not be packed.
#[derive(Debug, thiserror::Error)]
pub enum PackageError {
    /// The directory is not a package that could run; lists all problems.
    #[error("{} can't be packed:\n{}", dir.display(), list(problems))]
    Invalid {
        /// The directory that was to be packed.
        dir: PathBuf,
        /// The problems, in the order in which they were found.
        problems: Vec<Problem>,
    },
    /// A file could not be read or written.
    #[error("{what}")]
    Io {
        /// The failed operation, with the path.
        what: String,
        /// The operating system's error.
        source: std::io::Error,
    },
}

fn list(problems: &[Problem]) -> String {
    problems.iter().map(|problem| format!("  {problem}")).collect::<Vec<_>>().join("\n")
}
