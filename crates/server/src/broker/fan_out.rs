//! Sending a package's parts to many robots at once, on `p/<digest>` through the router: to those it was granted to, as
//! fast as the slowest of them listens, and no longer than the [`FanOut`] lives. Nothing is retained: who subscribes
//! late, or falls out, gets the rest in another way.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use task_proto::{Digest, RobotId};

use super::front::{Front, Grant, NotGranted};

/// The largest part.
pub const MAX_PART_BYTES: usize = 128 * 1024;
/// How long a listener may hold up all others; a session that reads nothing ends sooner by itself.
const PATIENCE: Duration = Duration::from_secs(30);
/// For a router that is behind to catch up a little, and how often it gets that chance.
const ROUTER_PAUSE: Duration = Duration::from_millis(10);
const ROUTER_PAUSES: u32 = 500;

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
    /// The router takes nothing.
    #[error("the message router does not keep up")]
    RouterBehind,
}

/// A package on its way to many. Dropped, it ends: robots hear no further part and can't subscribe any more.
pub struct FanOut {
    front: Arc<Front>,
    grant: Arc<Grant>,
}

impl FanOut {
    /// Lets `robots` subscribe to the package.
    pub(super) fn begin(front: Arc<Front>, digest: Digest, robots: Vec<RobotId>) -> Result<Self, FanOutError> {
        let grant = front.grants().open(digest, robots).map_err(|error| match error {
            NotGranted::UnderWay => FanOutError::UnderWay(digest),
            NotGranted::Full => FanOutError::Busy,
        })?;
        Ok(Self { front, grant })
    }

    /// How many robots listen now.
    pub fn listeners(&self) -> usize {
        self.grant.listeners()
    }

    /// The robot may no longer hear it.
    pub fn withdraw(&self, robot: &RobotId) {
        self.grant.withdraw(robot);
    }

    /// Sends the next part to all who listen. Waits while the slowest of them is too far behind; whoever holds up the
    /// others for long is put out. Once this returns the part is on its way, not there: what arrived, robots report.
    pub async fn publish(&mut self, part: Bytes) -> Result<(), FanOutError> {
        if part.len() > MAX_PART_BYTES {
            return Err(FanOutError::TooLarge(part.len()));
        }
        let number = loop {
            match tokio::time::timeout(PATIENCE, self.grant.room()).await {
                Ok(number) => break number,
                Err(_) => {
                    let robots = self.grant.put_out_stragglers();
                    tracing::info!(digest = %self.grant.digest(), ?robots, "robots that did not keep up are put out");
                }
            }
        };
        for _ in 0..ROUTER_PAUSES {
            if self.front.publish_part(&self.grant, number, part.clone()) {
                return Ok(());
            }
            tokio::time::sleep(ROUTER_PAUSE).await;
        }
        Err(FanOutError::RouterBehind)
    }
}

impl Drop for FanOut {
    fn drop(&mut self) {
        self.front.grants().close(&self.grant);
    }
}
