//! Owns the robots as they are registered and as they report; it never decides what they should
//! run.

pub(super) mod adoption;
pub(super) mod enrollments;
pub(super) mod matching;
pub(super) mod needed_packages;
pub(super) mod reports;
pub(super) mod robot_pages;
pub(super) mod robots;
mod selector_sql;
