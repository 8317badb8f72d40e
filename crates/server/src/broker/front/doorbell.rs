//! Pending messages for a robot: the newest desired state, and the questions not yet sent. A slow
//! robot neither blocks the senders nor fills memory. This module knows nothing of MQTT.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use tokio::sync::Notify;

/// Maximum pending questions for one robot.
const MAX_QUESTIONS: usize = 32;

#[derive(Default)]
pub(super) struct Doorbell {
    waiting: Mutex<Waiting>,
    rung: Notify,
    asked: Notify,
}

#[derive(Default)]
struct Waiting {
    state: Option<Bytes>,
    questions: VecDeque<Bytes>,
}

impl Doorbell {
    /// Stores `payload`, replacing an earlier one.
    pub(super) fn ring(&self, payload: Bytes) {
        self.waiting().state = Some(payload);
        self.rung.notify_one();
    }

    /// Removes a payload that was stored for the previous session.
    pub(super) fn forget_state(&self) {
        self.waiting().state = None;
    }

    /// Takes the payload, as soon as there is one. Cancel-safe: nothing is taken unless it is
    /// returned.
    pub(super) async fn answer(&self) -> Bytes {
        loop {
            if let Some(payload) = self.waiting().state.take() {
                return payload;
            }
            self.rung.notified().await;
        }
    }

    /// Adds a question; false if too many are pending.
    pub(super) fn ask(&self, payload: Bytes) -> bool {
        let mut waiting = self.waiting();
        let has_room = waiting.questions.len() < MAX_QUESTIONS;
        if has_room {
            waiting.questions.push_back(payload);
            self.asked.notify_one();
        }
        has_room
    }

    /// Takes the next question, as soon as there is one. Cancel-safe: nothing is taken unless it is
    /// returned.
    pub(super) async fn question(&self) -> Bytes {
        loop {
            if let Some(payload) = self.waiting().questions.pop_front() {
                return payload;
            }
            self.asked.notified().await;
        }
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn only_the_newest_state_waits_but_every_question_up_to_a_bound() {
        let doorbell = Doorbell::default();
        doorbell.ring(Bytes::from_static(b"old"));
        doorbell.ring(Bytes::from_static(b"new"));
        assert_eq!(doorbell.answer().await, "new");
        let accepted =
            (0..MAX_QUESTIONS + 3).filter(|number| doorbell.ask(number.to_string().into())).count();
        assert_eq!(accepted, MAX_QUESTIONS);
        assert_eq!(
            (doorbell.question().await, doorbell.question().await),
            ("0".into(), "1".into())
        );
        assert!(doorbell.ask(Bytes::from_static(b"later")));
    }
}
