//! Owns how people prove who they are, by password or OpenID provider; it never decides what they
//! may do.

pub mod oidc;
pub mod passwords;
pub mod sign_ins;
