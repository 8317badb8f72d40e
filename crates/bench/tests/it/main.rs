//! The end-to-end tests: the real programs, started as processes, and the rules all of the source
//! keeps.

mod approval;
mod broker;
mod client_ids;
mod cluster;
mod cluster_forward;
mod cluster_nodes;
mod cluster_scenario;
mod configuration;
mod confinement;
mod corridor;
mod crash;
mod delivery;
mod direct_push;
mod doctor;
mod environment;
mod flood;
mod graph_loss;
mod harness;
mod hostile;
mod leftovers;
mod load;
mod logs;
mod orders;
mod outputs;
mod proxy;
mod questions;
mod registry;
mod restore;
mod revoked;
mod rooms;
mod ros;
mod ros1;
#[expect(dead_code, reason = "the agent's own tests need more of it")]
#[path = "../../../agent/tests/it/rtps.rs"]
mod rtps;
mod scenarios;
mod secrets;
mod settings;
mod signing;
mod talker;
mod theft;
mod tidy;
mod tls;
