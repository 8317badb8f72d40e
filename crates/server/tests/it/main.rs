//! Integration tests of the server, all in one binary.

mod mqtt;
mod mqtt_harness;
