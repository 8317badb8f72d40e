//! Owns what the server says of itself, and the page's files; it never changes anything.

pub(super) mod health;
pub mod readiness;
pub mod server_facts;
pub mod status;
pub mod web;
