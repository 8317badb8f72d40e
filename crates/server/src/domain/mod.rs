//! Owns the pure rules and values of the fleet; it never does I/O, never waits and never reads a
//! clock.

pub mod blob_store_url;
pub mod broker_url;
pub mod database_url;
pub mod delivery;
pub mod deployment;
pub mod fleet_event;
pub mod instance_history;
pub mod limits;
pub mod person;
pub mod rollout;
mod url_text;
