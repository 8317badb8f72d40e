//! The MQTT front: everything between the network and the inbox or the router.

mod doorbell;
mod takeover;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use task_proto::RobotId;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::{BrokerConfig, BrokerError, Gatekeeper, Inbox, NotConnected};
use takeover::Seats;

pub(super) struct Front {
    local_addr: SocketAddr,
    seats: Arc<Seats>,
    stop: CancellationToken,
    sessions: TaskTracker,
}

impl Front {
    pub(super) async fn start(
        config: BrokerConfig,
        _gatekeeper: Arc<dyn Gatekeeper>,
        _inbox: Arc<dyn Inbox>,
    ) -> Result<Arc<Self>, BrokerError> {
        let listen = |source| BrokerError::Listen { address: config.listen, source };
        let listener = TcpListener::bind(config.listen).await.map_err(listen)?;
        let local_addr = listener.local_addr().map_err(listen)?;
        Ok(Arc::new(Self {
            local_addr,
            seats: Arc::default(),
            stop: CancellationToken::new(),
            sessions: TaskTracker::new(),
        }))
    }

    pub(super) fn ring(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotConnected> {
        self.seats.doorbell(robot).ok_or(NotConnected)?.ring(payload);
        Ok(())
    }

    pub(super) fn disconnect(&self, robot: &RobotId) {
        self.seats.ask_to_leave(robot);
    }

    pub(super) fn connected_count(&self) -> usize {
        self.seats.robots()
    }

    pub(super) fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    pub(super) async fn shutdown(&self, patience: Duration) {
        self.stop.cancel();
        self.sessions.close();
        if tokio::time::timeout(patience, self.sessions.wait()).await.is_err() {
            tracing::warn!(left = self.sessions.len(), "MQTT sessions did not end in time");
        }
    }
}
