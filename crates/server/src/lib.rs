//! The server half: everything `taskd` does. Imports run downward only; see ARCHITECTURE.md.

pub mod auth;
pub mod blobs;
pub mod broker;
pub mod cluster;
pub mod config;
pub mod domain;
pub mod fleet;
pub mod http;
pub mod link;
pub mod net;
pub mod orders;
pub mod serve;
pub mod store;
pub mod system;
