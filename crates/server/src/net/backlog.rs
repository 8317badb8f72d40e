//! Opens TCP listeners with room for a fleet that reconnects at once. This module accepts nothing.

use std::io;
use std::net::SocketAddr;

use tokio::net::{TcpListener, TcpSocket};

/// Maximum connections that wait to be accepted, as far as the operating system permits. A client
/// that finds no room retries after one second, then two, then four.
const BACKLOG: u32 = 16 * 1024;

/// Listens on `address`; port 0 picks a free port. Call this on a runtime.
pub fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
    // Lets a server restart while connections of its last run are still ending.
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}
