//! What is to be said to a robot next: one payload, the newest. A slow robot neither blocks whoever rings nor fills
//! memory. It knows nothing of MQTT.

use std::sync::{Mutex, PoisonError};

use bytes::Bytes;
use tokio::sync::Notify;

/// One session's doorbell.
#[derive(Default)]
pub(super) struct Doorbell {
    slot: Mutex<Option<Bytes>>,
    rung: Notify,
}

impl Doorbell {
    /// Leaves `payload` in the place of what was there.
    pub(super) fn ring(&self, payload: Bytes) {
        *self.slot.lock().unwrap_or_else(PoisonError::into_inner) = Some(payload);
        self.rung.notify_one();
    }

    /// Takes the payload, as soon as there is one. Cancel-safe: nothing is taken unless it is returned.
    pub(super) async fn answer(&self) -> Bytes {
        loop {
            if let Some(payload) = self.slot.lock().unwrap_or_else(PoisonError::into_inner).take() {
                return payload;
            }
            self.rung.notified().await;
        }
    }
}
