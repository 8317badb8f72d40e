//! Detects violations in a robot's session: each packet counts against the limits, and each end of
//! a session is classified.

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Instant, sleep_until};

use super::{End, Session};
use crate::broker::front::codec::{DecodeError, Received};
use crate::domain::limits::robot_limiter::{Verdict, Violation};

/// Maximum refused subscriptions that a robot may attempt in one session.
const MAX_REFUSED_FILTERS: u32 = 16;
/// Progress of an unfinished packet that counts as activity: a client that sends more slowly counts
/// as silent.
const PROGRESS_BYTES: usize = 1024;

impl End {
    /// The violation behind this end, if a correct robot would never cause it. (Floods have been
    /// detected before.)
    pub(super) fn violation(self) -> Option<Violation> {
        match self {
            Self::Malformed(DecodeError::TooLarge(bytes)) => Some(Violation::TooLarge(bytes)),
            Self::Malformed(DecodeError::Retained) => {
                Some(Violation::Protocol("publishes retained messages"))
            }
            Self::Malformed(_) => {
                Some(Violation::Protocol("sends packets that are not valid MQTT"))
            }
            Self::Violation(text) => Some(Violation::Protocol(text)),
            _ => None,
        }
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Session<'_, S> {
    /// Counts a packet of the robot. A packet beyond the limits is the last one for a while; if the
    /// excess continues, the last one of the session.
    pub(super) fn count_packet(&mut self, received: &Received, bytes: usize) -> Result<(), End> {
        let Some(rate_limit) = self.rate_limit else { return Ok(()) };
        let messages = u64::from(!received.is_answer());
        match rate_limit.count(messages, bytes as u64, self.received_at) {
            Verdict::Fine => {}
            Verdict::Slow(until) => self.slowed_until = Some(until),
            Verdict::Cut(_) => return Err(End::RateLimited),
        }
        Ok(())
    }

    /// A client that sends a large packet over a slow network is not silent meanwhile.
    pub(super) fn note_progress(&mut self) {
        if self.input.len() >= self.received_bytes + PROGRESS_BYTES {
            (self.received_at, self.received_bytes) = (Instant::now(), self.input.len());
        }
    }

    /// Counts a refused subscription of a robot.
    pub(super) fn refuse_filter(&mut self) -> Result<(), End> {
        self.refused_filters += 1;
        if self.rate_limit.is_some() && self.refused_filters > MAX_REFUSED_FILTERS {
            return Err(End::Violation("keeps subscribing to topics that it may not read"));
        }
        Ok(())
    }
}

/// Resolves at this time; never if `None`.
pub(super) async fn until(at: Option<Instant>) {
    match at {
        Some(at) => sleep_until(at).await,
        None => std::future::pending().await,
    }
}
