//! The program that takes part in the graph, and the agent's connection to it: its confinement, the
//! protocol on its pipes, and both ends of them.

pub mod program;
pub mod protocol;
pub mod serve;

pub(super) mod connection;

mod participant;
