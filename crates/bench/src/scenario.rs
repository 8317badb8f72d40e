//! The scenarios with simulated robots, each on its own.

pub mod fleet;
mod grid;
pub mod paper;
mod run_once;
