//! Owns deployments and their assignments; it never decides when a batch begins.

pub(super) mod assignments;
pub(super) mod chunks;
pub(super) mod deployments;
pub(super) mod fan_outs;
pub(super) mod idempotency;
pub(super) mod past_assignments;
pub(super) mod revert;
pub(super) mod still_running;
