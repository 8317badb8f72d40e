//! Owns simulated robots, in this process and in others; they never build or start a task.

pub mod fleet;
pub mod robot;
pub mod robots;
mod vitals;
