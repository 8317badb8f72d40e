//! The robot's half: everything `task-agent` does. Imports run downward only; see ARCHITECTURE.md.

pub mod admission;
pub mod builder;
pub mod clock;
pub mod commands;
pub mod config;
pub mod containment;
pub mod disk;
pub mod durable;
pub mod effects;
pub mod environment;
pub mod fetch;
pub mod identity;
pub mod layout;
pub mod ledger;
pub mod logs;
pub mod observed;
pub mod plan;
pub mod process;
pub mod run_dir;
pub mod script;
pub mod shim;
pub mod supervisor;
pub mod underlay;
pub mod unpack;
