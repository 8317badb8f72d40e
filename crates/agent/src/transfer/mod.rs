//! Bytes between server and robot: the HTTP client and its credential, parts that arrive over MQTT,
//! and the measurement of the link. It never decides and never retries.

pub mod credential;
pub mod link_meter;
pub mod parts;
pub mod registry_error;
pub mod server;
