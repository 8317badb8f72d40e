//! Sending a package's parts to many robots at once, on `p/<digest>`: to those it was granted to,
//! as fast as the slowest of them listens, and no longer than the [`FanOut`] lives. A part is held
//! once, and so long as somebody has not taken it. Nothing is retained: who subscribes late, or
//! falls out, gets the rest in another way.

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
/// How often it is looked who holds up the others.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);

/// One message of a fan-out: a few bytes of its own before bytes that nobody copies.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// What comes first.
    pub header: Bytes,
    /// The rest.
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

/// How a package is fanned out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FanOutSettings {
    /// The size of its parts: few large ones are on their way at a time, more small ones.
    pub part_bytes: usize,
    /// The quality of service, if a robot's own subscription does not ask for less.
    pub qos: PartQos,
}

/// The quality of service of parts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum PartQos {
    /// Sent, and that is all: what is lost is asked for again.
    AtMostOnce,
    /// Acknowledged.
    #[default]
    AtLeastOnce,
    /// Acknowledged, released and completed.
    ExactlyOnce,
}

/// Why a package, or a part of it, is not fanned out.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FanOutError {
    /// This package is being fanned out already.
    #[error("package {0} is being fanned out already")]
    UnderWay(Digest),
    /// As many packages as there may be are being fanned out.
    #[error("as many packages as there may be are being fanned out")]
    Busy,
    /// The part does not fit into a message.
    #[error("a part of {0} bytes is larger than {MAX_PART_BYTES}")]
    TooLarge(usize),
    /// There is no session at the external broker, or it takes nothing.
    #[error("the external broker takes no parts")]
    BrokerAway,
}

/// A package on its way to many. Dropped, it ends: robots hear no further part and can't subscribe
/// any more.
pub struct FanOut(Way);

enum Way {
    /// From our own front, to those it was granted to.
    Embedded(Granted),
    /// Through another broker, to whoever subscribed there.
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

    /// At an external broker, whose access control list alone says who may listen.
    pub(super) fn at(crowd: Crowd) -> Self {
        Self(Way::External(crowd))
    }

    /// Lets further robots subscribe.
    pub fn admit(&self, robots: impl IntoIterator<Item = RobotId>) {
        if let Way::Embedded(Granted { grant, .. }) = &self.0 {
            grant.admit(robots);
        }
    }

    /// A report says whether the robot listens. Our own front knows by itself, an external broker
    /// does not tell.
    pub fn told(&self, robot: &RobotId, is_listening: bool) {
        if let Way::External(crowd) = &self.0 {
            crowd.told(robot, is_listening);
        }
    }

    /// How many robots listen now.
    pub fn listeners(&self) -> usize {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.listeners(),
            Way::External(crowd) => crowd.listeners(),
        }
    }

    /// Whether the robot listens now.
    pub fn is_listening(&self, robot: &RobotId) -> bool {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.is_listening(robot),
            Way::External(crowd) => crowd.is_listening(robot),
        }
    }

    /// Waits until somebody has begun to listen since this was waited for last. Through an external
    /// broker only [`Self::told`] says so.
    pub async fn joined(&self) {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.joined().await,
            Way::External(_) => std::future::pending().await,
        }
    }

    /// The robot may no longer hear it.
    pub fn withdraw(&self, robot: &RobotId) {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.withdraw(robot, Instant::now()),
            // It may go on listening, which is not counted any more.
            Way::External(crowd) => crowd.told(robot, false),
        }
    }

    /// Robots that held up the others and were put out since this was asked last.
    pub fn take_put_out(&self) -> Vec<RobotId> {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.take_put_out(),
            // What a slow robot does not take the broker drops; its report says so.
            Way::External(_) => Vec::new(),
        }
    }

    /// The bytes of the parts that are held for listeners, all listeners together.
    pub fn queued_bytes(&self) -> usize {
        match &self.0 {
            Way::Embedded(Granted { grant, .. }) => grant.queued_bytes(),
            Way::External(crowd) => crowd.queued_bytes(),
        }
    }

    /// Sends the next part to all who listen. Waits while the slowest of them is too far behind;
    /// whoever holds up the others for long is put out. Once this returns the part is on its way,
    /// not there: what arrived, robots report.
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

    /// Waits until every listener, or the external broker, has acknowledged all that was sent, or
    /// was put out, or `patience` is over.
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
