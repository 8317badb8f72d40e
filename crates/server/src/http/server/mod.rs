//! Owns the routes about the servers themselves, and the page's files; never changes a robot or an
//! order.

pub mod gauges;
pub(super) mod health;
pub mod node_drain;
pub(super) mod nodes;
pub(super) mod peers;
pub mod readiness;
pub mod server_facts;
pub mod standby;
pub(super) mod status;
pub mod web;
