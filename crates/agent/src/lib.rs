//! The robot's half: everything `task-agent` does. Imports run downward only; see ARCHITECTURE.md.

pub mod commands;
pub mod disk;
pub mod durable;
pub mod layout;
