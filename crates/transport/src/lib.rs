//! Code shared by both ends of a connection to the server: how a client authenticates the server,
//! how the client authenticates itself, and MQTT over WebSocket. The crate knows no message, keeps
//! no file and reads no clock: the time is a parameter.

#![warn(missing_docs)]

mod client_key;
mod dial;
mod probe;
mod relay;
mod trust;
pub mod websocket;

pub use client_key::{CertificateError, ClientKey, InvalidKey, key_in};
pub use dial::{DialError, Duplex, Route, connect, dial, secure};
pub use probe::{DisplaceError, MqttLogin, ProbeResult, certificate_end_ms, displaces, probe_mqtt};
pub use relay::{Relay, RelayError};
pub use trust::{BUILT_MS, Clock, Trust, WrongServer, pin_of};
