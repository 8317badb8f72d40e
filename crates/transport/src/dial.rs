//! Opens a connection to the server: TCP, TLS if the server speaks TLS, WebSocket on top if the
//! connection has to look like HTTP. There is no timeout here: the caller sets the deadline.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use rustls::ClientConfig;
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;

use crate::websocket::{WebSocket, WebSocketError};

/// A connection, independent of its transport.
pub trait Duplex: AsyncRead + AsyncWrite + Send + Unpin {}

impl<S: AsyncRead + AsyncWrite + Send + Unpin> Duplex for S {}

/// The address, and the protocols to reach the server.
#[derive(Debug, Clone)]
pub struct Route {
    /// Host name or address; an IPv6 address may stand in brackets, as in a URL.
    pub host: String,
    /// TCP port of the listener.
    pub port: u16,
    /// TLS configuration; `None`: plain text.
    pub tls: Option<Arc<ClientConfig>>,
    /// The path of the WebSocket; `None`: no WebSocket.
    pub websocket: Option<String>,
}

/// Why the connection failed.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// The TCP connection failed.
    #[error("cannot connect to {host}:{port}")]
    Connect {
        /// The host name or address.
        host: String,
        /// The TCP port that was tried.
        port: u16,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The name is not a valid name in a certificate.
    #[error("{0:?} is neither a host name nor an address")]
    Name(String),
    /// The TLS handshake failed: the certificate is not trusted, or the server does not speak TLS.
    #[error("the TLS handshake with {host}:{port} failed")]
    Tls {
        /// The host name or address.
        host: String,
        /// The TCP port that was tried.
        port: u16,
        /// The TLS library's error.
        source: io::Error,
    },
    /// The other side does not speak WebSocket on this path.
    #[error(transparent)]
    WebSocket(#[from] WebSocketError),
}

/// Head start of an address before the next is tried in parallel; RFC 8305 recommends this value.
const HEAD_START: Duration = Duration::from_millis(250);
/// The most addresses of a name that are tried.
const MAX_ADDRESSES: usize = 16;

/// The addresses of both families alternating, beginning with the family that the system prefers.
fn alternate_families(addresses: impl Iterator<Item = SocketAddr>) -> Vec<SocketAddr> {
    let addresses: Vec<_> = addresses.collect();
    let is_first = addresses.first().map(SocketAddr::is_ipv6);
    let (first, second): (Vec<_>, Vec<_>) =
        addresses.into_iter().partition(|address| Some(address.is_ipv6()) == is_first);
    let (mut first, mut second) = (first.into_iter(), second.into_iter());
    let pairs = std::iter::from_fn(|| {
        Some([first.next(), second.next()]).filter(|pair| *pair != [None, None])
    });
    pairs.flatten().flatten().take(MAX_ADDRESSES).collect()
}

/// Connects to the first of these addresses that answers. A silent address, such as one of a family
/// that is not routed, does not delay the others.
async fn connect_to(addresses: Vec<SocketAddr>) -> io::Result<TcpStream> {
    let mut addresses = addresses.into_iter();
    let mut tries = JoinSet::new();
    let mut failed = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    loop {
        if let Some(address) = addresses.next() {
            tries.spawn(TcpStream::connect(address));
        }
        let head_start = if addresses.len() > 0 { HEAD_START } else { Duration::MAX };
        // Cancel-safe: a try that has ended stays in the set until the next join.
        match timeout(head_start, tries.join_next()).await {
            Ok(None) => return Err(failed),
            Ok(Some(Ok(Ok(stream)))) => return Ok(stream),
            Ok(Some(Ok(Err(error)))) => failed = error,
            Ok(Some(Err(error))) => failed = error.into(),
            Err(_) => {}
        }
    }
}

/// Opens a connection along the route.
pub async fn dial(route: &Route) -> Result<Box<dyn Duplex>, DialError> {
    secure(connect(route).await?, route).await
}

/// Opens the route's TCP connection, the first step of [`dial`].
pub async fn connect(route: &Route) -> Result<TcpStream, DialError> {
    let failed = |source| DialError::Connect { host: route.host.clone(), port: route.port, source };
    let addresses =
        tokio::net::lookup_host((route.bare_host(), route.port)).await.map_err(failed)?;
    let stream = connect_to(alternate_families(addresses)).await.map_err(failed)?;
    // Packets are small and latency matters. If the option can't be set, packets arrive a little
    // later.
    let _ = stream.set_nodelay(true);
    Ok(stream)
}

/// Adds the route's TLS and WebSocket, the second step of [`dial`].
pub async fn secure(stream: TcpStream, route: &Route) -> Result<Box<dyn Duplex>, DialError> {
    let (host, port) = (route.host.clone(), route.port);
    let stream: Box<dyn Duplex> = if let Some(tls) = &route.tls {
        let bare = route.bare_host().to_owned();
        let name = ServerName::try_from(bare.clone()).map_err(|_| DialError::Name(bare))?;
        match TlsConnector::from(tls.clone()).connect(name, stream).await {
            Ok(stream) => Box::new(stream),
            Err(source) => return Err(DialError::Tls { host, port, source }),
        }
    } else {
        Box::new(stream)
    };
    match &route.websocket {
        None => Ok(stream),
        Some(path) => {
            Ok(Box::new(WebSocket::connect(stream, &format!("{host}:{port}"), path).await?))
        }
    }
}

impl Route {
    /// The host without the brackets of an IPv6 address.
    fn bare_host(&self) -> &str {
        let inner = self.host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
        inner.unwrap_or(&self.host)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> SocketAddr {
        text.parse().expect("an address")
    }

    #[test]
    fn address_families_alternate() {
        let addresses = ["[::1]:1", "[::2]:1", "[::3]:1", "10.0.0.1:1", "10.0.0.2:1"].map(address);
        let alternating =
            ["[::1]:1", "10.0.0.1:1", "[::2]:1", "10.0.0.2:1", "[::3]:1"].map(address);
        assert_eq!(alternate_families(addresses.into_iter()), alternating);
        assert_eq!(alternate_families(addresses[3..].iter().copied()), addresses[3..]);
        assert_eq!(alternate_families(std::iter::empty()), []);
    }

    #[tokio::test]
    async fn silent_or_refusing_address_does_not_delay_the_others() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let open = listener.local_addr().expect("its address");
        // A listener with a full queue: further connections get no answer.
        let silent = tokio::net::TcpSocket::new_v4().expect("a socket");
        silent.bind(address("127.0.0.1:0")).expect("a port");
        let silent = silent.listen(0).expect("listens");
        let full = silent.local_addr().expect("its address");
        let mut waiting = Vec::new();
        while let Ok(Ok(stream)) = timeout(HEAD_START, TcpStream::connect(full)).await {
            waiting.push(stream);
        }
        let refuses = address("127.0.0.1:1");
        let stream = connect_to(vec![full, refuses, open]).await.expect("connected");
        assert_eq!(stream.peer_addr().expect("its address"), open);
        assert_eq!(
            connect_to(vec![refuses]).await.expect_err("refused").kind(),
            io::ErrorKind::ConnectionRefused
        );
        assert_eq!(connect_to(Vec::new()).await.expect_err("none").kind(), io::ErrorKind::NotFound);
    }
}
