//! Owns the routes about people, how they sign in and their tokens; it never decides what they may
//! do.

pub(super) mod oidc;
pub(super) mod people;
pub mod session;
