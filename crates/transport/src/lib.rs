//! What both ends of a connection to the server share: whom a client takes for the server, and MQTT over WebSocket. It knows
//! no message, keeps no file and reads no clock: the time is handed in.

mod dial;
mod trust;
pub mod websocket;

pub use dial::{DialError, Duplex, Route, dial};
pub use trust::{BUILT_MS, Clock, Trust, WrongServer, pin_of};
