//! Owns how orders and reports change the fleet's state, and who is told of it; it never speaks
//! HTTP or MQTT and holds no SQL.

pub mod actions;
pub mod change;
pub mod changes;
pub mod delivery_planner;
pub mod desired_states;
pub mod feed;
pub mod outbox;
pub mod report_meter;
pub mod report_writer;
pub mod rollout;
