//! Owns the rows by which servers of one database know each other and each other's robots; it never
//! decides which server lives.

pub(super) mod instances;
pub(super) mod nodes;
pub(super) mod notifications;
pub(super) mod robot_sessions;
