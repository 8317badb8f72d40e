//! Accepts connections and spawns a task for each, so that no client waits for another: the task
//! also reads a proxy's header and performs the TLS handshake. This module reads no byte of a
//! client.

use std::future::ready;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::net::{TcpListener, TcpStream};

use super::Front;
use super::admission::PendingPermit;
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
        let Some(permit) = front.acquire() else {
            tracing::debug!(%peer, "the MQTT connection limit is reached, closing a new connection");
            continue;
        };
        // Packets are small and awaited by the other side. If this fails, they arrive a little
        // later.
        let _ = stream.set_nodelay(true);
        if front.context.proxy_protocol.applies_to(peer.ip()) {
            front.sessions.spawn(serve_proxied(front.clone(), stream, peer, permit));
        } else {
            spawn_session(&front, stream, peer, permit);
        }
    }
}

/// Reads the header of a proxy's connection, then serves the proxy's client.
async fn serve_proxied(
    front: Arc<Front>,
    mut stream: TcpStream,
    proxy: SocketAddr,
    permit: PendingPermit,
) {
    let context = &front.context;
    let silent = context.unauthenticated.add_proxied(Instant::now());
    let time_limit = context.limits.connect_timeout;
    let client = tokio::select! {
        client = context.proxy_protocol.client(&mut stream, proxy, time_limit) => client,
        () = silent.evicted().cancelled() => None,
        () = context.stop.cancelled() => return,
    };
    drop(silent);
    match client {
        Some(peer) => spawn_session(&front, stream, peer, permit),
        None => context.totals.refuse(None),
    }
}

fn spawn_session(front: &Front, stream: TcpStream, peer: SocketAddr, permit: PendingPermit) {
    match front.context.tls.clone() {
        None => front.spawn_session(peer, permit, ready(Ok((stream, ClientProof::NotRequested)))),
        Some(tls) => front.spawn_session(peer, permit, async move { tls.accept(stream).await }),
    }
}
