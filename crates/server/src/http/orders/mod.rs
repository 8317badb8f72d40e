//! Owns the routes that order work for robots; it never decides what an order means.

pub(super) mod deployments;
pub(super) mod tasks;
