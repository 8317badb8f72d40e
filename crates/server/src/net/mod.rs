//! Owns incoming connections: TLS, headers of the PROXY protocol, the listener's backlog and the
//! connection limits; it never reads their content.

pub mod backlog;
pub mod http_connections;
pub mod open_files;
pub mod proxy_protocol;
pub mod refusal_log;
pub mod tls;
pub mod unauthenticated;
