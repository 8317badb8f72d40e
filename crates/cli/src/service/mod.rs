//! Owns the commands about the servers themselves; it never changes a robot or a package.

pub(super) mod broker;
pub(super) mod cluster;
pub(super) mod doctor;
pub(super) mod server;
pub(super) mod status;
pub(super) mod version;
