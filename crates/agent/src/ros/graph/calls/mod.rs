//! Calls to nodes: services, and on top of them lifecycle transitions and parameters. It decides
//! nothing about a node.

pub mod parameters;

pub(super) mod lifecycle;
pub(super) mod services;
