//! Owns the documents of packages and outputs: manifests, OCI artifacts, and the statements of
//! publishers; it never reads a package's content.

pub mod manifest;
pub mod oci;
pub mod output;
pub mod publisher;
