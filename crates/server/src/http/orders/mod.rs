//! Owns the routes that order work for robots; never decides the effect of an order.

pub(super) mod deployments;
pub(super) mod tasks;
