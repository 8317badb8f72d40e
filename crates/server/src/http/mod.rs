//! The HTTP edge: one table of routes, each with who may call it, in front of handlers that look up, act and reply.
//! It never holds SQL and never decides what an order means.

pub mod auth;
pub mod drain;
pub mod error;
pub mod oci;
