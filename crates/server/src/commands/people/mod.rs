//! Owns the commands about people, their tokens and what they did; it never touches robots.

pub(super) mod audit;
pub(super) mod login;
pub(super) mod token;
pub(super) mod user;
