//! Owns how connections come in: TLS, the listener's backlog and how many there may be; it never
//! reads what is said on them.

pub mod anteroom;
pub mod backlog;
pub mod http_connections;
pub mod open_files;
pub mod tls;
