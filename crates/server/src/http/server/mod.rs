//! Owns the routes about the server itself, and the page's files; never changes anything.

pub(super) mod health;
pub mod readiness;
pub mod server_facts;
pub mod status;
pub mod web;
