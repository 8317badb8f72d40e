//! Packages on the disk: fetched, verified, unpacked, built and sealed. It never starts a task.

pub mod builder;
pub mod fetch;
pub mod seal;
pub mod signature_policy;
pub mod work_dir;
