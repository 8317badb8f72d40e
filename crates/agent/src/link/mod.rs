//! The session with the server: MQTT or polling, reports, endpoints and new tokens. It never
//! decides about tasks.

pub mod endpoint;
pub mod mqtt;
pub mod rotation;
pub mod state;
