//! Tests of the agent through its public modules, against real files, processes and sockets on loopback.

mod archive;
mod fetch;
mod unpack;
