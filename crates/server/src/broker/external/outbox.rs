//! Messages to publish at an external broker: requests before desired states before parts of
//! packages, and only the newest desired state of each robot. The outbox is closed without a
//! session: callers then get an error.

use std::collections::{HashMap, VecDeque};

use bytes::Bytes;
use task_proto::RobotId;
use task_proto::messages::topic::{RobotTopic, Topic};
use tokio::sync::OwnedSemaphorePermit;

use super::super::{NotConnected, NotSent, PartQos};

/// Maximum pending requests, equal to the maximum in the whole server.
const MAX_REQUESTS: usize = 1024;
/// Bytes of pending desired states above which callers should wait.
const MAX_STATE_BYTES: usize = 32 * 1024 * 1024;

#[derive(Default)]
pub(super) struct Outbox {
    is_open: bool,
    requests: VecDeque<(RobotId, Bytes)>,
    /// The robots with pending states, the first one first, and the states.
    order: VecDeque<RobotId>,
    states: HashMap<RobotId, Bytes>,
    state_bytes: usize,
    parts: VecDeque<OutgoingMessage>,
}

/// The next message to publish.
pub(super) struct OutgoingMessage {
    pub(super) topic: Topic,
    pub(super) payload: Bytes,
    pub(super) qos: PartQos,
    /// Freed once the broker has acknowledged the message.
    pub(super) permit: Option<OwnedSemaphorePermit>,
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
        self.state_bytes < MAX_STATE_BYTES
    }

    pub(super) fn set_desired(
        &mut self,
        robot: &RobotId,
        payload: Bytes,
    ) -> Result<(), NotConnected> {
        if !self.is_open {
            return Err(NotConnected);
        }
        self.state_bytes += payload.len();
        match self.states.insert(robot.clone(), payload) {
            Some(before) => self.state_bytes -= before.len(),
            None => self.order.push_back(robot.clone()),
        }
        Ok(())
    }

    pub(super) fn add_request(&mut self, robot: &RobotId, payload: Bytes) -> Result<(), NotSent> {
        if !self.is_open {
            return Err(NotSent::NotConnected);
        }
        if self.requests.len() >= MAX_REQUESTS {
            return Err(NotSent::Busy);
        }
        self.requests.push_back((robot.clone(), payload));
        Ok(())
    }

    /// Adds a part of a package; the window bounds the number of pending parts.
    pub(super) fn add_part(&mut self, part: OutgoingMessage) -> Result<(), NotConnected> {
        if !self.is_open {
            return Err(NotConnected);
        }
        self.parts.push_back(part);
        Ok(())
    }

    pub(super) fn next(&mut self) -> Option<OutgoingMessage> {
        let to = |robot, topic, payload| {
            Some(OutgoingMessage {
                topic: Topic::Robot(robot, topic),
                payload,
                qos: PartQos::AtLeastOnce,
                permit: None,
            })
        };
        if let Some((robot, payload)) = self.requests.pop_front() {
            return to(robot, RobotTopic::Request, payload);
        }
        if let Some(robot) = self.order.pop_front() {
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
    fn requests_precede_states_precede_parts_and_only_the_newest_state_is_sent() {
        let (robot, topic) = (RobotId::random(), Topic::Package(Digest::of(b"x")));
        let permit = Some(Arc::new(Semaphore::new(1)).try_acquire_owned().expect("free"));
        let mut outbox = Outbox::default();
        assert_eq!(outbox.set_desired(&robot, "lost".into()), Err(NotConnected));
        assert_eq!(outbox.add_request(&robot, "lost".into()), Err(NotSent::NotConnected));
        outbox.open();
        outbox
            .add_part(OutgoingMessage {
                topic,
                payload: "part".into(),
                qos: PartQos::AtMostOnce,
                permit,
            })
            .expect("open");
        outbox.set_desired(&robot, "older".into()).expect("open");
        outbox.set_desired(&robot, "newer".into()).expect("open");
        outbox.add_request(&robot, "request".into()).expect("open");
        let mut order = Vec::new();
        while let Some(message) = outbox.next() {
            order.push(message.payload);
        }
        assert_eq!(order, ["request", "newer", "part"]);
        assert_eq!(outbox.state_bytes, 0);
    }

    #[test]
    fn outbox_is_bounded_and_cleared_with_the_session() {
        let (robot, mut outbox) = (RobotId::random(), Outbox::default());
        outbox.open();
        let accepted =
            (0..).take_while(|_| outbox.add_request(&robot, Bytes::new()).is_ok()).count();
        assert_eq!(accepted, MAX_REQUESTS);
        outbox.set_desired(&robot, vec![0; MAX_STATE_BYTES].into()).expect("open");
        assert!(!outbox.has_room());
        outbox.close();
        assert!(outbox.has_room() && !outbox.is_open() && outbox.next().is_none());
    }
}
