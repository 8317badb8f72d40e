//! Owns what the server takes from its machine, the time and the data directory; it never opens a
//! connection.

pub mod clock;
pub mod data_directory;
pub mod host;
