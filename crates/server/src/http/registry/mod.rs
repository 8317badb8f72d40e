//! Owns the routes about packages and their bytes; never decides where a package runs.

pub mod archives;
pub mod oci;
pub(super) mod packages;
pub mod upload;
