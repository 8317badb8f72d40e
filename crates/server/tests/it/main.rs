//! Integration tests of the server, all in one binary.

mod api;
mod auth;
mod cli;
mod database;
mod fleet;
mod harness;
mod mqtt;
mod mqtt_harness;
mod mqtt_hostile;
mod oci;
mod serve;
mod story;
mod uplink;
