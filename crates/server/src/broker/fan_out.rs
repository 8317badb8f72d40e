//! Fan-out of a package's parts to many robots at once, on `p/<digest>`. Only permitted robots
//! receive them, at the speed of the slowest subscriber, while the [`FanOut`] lives. A part is held
//! once, until all subscribers have taken it. Nothing is retained: a robot that subscribes late, or
//! drops out, gets the rest in another way.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use rumqttd::protocol::QoS;
use task_proto::messages::part;
use task_proto::{Digest, RobotId};
use tokio::time::{Instant, timeout};

use super::external::ExternalFanOut;
use super::front::{Front, Grant, NotGranted};

/// The largest part, with its header.
pub const MAX_PART_BYTES: usize = part::MAX_PART_BYTES as usize + part::HEADER_BYTES;
/// Interval between checks for subscribers that hold up the others.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// One message of a fan-out: a short header of its own, followed by shared bytes that are never
/// copied.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// The start of the payload.
    pub header: Bytes,
    /// The rest of the payload.
    pub bytes: Bytes,
}

impl Part {
    /// The size of the message's payload.
    pub fn len(&self) -> usize {
        self.header.len() + self.bytes.len()
    }

    /// Whether there is nothing to send.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The settings of a package's fan-out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FanOutSettings {
    /// The size of the package's parts: with large parts fewer are in flight at a time.
    pub part_bytes: usize,
    /// The quality of service, unless a robot's own subscription requests a lower one.
    pub qos: PartQos,
}

/// The quality of service of parts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum PartQos {
    /// Sent without acknowledgement: robots request lost parts again.
    AtMostOnce,
    #[default]
    AtLeastOnce,
    /// Acknowledged, released and completed.
    ExactlyOnce,
}

/// The reason why a package, or one of its parts, is not fanned out.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FanOutError {
    /// This package is already in fan-out.
    #[error("package {0} is already being fanned out")]
    AlreadyRunning(Digest),
    /// The maximum number of packages is in fan-out.
    #[error("the maximum number of packages is being fanned out")]
    TooMany,
    /// The part does not fit into a message.
    #[error("a part of {0} bytes is larger than {MAX_PART_BYTES}")]
    TooLarge(usize),
    /// There is no session at the external broker, or the broker accepts nothing.
    #[error("the external broker does not accept parts")]
    BrokerUnavailable,
}

/// A package in fan-out to many robots. Dropping the value ends the fan-out: robots receive no
/// further part and can't subscribe any more.
pub struct FanOut(Kind);

enum Kind {
    /// From the embedded broker's front, to permitted robots.
    Embedded(EmbeddedFanOut),
    /// Through an external broker, to its subscribers.
    External(ExternalFanOut),
}

struct EmbeddedFanOut {
    front: Arc<Front>,
    grant: Arc<Grant>,
}

impl FanOut {
    /// Lets `robots` subscribe to the package.
    pub(super) fn embedded(
        front: Arc<Front>,
        digest: Digest,
        settings: FanOutSettings,
        robots: Vec<RobotId>,
    ) -> Result<Self, FanOutError> {
        let qos = match settings.qos {
            PartQos::AtMostOnce => QoS::AtMostOnce,
            PartQos::AtLeastOnce => QoS::AtLeastOnce,
            PartQos::ExactlyOnce => QoS::ExactlyOnce,
        };
        let grant = front.grants().open(digest, settings.part_bytes, qos, robots, Instant::now());
        let grant = grant.map_err(|error| match error {
            NotGranted::AlreadyOpen => FanOutError::AlreadyRunning(digest),
            NotGranted::Full => FanOutError::TooMany,
        })?;
        Ok(Self(Kind::Embedded(EmbeddedFanOut { front, grant })))
    }

    /// Fans out at an external broker, where only the access control list restricts subscribers.
    pub(super) fn external(external: ExternalFanOut) -> Self {
        Self(Kind::External(external))
    }

    /// Lets further robots subscribe.
    pub fn admit(&self, robots: impl IntoIterator<Item = RobotId>) {
        if let Kind::Embedded(EmbeddedFanOut { grant, .. }) = &self.0 {
            grant.admit(robots);
        }
    }

    /// Records from a report whether the robot subscribes. The embedded front knows its
    /// subscribers; an external broker does not tell us.
    pub fn note_subscription(&self, robot: &RobotId, is_subscribed: bool) {
        if let Kind::External(external) = &self.0 {
            external.note_subscription(robot, is_subscribed);
        }
    }

    /// The number of robots that subscribe now.
    pub fn subscribers(&self) -> usize {
        match &self.0 {
            Kind::Embedded(EmbeddedFanOut { grant, .. }) => grant.subscribers(),
            Kind::External(external) => external.subscribers(),
        }
    }

    /// Whether the robot subscribes now.
    pub fn is_subscribed(&self, robot: &RobotId) -> bool {
        match &self.0 {
            Kind::Embedded(EmbeddedFanOut { grant, .. }) => grant.is_subscribed(robot),
            Kind::External(external) => external.is_subscribed(robot),
        }
    }

    /// Waits until a robot has subscribed since the last call. With an external broker only
    /// [`Self::note_subscription`] provides this information.
    pub async fn joined(&self) {
        match &self.0 {
            Kind::Embedded(EmbeddedFanOut { grant, .. }) => grant.joined().await,
            Kind::External(_) => std::future::pending().await,
        }
    }

    /// Withdraws the robot's permission.
    pub fn withdraw(&self, robot: &RobotId) {
        match &self.0 {
            Kind::Embedded(EmbeddedFanOut { grant, .. }) => grant.withdraw(robot, Instant::now()),
            // The robot may stay subscribed, but no longer counts.
            Kind::External(external) => external.note_subscription(robot, false),
        }
    }

    /// Robots that were removed since the last call because they held up the others.
    pub fn take_evicted(&self) -> Vec<RobotId> {
        match &self.0 {
            Kind::Embedded(EmbeddedFanOut { grant, .. }) => grant.take_evicted(),
            // The broker drops parts that a slow robot does not take; the robot's report lists
            // them.
            Kind::External(_) => Vec::new(),
        }
    }

    /// The bytes of the parts that are held for subscribers, all subscribers together.
    pub fn queued_bytes(&self) -> usize {
        match &self.0 {
            Kind::Embedded(EmbeddedFanOut { grant, .. }) => grant.queued_bytes(),
            Kind::External(external) => external.queued_bytes(),
        }
    }

    /// Sends the next part to all subscribers. Waits while the slowest is too far behind; a
    /// subscriber that holds up the others for long is removed. When this returns, the part is in
    /// flight and not yet delivered: robots report delivery.
    pub async fn publish(&mut self, part: Part) -> Result<(), FanOutError> {
        if part.len() > MAX_PART_BYTES {
            return Err(FanOutError::TooLarge(part.len()));
        }
        match &self.0 {
            Kind::Embedded(embedded) => embedded.publish(part).await,
            Kind::External(external) => return external.publish(part).await,
        }
        Ok(())
    }

    /// Waits until every subscriber, or the external broker, has acknowledged all parts or was
    /// removed, or until `patience` is over.
    pub async fn settle(&mut self, patience: Duration) {
        match &self.0 {
            Kind::Embedded(embedded) => embedded.settle(patience).await,
            Kind::External(external) => external.settle(patience).await,
        }
    }
}

impl EmbeddedFanOut {
    async fn publish(&self, part: Part) {
        while timeout(CHECK_INTERVAL, self.grant.room()).await.is_err() {
            self.evict_laggards();
        }
        self.grant.send(part, Instant::now());
    }

    async fn settle(&self, patience: Duration) {
        let until = Instant::now() + patience;
        while Instant::now() < until {
            if timeout(CHECK_INTERVAL, self.grant.all_idle()).await.is_ok() {
                return;
            }
            self.evict_laggards();
        }
    }

    fn evict_laggards(&self) {
        let robots = self.grant.evict_laggards(Instant::now());
        if !robots.is_empty() {
            tracing::info!(digest = %self.grant.digest(), ?robots, "removed robots that did not keep up from the fan-out");
        }
    }
}

impl Drop for EmbeddedFanOut {
    fn drop(&mut self) {
        self.front.grants().close(&self.grant);
    }
}
