//! Opens a connection to the server: TCP, TLS over it if the server speaks that, WebSocket over that if it is to look like
//! HTTP. It gives up nothing and waits for ever: whoever calls it has the time.

use std::io;
use std::sync::Arc;

use rustls::ClientConfig;
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use crate::websocket::{WebSocket, WebSocketError};

/// A connection, whatever it is made of.
pub trait Duplex: AsyncRead + AsyncWrite + Send + Unpin {}

impl<S: AsyncRead + AsyncWrite + Send + Unpin> Duplex for S {}

/// Where to, and through what.
#[derive(Debug, Clone)]
pub struct Route {
    /// Host name or address; an IPv6 address may stand in brackets, as in a URL.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// How TLS is spoken there; `None`: it is not.
    pub tls: Option<Arc<ClientConfig>>,
    /// The path of the WebSocket there, if it is one.
    pub websocket: Option<String>,
}

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// Nobody answers.
    #[error("cannot connect to {host}:{port}")]
    Connect {
        /// The host.
        host: String,
        /// The port.
        port: u16,
        /// What the system said.
        source: io::Error,
    },
    /// The name can't stand in a certificate.
    #[error("{0:?} is neither a host name nor an address")]
    Name(String),
    /// TLS did not come about: the certificate is not to be trusted, or nobody speaks TLS there.
    #[error("no TLS with {host}:{port}")]
    Tls {
        /// The host.
        host: String,
        /// The port.
        port: u16,
        /// What TLS says.
        source: io::Error,
    },
    /// The other side does not speak WebSocket there.
    #[error(transparent)]
    WebSocket(#[from] WebSocketError),
}

/// Opens a connection.
pub async fn dial(route: &Route) -> Result<Box<dyn Duplex>, DialError> {
    let (host, port) = (route.host.clone(), route.port);
    let bare = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(&host).to_owned();
    let stream = match TcpStream::connect((bare.as_str(), port)).await {
        Ok(stream) => stream,
        Err(source) => return Err(DialError::Connect { host, port, source }),
    };
    // Small packets, each of which somebody waits for. If it can't be set, they come a little later.
    let _ = stream.set_nodelay(true);
    let stream: Box<dyn Duplex> = if let Some(tls) = &route.tls {
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
        Some(path) => Ok(Box::new(WebSocket::connect(stream, &format!("{host}:{port}"), path).await?)),
    }
}
