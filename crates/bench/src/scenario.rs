//! The scenarios with simulated robots, each on its own.

pub mod blob;
pub mod broker;
mod cold;
pub mod fleet;
mod grid;
pub mod page;
pub mod paper;
pub mod pull;
mod reporters;
mod run_once;
pub mod status;
