//! Owns what is known of packages, signatures and outputs; it never touches their bytes.

pub(super) mod blob_references;
pub(super) mod outputs;
pub(super) mod package_use;
pub(super) mod packages;
pub(super) mod publishers;
pub(super) mod referrers;
pub(super) mod robot_blobs;
pub(super) mod stored_blobs;
