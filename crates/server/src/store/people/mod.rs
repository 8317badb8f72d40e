//! Owns people, tokens and the audit of what was done; it never keeps a token's secret.

pub(super) mod access;
pub(super) mod audit;
pub(super) mod first_use;
pub(super) mod tokens;
pub(super) mod users;
