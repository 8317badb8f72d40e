//! Owns the requests of commands to the server, from credentials to uploads and waiting; it never
//! decides which requests to send.

pub(super) mod client;
pub(super) mod complete;
pub(super) mod credentials;
pub(super) mod download;
pub(super) mod sse;
pub(super) mod upload;
pub(super) mod wait;
