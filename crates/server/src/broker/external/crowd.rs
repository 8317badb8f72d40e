//! One package in fan-out through an external broker: a window on the broker's acknowledgements,
//! and the subscribers as far as robots report them.

use std::collections::HashSet;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::BytesMut;
use task_proto::{Digest, RobotId};

use super::super::{FanOutError, Part, PartQos};
use super::{External, lock};

/// The package and the robots that have reported a subscription.
pub(in super::super) struct Crowd {
    external: Arc<External>,
    digest: Digest,
    qos: PartQos,
    listening: Mutex<HashSet<RobotId>>,
}

impl Crowd {
    pub(in super::super) fn new(external: Arc<External>, digest: Digest, qos: PartQos) -> Self {
        Self { external, digest, qos, listening: Mutex::default() }
    }

    pub(in super::super) fn told(&self, robot: &RobotId, is_listening: bool) {
        let mut listening = lock(&self.listening);
        if is_listening {
            listening.insert(robot.clone());
        } else {
            listening.remove(robot);
        }
    }

    pub(in super::super) fn listeners(&self) -> usize {
        lock(&self.listening).len()
    }

    pub(in super::super) fn is_listening(&self, robot: &RobotId) -> bool {
        lock(&self.listening).contains(robot)
    }

    pub(in super::super) fn queued_bytes(&self) -> usize {
        self.external.queued_part_bytes()
    }

    pub(in super::super) async fn publish(&self, part: Part) -> Result<(), FanOutError> {
        let mut payload = BytesMut::with_capacity(part.len());
        payload.extend_from_slice(&part.header);
        payload.extend_from_slice(&part.bytes);
        let sent = self.external.publish_part(self.digest, payload.freeze(), self.qos).await;
        sent.map_err(|_| FanOutError::BrokerAway)
    }

    pub(in super::super) async fn settle(&self, patience: Duration) {
        self.external.parts_acknowledged(patience).await;
    }
}
