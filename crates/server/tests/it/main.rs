//! Integration tests of the server, all in one binary.

mod cli;
mod database;
mod fleet;
mod mqtt;
mod mqtt_harness;
mod oci;
mod story;
