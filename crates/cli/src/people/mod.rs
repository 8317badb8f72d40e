//! Owns the commands about people, their tokens and the audit; it never touches robots.

pub(super) mod audit;
pub(super) mod login;
pub(super) mod token;
pub(super) mod user;
