//! Opens TCP listeners with room for a fleet that comes back at once. It accepts nothing.

use std::io;
use std::net::SocketAddr;

use tokio::net::{TcpListener, TcpSocket};

/// Connections that may wait to be accepted, as far as the system allows. Whoever finds no room
/// tries again after one second, then two, then four.
const BACKLOG: u32 = 16 * 1024;

/// Listens on `address`; port 0 takes a free one. To be called on a runtime.
pub fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
    // So that a server can be started again while connections of its last run are still ending.
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}
