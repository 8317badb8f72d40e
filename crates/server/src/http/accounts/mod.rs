//! Owns the routes about people, their sign-in and their tokens; never decides on permissions.

pub(super) mod oidc;
pub(super) mod people;
pub(super) mod person_sessions;
pub mod session;
