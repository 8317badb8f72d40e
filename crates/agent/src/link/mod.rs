//! The connection to the server: MQTT sessions, the endpoint they go to, reports, and new tokens. It never decides about tasks.

pub mod endpoint;
pub mod mqtt;
pub mod rotation;
pub mod state;
