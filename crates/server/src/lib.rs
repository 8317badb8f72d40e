//! The server half: everything `taskd` does. Imports run downward only; see ARCHITECTURE.md.

pub mod broker;
pub mod clock;
pub mod config;
pub mod http;
pub mod presence;
