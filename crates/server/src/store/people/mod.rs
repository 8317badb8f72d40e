//! Owns people, tokens and the audit of what was done; it never keeps a token's secret.

pub(super) mod audit;
pub(super) mod auth_cache;
pub(super) mod familiar_networks;
pub(super) mod first_use;
pub(super) mod page_sessions;
pub(super) mod sign_in_failures;
pub(super) mod tokens;
pub(super) mod users;
