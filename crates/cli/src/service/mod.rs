//! Owns the commands about the server itself; it never changes anything.

pub(super) mod broker;
pub(super) mod doctor;
pub(super) mod server;
pub(super) mod status;
pub(super) mod version;
