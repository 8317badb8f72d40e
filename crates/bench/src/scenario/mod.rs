//! Owns the scenarios, each a subcommand of `taskbench`; they never call one another.

pub mod blob;
pub mod broker;
pub mod cluster;
pub mod fleet;
pub mod load;
pub mod orders;
pub mod page;
pub mod paper;
pub mod pull;
mod reporters;
mod run_once;
pub mod status;
