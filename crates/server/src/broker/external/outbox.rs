//! Messages to publish at an external broker: questions before desired states before parts of
//! packages, and only the newest desired state of each robot. The outbox is closed without a
//! session: callers then get an error.

use std::collections::{HashMap, VecDeque};

use bytes::Bytes;
use task_proto::RobotId;
use task_proto::topic::{RobotTopic, Topic};
use tokio::sync::OwnedSemaphorePermit;

use super::super::{NotAsked, NotConnected, PartQos};

/// Maximum pending questions, equal to the maximum in the whole server.
const MAX_QUESTIONS: usize = 1024;
/// Bytes of pending desired states above which callers should wait.
const MANY_STATE_BYTES: usize = 32 * 1024 * 1024;

#[derive(Default)]
pub(super) struct Outbox {
    is_open: bool,
    questions: VecDeque<(RobotId, Bytes)>,
    /// The robots with pending states, the first one first, and the states.
    rung: VecDeque<RobotId>,
    states: HashMap<RobotId, Bytes>,
    state_bytes: usize,
    parts: VecDeque<Letter>,
}

/// The next message to publish.
pub(super) struct Letter {
    pub(super) topic: Topic,
    pub(super) payload: Bytes,
    pub(super) qos: PartQos,
    /// Freed once the broker has acknowledged the message.
    pub(super) place: Option<OwnedSemaphorePermit>,
}

impl Outbox {
    /// A session is live.
    pub(super) fn open(&mut self) {
        self.is_open = true;
    }

    /// The session has ended; pending messages are dropped.
    pub(super) fn close(&mut self) {
        *self = Self::default();
    }

    pub(super) fn is_open(&self) -> bool {
        self.is_open
    }

    /// Whether there is room for many more desired states.
    pub(super) fn has_room(&self) -> bool {
        self.state_bytes < MANY_STATE_BYTES
    }

    pub(super) fn ring(&mut self, robot: &RobotId, payload: Bytes) -> Result<(), NotConnected> {
        if !self.is_open {
            return Err(NotConnected);
        }
        self.state_bytes += payload.len();
        match self.states.insert(robot.clone(), payload) {
            Some(before) => self.state_bytes -= before.len(),
            None => self.rung.push_back(robot.clone()),
        }
        Ok(())
    }

    pub(super) fn ask(&mut self, robot: &RobotId, payload: Bytes) -> Result<(), NotAsked> {
        if !self.is_open {
            return Err(NotAsked::NotConnected);
        }
        if self.questions.len() >= MAX_QUESTIONS {
            return Err(NotAsked::Busy);
        }
        self.questions.push_back((robot.clone(), payload));
        Ok(())
    }

    /// Adds a part of a package; the window bounds the number of pending parts.
    pub(super) fn part(&mut self, part: Letter) -> Result<(), NotConnected> {
        if !self.is_open {
            return Err(NotConnected);
        }
        self.parts.push_back(part);
        Ok(())
    }

    pub(super) fn next(&mut self) -> Option<Letter> {
        let to = |robot, topic, payload| {
            Some(Letter {
                topic: Topic::Robot(robot, topic),
                payload,
                qos: PartQos::AtLeastOnce,
                place: None,
            })
        };
        if let Some((robot, payload)) = self.questions.pop_front() {
            return to(robot, RobotTopic::Request, payload);
        }
        if let Some(robot) = self.rung.pop_front() {
            let payload = self.states.remove(&robot).unwrap_or_default();
            self.state_bytes -= payload.len();
            return to(robot, RobotTopic::Desired, payload);
        }
        self.parts.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use task_proto::Digest;
    use tokio::sync::Semaphore;

    #[test]
    fn questions_go_before_states_before_parts_and_of_states_the_newest() {
        let (robot, topic) = (RobotId::random(), Topic::Package(Digest::of(b"x")));
        let place = Some(Arc::new(Semaphore::new(1)).try_acquire_owned().expect("free"));
        let mut outbox = Outbox::default();
        assert_eq!(outbox.ring(&robot, "lost".into()), Err(NotConnected));
        assert_eq!(outbox.ask(&robot, "lost".into()), Err(NotAsked::NotConnected));
        outbox.open();
        outbox
            .part(Letter { topic, payload: "part".into(), qos: PartQos::AtMostOnce, place })
            .expect("open");
        outbox.ring(&robot, "older".into()).expect("open");
        outbox.ring(&robot, "newer".into()).expect("open");
        outbox.ask(&robot, "question".into()).expect("open");
        let mut order = Vec::new();
        while let Some(letter) = outbox.next() {
            order.push(letter.payload);
        }
        assert_eq!(order, ["question", "newer", "part"]);
        assert_eq!(outbox.state_bytes, 0);
    }

    #[test]
    fn what_waits_is_bounded_and_gone_with_the_session() {
        let (robot, mut outbox) = (RobotId::random(), Outbox::default());
        outbox.open();
        let asked = (0..).take_while(|_| outbox.ask(&robot, Bytes::new()).is_ok()).count();
        assert_eq!(asked, MAX_QUESTIONS);
        outbox.ring(&robot, vec![0; MANY_STATE_BYTES].into()).expect("open");
        assert!(!outbox.has_room());
        outbox.close();
        assert!(outbox.has_room() && !outbox.is_open() && outbox.next().is_none());
    }
}
