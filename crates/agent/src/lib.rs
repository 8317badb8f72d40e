//! The robot's half: everything `task-agent` does. Imports run downward only; see ARCHITECTURE.md.

pub mod commands;
pub mod config;
pub mod install;
pub mod link;
pub mod logs;
pub mod process;
pub mod reconcile;
pub mod ros;
pub mod setup;
pub mod system;
pub mod task;
pub mod telemetry;
pub mod transfer;
