//! Owns texts that people read or write: times, sizes, messages of parsers, keys of files, lines of
//! logs; it never handles a message of the protocol.

pub mod error_chain;
pub mod expected;
pub mod line;
pub mod log_format;
pub mod size;
pub mod time;
pub mod toml_keys;
