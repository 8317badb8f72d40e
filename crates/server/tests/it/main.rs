//! Integration tests of the server, all in one binary.

#![expect(clippy::unwrap_used, reason = "a test that can't go on should panic where it stands")]

mod api;
mod approval;
mod audited;
mod auth;
mod browser;
mod cli;
mod cli_people;
mod conduct;
mod database;
mod deliveries;
mod direct_push;
mod enrolments;
mod fleet;
mod harness;
mod headers;
mod logs;
mod mqtt;
mod mqtt_harness;
mod mqtt_hostile;
mod mqtt_parts;
mod oci;
mod oidc;
mod outputs;
mod packages;
mod page;
mod people;
mod permissions;
mod provider;
mod registry;
mod scope;
mod serve;
mod signatures;
mod story;
mod tls;
mod tokens;
mod transfers;
mod uplink;
