//! Fan-out of a package's parts to many robots at once, on `p/<digest>`. Only permitted robots
//! receive them, at the speed of the slowest subscriber, while the [`FanOut`] lives. A part is held
//! once, until all subscribers have taken it. Nothing is retained: a robot that subscribes late, or
//! drops out, gets the rest in another way.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use rumqttd::protocol::QoS;
use task_proto::{Digest, RobotId, part};
use tokio::time::{Instant, timeout};

use super::external::Crowd;
use super::front::{Front, Grant, NotGranted};

/// The largest part, with its header.
pub const MAX_PART_BYTES: usize = part::MAX_PART_BYTES as usize + part::HEADER_BYTES;
/// Interval between checks for subscribers that hold up the others.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);

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
    #[error("package {0} is being fanned out already")]
    UnderWay(Digest),
    /// The maximum number of packages is in fan-out.
    #[error("as many packages as there may be are being fanned out")]
    Busy,
    /// The part does not fit into a message.
    #[error("a part of {0} bytes is larger than {MAX_PART_BYTES}")]
    TooLarge(usize),
    /// There is no session at the external broker, or the broker accepts nothing.
    #[error("the external broker takes no parts")]
    BrokerAway,
}

/// A package in fan-out to many robots. Dropping the value ends the fan-out: robots receive no
/// further part and can't subscribe any more.
pub struct FanOut(Way);

enum Way {
    /// From the embedded broker's front, to permitted robots.
    Embedded(Granted),
    /// Through an external broker, to its subscribers.
    External(Crowd),
}

struct Granted {
    front: Arc<Front>,
    grant: Arc<Grant>,
}

impl FanOut {
    /// Lets `robots` subscribe to the package.
    pub(super) fn begin(
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
            NotGranted::UnderWay => FanOutError::UnderWay(digest),
            NotGranted::Full => FanOutError::Busy,
        })?;
        Ok(Self(Way::Embedded(Granted { front, grant })))
    }

    /// Fans out at an external broker, where only the access control list restricts subscribers.
    pub(super) fn at(crowd: Crowd) -> Self {
        Self(Way::External(crowd))
    }

    /// Lets further robots subscribe.
    pub fn admit(&self, robots: impl IntoIterator<Item = RobotId>) {
        if let Way::Embedded(Granted { grant, .. }) = &self.0 {
            grant.admit(robots);
        }
    }

    /// Records from a report whether the robot subscribes. The embedded front knows its
    /// subscribers; an external broker does not tell us.
    pub fn told(&self, robot: &RobotId, is_listening: bool) {
        if let Way::External(crowd) = &self.0 {
            crowd.told(robot, is_listening);
        }
    }

    /// The number of robots that subscribe now.
    pub fn listeners(&self) -> usize {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.listeners(),
            Way::External(crowd) => crowd.listeners(),
        }
    }

    /// Whether the robot subscribes now.
    pub fn is_listening(&self, robot: &RobotId) -> bool {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.is_listening(robot),
            Way::External(crowd) => crowd.is_listening(robot),
        }
    }

    /// Waits until a robot has subscribed since the last call. With an external broker only
    /// [`Self::told`] provides this information.
    pub async fn joined(&self) {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.joined().await,
            Way::External(_) => std::future::pending().await,
        }
    }

    /// Withdraws the robot's permission.
    pub fn withdraw(&self, robot: &RobotId) {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.withdraw(robot, Instant::now()),
            // The robot may stay subscribed, but no longer counts.
            Way::External(crowd) => crowd.told(robot, false),
        }
    }

    /// Robots that were removed since the last call because they held up the others.
    pub fn take_put_out(&self) -> Vec<RobotId> {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.take_put_out(),
            // The broker drops parts that a slow robot does not take; the robot's report lists
            // them.
            Way::External(_) => Vec::new(),
        }
    }

    /// The bytes of the parts that are held for subscribers, all subscribers together.
    pub fn queued_bytes(&self) -> usize {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.queued_bytes(),
            Way::External(crowd) => crowd.queued_bytes(),
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
            Way::Embedded(granted) => granted.publish(part).await,
            Way::External(crowd) => return crowd.publish(part).await,
        }
        Ok(())
    }

    /// Waits until every subscriber, or the external broker, has acknowledged all parts or was
    /// removed, or until `patience` is over.
    pub async fn settle(&mut self, patience: Duration) {
        match &self.0 {
            Way::Embedded(granted) => granted.settle(patience).await,
            Way::External(crowd) => crowd.settle(patience).await,
        }
    }
}

impl Granted {
    async fn publish(&self, part: Part) {
        while timeout(LOOK_INTERVAL, self.grant.room()).await.is_err() {
            self.put_out_laggards();
        }
        self.grant.send(part, Instant::now());
    }

    async fn settle(&self, patience: Duration) {
        let until = Instant::now() + patience;
        while Instant::now() < until {
            if timeout(LOOK_INTERVAL, self.grant.all_idle()).await.is_ok() {
                return;
            }
            self.put_out_laggards();
        }
    }

    fn put_out_laggards(&self) {
        let robots = self.grant.put_out_laggards(Instant::now());
        if !robots.is_empty() {
            tracing::info!(digest = %self.grant.digest(), ?robots, "robots that did not keep up are put out");
        }
    }
}

impl Drop for Granted {
    fn drop(&mut self) {
        self.front.grants().close(&self.grant);
    }
}
