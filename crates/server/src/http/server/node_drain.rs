//! The way of a server out of service: first a balancer notices, then the robots' sessions end one
//! after the other. This module never stops the server.

use std::time::Duration;

use super::readiness::Readiness;
use crate::broker::Broker;

/// Time of an ordered drain without the setting `drain`.
const ORDERED_TIME: Duration = Duration::from_secs(10);

/// The parts of a server that take leave.
#[derive(Clone)]
pub struct NodeDrain {
    readiness: Readiness,
    broker: Broker,
    time: Duration,
}

impl NodeDrain {
    /// With the setting `drain`.
    pub fn new(broker: Broker, time: Duration) -> Self {
        Self { readiness: Readiness::default(), broker, time }
    }

    /// The readiness that ends with a drain.
    pub fn readiness(&self) -> Readiness {
        self.readiness.clone()
    }

    /// Drains before a stop, within the setting's time.
    pub async fn before_stop(&self) {
        if !self.time.is_zero() {
            self.readiness.begin_stop();
            self.leave(self.time).await;
        }
    }

    /// Begins to drain. The server goes on serving.
    pub fn begin(&self) {
        if self.readiness.is_draining() {
            return;
        }
        self.readiness.begin_drain();
        let time = if self.time.is_zero() { ORDERED_TIME } else { self.time };
        let drain = self.clone();
        tokio::spawn(async move { drain.leave(time).await });
    }

    async fn leave(&self, time: Duration) {
        tokio::time::sleep(time / 2).await;
        self.broker.drain(time / 2).await;
    }
}
