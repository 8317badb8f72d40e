//! The server half: everything `taskd` does. Imports run downward only; see ARCHITECTURE.md.

pub mod actions;
pub mod advance;
pub mod anteroom;
pub mod backlog;
pub mod blobs;
pub mod broker;
pub mod changes;
pub mod clock;
pub mod collector;
pub mod commands;
pub mod config;
pub mod data_directory;
pub mod deployment;
pub mod downlink;
pub mod gatekeeper;
pub mod http;
pub mod package;
pub mod presence;
pub mod report_writer;
pub mod requests;
pub mod robot_logs;
pub mod rollout;
pub mod serve;
pub mod store;
pub mod uplink;
pub mod web;
