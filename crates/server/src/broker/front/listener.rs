//! Accepts connections and gives each a task of its own, so that no client waits for another: a TLS handshake is done in
//! there too. It reads no byte.

use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;

use super::entrance::Arrival;
use super::{Front, session};

/// For the system to have file descriptors again.
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
        let Ok(place) = front.context.places.clone().try_acquire_owned() else {
            tracing::debug!(%peer, "as many MQTT connections as there may be, one more is closed");
            front.context.totals.refuse(None);
            continue;
        };
        // Small packets, each of which somebody waits for. If it can't be set, they come a little later.
        let _ = stream.set_nodelay(true);
        match front.context.tls.clone() {
            None => {
                let context = front.context.clone();
                let arrival = Arrival::new(&context, peer);
                front.sessions.spawn(async move {
                    session::serve(context, stream, arrival).await;
                    drop(place);
                });
            }
            Some(tls) => front.attend(peer, place, async move { tls.accept(stream).await }),
        }
    }
}
