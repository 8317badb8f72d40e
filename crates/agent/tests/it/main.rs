//! Tests of the agent through its public modules, against real files, processes and sockets on
//! loopback.

#![expect(clippy::unwrap_used, reason = "a helper that cannot go on ends its test")]

mod agent;
mod archive;
mod build;
mod contain;
mod doctor;
mod fetch;
mod flips;
mod gate;
mod graph;
mod graph_network;
mod graph_process;
mod harness;
mod init;
mod launch;
mod logs;
mod outputs;
mod parts;
mod peer;
mod ros;
mod rtps;
mod signatures;
mod site;
mod supervise;
mod unpack;
