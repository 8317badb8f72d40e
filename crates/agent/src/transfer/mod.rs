//! Bytes between server and robot: the HTTP client and its credential, parts that come over MQTT, and the measurement of the link. It decides nothing.

pub mod credential;
pub mod link_meter;
pub mod parts;
pub mod registry_error;
pub mod server;
