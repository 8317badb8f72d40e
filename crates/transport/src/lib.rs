//! Code shared by both ends of a connection to the server: how a client authenticates the server,
//! how the client authenticates itself, and MQTT over WebSocket. The crate knows no message, keeps
//! no file and reads no clock: the time is a parameter.

#![warn(missing_docs)]

mod client_key;
mod dial;
mod line;
mod probe;
mod trust;
pub mod websocket;

pub use client_key::{CertificateError, ClientKey, InvalidKey, key_in};
pub use dial::{DialError, Duplex, Route, dial};
pub use line::{Line, LineError};
pub use probe::{DisplaceError, MqttLogin, Probed, certificate_end_ms, displaces, greet_mqtt};
pub use trust::{BUILT_MS, Clock, Trust, WrongServer, pin_of};
