//! Lends rumqttc a connection that it can't make itself. Its own TLS and WebSocket bring an old
//! certificate verifier, know no pin and no clock that may be wrong, it waits for an address that
//! is silent though the name has others, and it takes no stream that somebody else has opened; but
//! it does connect to a local socket. So it gets one that has a name nobody knows and takes just
//! this process, and what passes there is carried over.

use std::io;
use std::time::Duration;

use tokio::io::copy_bidirectional_with_sizes;
use tokio::net::UnixListener;
use tokio::time::timeout;

use crate::dial::{DialError, Duplex, Route, dial};

/// What is on its way, in each direction.
const BUFFER_BYTES: usize = 64 * 1024;

/// Why there is no line.
#[derive(Debug, thiserror::Error)]
pub enum LineError {
    /// The other end can't be reached this way.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// It did not answer in time.
    #[error("{host}:{port} does not answer within {time:?}")]
    Late {
        /// The host.
        host: String,
        /// The port.
        port: u16,
        /// How long it had.
        time: Duration,
    },
    /// The system gives no local socket.
    #[error("no local socket")]
    Local(#[source] io::Error),
}

/// What a session goes over: an open connection, and the local socket by which rumqttc gets to it.
pub struct Line {
    name: String,
    listener: UnixListener,
    far: Box<dyn Duplex>,
}

impl Line {
    /// Opens the connection within `time`.
    pub async fn open(route: &Route, time: Duration) -> Result<Self, LineError> {
        let late = |_| LineError::Late { host: route.host.clone(), port: route.port, time };
        let far = timeout(time, dial(route)).await.map_err(late)??;
        // In the abstract namespace: there is no file that would have to be removed.
        let name = format!("\0task-line-{:032x}", rand::random::<u128>());
        let listener = UnixListener::bind(&name).map_err(LineError::Local)?;
        Ok(Self { name, listener, far })
    }

    /// The local socket that rumqttc is to connect to.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Carries bytes both ways until either end is through, which the session sees by itself; then
    /// it rests.
    pub async fn carry(self) {
        self.carry_all().await;
        std::future::pending().await
    }

    async fn carry_all(mut self) {
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
        let _ = copy_bidirectional_with_sizes(&mut near, &mut self.far, BUFFER_BYTES, BUFFER_BYTES)
            .await;
    }
}
