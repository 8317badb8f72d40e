//! Pending messages for a robot: the newest desired state, and the requests not yet sent. A slow
//! robot neither blocks the senders nor fills memory. This module knows nothing of MQTT.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use tokio::sync::Notify;

/// Maximum pending requests for one robot.
const MAX_REQUESTS: usize = 32;

#[derive(Default)]
pub(in crate::broker::front) struct RobotMailbox {
    pending: Mutex<Pending>,
    desired_set: Notify,
    request_added: Notify,
}

#[derive(Default)]
struct Pending {
    desired: Option<Bytes>,
    requests: VecDeque<Bytes>,
}

impl RobotMailbox {
    /// Stores `payload`, replacing an earlier one.
    pub(in crate::broker::front) fn set_desired(&self, payload: Bytes) {
        self.pending().desired = Some(payload);
        self.desired_set.notify_one();
    }

    /// Removes a payload that was stored for the previous session.
    pub(in crate::broker::front) fn clear_desired(&self) {
        self.pending().desired = None;
    }

    /// Takes the payload, as soon as there is one. Cancel-safe: nothing is taken unless it is
    /// returned.
    pub(in crate::broker::front) async fn next_desired(&self) -> Bytes {
        loop {
            if let Some(payload) = self.pending().desired.take() {
                return payload;
            }
            self.desired_set.notified().await;
        }
    }

    /// Adds a request; false if too many are pending.
    pub(in crate::broker::front) fn add_request(&self, payload: Bytes) -> bool {
        let mut pending = self.pending();
        let has_room = pending.requests.len() < MAX_REQUESTS;
        if has_room {
            pending.requests.push_back(payload);
            self.request_added.notify_one();
        }
        has_room
    }

    /// Takes the next request, as soon as there is one. Cancel-safe: nothing is taken unless it is
    /// returned.
    pub(in crate::broker::front) async fn next_request(&self) -> Bytes {
        loop {
            if let Some(payload) = self.pending().requests.pop_front() {
                return payload;
            }
            self.request_added.notified().await;
        }
    }

    fn pending(&self) -> MutexGuard<'_, Pending> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn newest_state_and_a_bounded_number_of_requests_are_kept() {
        let mailbox = RobotMailbox::default();
        mailbox.set_desired(Bytes::from_static(b"old"));
        mailbox.set_desired(Bytes::from_static(b"new"));
        assert_eq!(mailbox.next_desired().await, "new");
        let accepted = (0..MAX_REQUESTS + 3)
            .filter(|number| mailbox.add_request(number.to_string().into()))
            .count();
        assert_eq!(accepted, MAX_REQUESTS);
        assert_eq!(
            (mailbox.next_request().await, mailbox.next_request().await),
            ("0".into(), "1".into())
        );
        assert!(mailbox.add_request(Bytes::from_static(b"later")));
    }
}
