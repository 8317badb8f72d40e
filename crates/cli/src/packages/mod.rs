//! Owns the commands that look into packages and outputs; it never brings a package to robots.

pub(super) mod export;
pub(super) mod outputs;
pub(super) mod package;
