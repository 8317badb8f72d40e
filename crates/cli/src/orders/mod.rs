//! Owns the commands that order work for robots; it never manages the robots themselves.

pub(super) mod deploy;
pub(super) mod push;
pub(super) mod run;
pub(super) mod task;
