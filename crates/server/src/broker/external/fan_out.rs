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
pub(in super::super) struct ExternalFanOut {
    external: Arc<External>,
    digest: Digest,
    qos: PartQos,
    subscribed: Mutex<HashSet<RobotId>>,
}

impl ExternalFanOut {
    pub(in super::super) fn new(external: Arc<External>, digest: Digest, qos: PartQos) -> Self {
        Self { external, digest, qos, subscribed: Mutex::default() }
    }

    pub(in super::super) fn note_subscription(&self, robot: &RobotId, is_subscribed: bool) {
        let mut subscribed = lock(&self.subscribed);
        if is_subscribed {
            subscribed.insert(robot.clone());
        } else {
            subscribed.remove(robot);
        }
    }

    pub(in super::super) fn subscribers(&self) -> usize {
        lock(&self.subscribed).len()
    }

    pub(in super::super) fn is_subscribed(&self, robot: &RobotId) -> bool {
        lock(&self.subscribed).contains(robot)
    }

    pub(in super::super) fn queued_bytes(&self) -> usize {
        self.external.queued_part_bytes()
    }

    pub(in super::super) async fn publish(&self, part: Part) -> Result<(), FanOutError> {
        let mut payload = BytesMut::with_capacity(part.len());
        payload.extend_from_slice(&part.header);
        payload.extend_from_slice(&part.bytes);
        let sent = self.external.publish_part(self.digest, payload.freeze(), self.qos).await;
        sent.map_err(|_| FanOutError::BrokerUnavailable)
    }

    pub(in super::super) async fn settle(&self, patience: Duration) {
        self.external.parts_acknowledged(patience).await;
    }
}
