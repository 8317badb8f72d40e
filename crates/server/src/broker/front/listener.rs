//! Accepts connections and spawns a task for each, so that no client waits for another: the task
//! also performs the TLS handshake. This module reads no byte.

use std::future::ready;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;

use super::Front;
use crate::net::tls::ClientProof;

/// Pause until the operating system has file descriptors again.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Accepts until the front stops.
pub(super) async fn run(front: Arc<Front>, listener: TcpListener) {
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = front.context.stop.cancelled() => return,
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!(%error, "cannot accept an MQTT connection");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let Some(claim) = front.claim() else {
            tracing::debug!(%peer, "as many MQTT connections as there may be, one more is closed");
            continue;
        };
        // Packets are small and awaited by the other side. If this fails, they arrive a little
        // later.
        let _ = stream.set_nodelay(true);
        match front.context.tls.clone() {
            None => front.attend(peer, claim, ready(Ok((stream, ClientProof::NotAsked)))),
            Some(tls) => front.attend(peer, claim, async move { tls.accept(stream).await }),
        }
    }
}
