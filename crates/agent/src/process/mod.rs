//! Processes: started, confined, supervised by a shim, and found again after a restart of the
//! agent. It never decides when.

pub mod call_filter;
pub mod cgroup;
pub mod confinement;
pub mod containment;
pub mod program;
pub mod run_dir;
pub mod shim;
pub mod supervisor;
