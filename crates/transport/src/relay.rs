//! Lends rumqttc a connection that it can't open itself. The TLS and WebSocket of rumqttc bring an
//! old certificate verifier and support neither a pin nor a clock that may be wrong; its dialer
//! waits for a silent address though the name has others; and it accepts no stream opened by other
//! code. It does connect to a local socket. So we give rumqttc a local socket with an unguessable
//! name that accepts this process only, and relay the bytes.

use std::io;
use std::time::Duration;

use tokio::io::copy_bidirectional_with_sizes;
use tokio::net::UnixListener;
use tokio::time::timeout;

use crate::dial::{DialError, Duplex, Route, dial};

/// Buffer size in each direction.
const BUFFER_BYTES: usize = 64 * 1024;

/// Why the relay was not established.
#[derive(Debug, thiserror::Error)]
pub enum RelayError {
    /// The other end can't be reached this way.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// The connection was not established in time.
    #[error("{host}:{port} did not answer within {time:?}")]
    Late {
        /// The host name or address.
        host: String,
        /// The TCP port that was tried.
        port: u16,
        /// The time limit that was exceeded.
        time: Duration,
    },
    /// The system refused the local socket.
    #[error("could not create the local socket")]
    Local(#[source] io::Error),
}

/// The path of a session: an open connection, and the local socket by which rumqttc reaches that
/// connection.
pub struct Relay {
    name: String,
    listener: UnixListener,
    remote: Box<dyn Duplex>,
}

impl Relay {
    /// Opens the connection within `time`.
    pub async fn open(route: &Route, time: Duration) -> Result<Self, RelayError> {
        let late = |_| RelayError::Late { host: route.host.clone(), port: route.port, time };
        let remote = timeout(time, dial(route)).await.map_err(late)??;
        // In the abstract namespace: there is no file to remove.
        let name = format!("\0task-line-{:032x}", rand::random::<u128>());
        let listener = UnixListener::bind(&name).map_err(RelayError::Local)?;
        Ok(Self { name, listener, remote })
    }

    /// The local socket that rumqttc is to connect to.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Relays bytes both ways until either end closes, which the session notices by itself; then
    /// waits forever.
    pub async fn run(self) {
        self.relay().await;
        std::future::pending().await
    }

    async fn relay(mut self) {
        let own = i32::try_from(std::process::id()).ok();
        let mut near = loop {
            match self.listener.accept().await {
                Ok((near, _)) if near.peer_cred().is_ok_and(|peer| peer.pid() == own) => {
                    break near;
                }
                Ok(_) => {}
                Err(_) => return,
            }
        };
        drop(self.listener);
        // rumqttc sees its own end close, whatever the reason.
        let _ =
            copy_bidirectional_with_sizes(&mut near, &mut self.remote, BUFFER_BYTES, BUFFER_BYTES)
                .await;
    }
}
