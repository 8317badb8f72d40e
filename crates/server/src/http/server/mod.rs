//! Owns the routes about the server itself, and the page's files; never changes anything.

pub mod gauges;
pub(super) mod health;
pub mod readiness;
pub mod server_facts;
pub mod standby;
pub(super) mod status;
pub mod web;
