//! Owns texts that people read or write: times, sizes, messages of parsers, lines of logs; it never
//! handles a message of the protocol.

pub mod error_chain;
pub mod expected;
pub mod line;
pub mod size;
pub mod time;
