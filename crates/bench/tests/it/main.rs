//! The end-to-end tests: the real programs, started as processes, and the rules all of the source keeps.

mod approval;
mod broker;
mod confinement;
mod corridor;
mod crash;
mod delivery;
mod direct_push;
mod flood;
mod harness;
mod hostile;
mod load;
mod logs;
mod orders;
mod proxy;
mod questions;
mod registry;
mod restore;
mod revoked;
mod ros;
mod ros1;
mod scenarios;
mod secrets;
mod talker;
mod tidy;
mod tls;
