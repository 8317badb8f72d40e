//! Detects violations in a robot's session: each packet counts against the limits, and each end of
//! a session is classified.

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Instant, sleep_until};

use super::{End, Session};
use crate::broker::front::codec::{DecodeError, Received};
use crate::limits::conduct::{Offence, Verdict};

/// Maximum refused subscriptions that a robot may attempt in one session.
const MAX_REFUSED_FILTERS: u32 = 16;
/// Progress of an unfinished packet that counts as activity: a client that sends more slowly counts
/// as silent.
const HEARD_BYTES: usize = 1024;

impl End {
    /// The violation behind this end, if a correct robot would never cause it. (Floods have been
    /// detected before.)
    pub(super) fn offence(self) -> Option<Offence> {
        match self {
            Self::Malformed(DecodeError::TooLarge(bytes)) => Some(Offence::TooLarge(bytes)),
            Self::Malformed(DecodeError::Retained) => {
                Some(Offence::Violation("sends messages to be retained"))
            }
            Self::Malformed(_) => Some(Offence::Violation("sends what is no MQTT")),
            Self::Violation(what) => Some(Offence::Violation(what)),
            _ => None,
        }
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Session<'_, S> {
    /// Counts a packet of the robot. A packet beyond the limits is the last one for a while; if the
    /// excess continues, the last one of the session.
    pub(super) fn weigh(&mut self, received: &Received, bytes: usize) -> Result<(), End> {
        let Some(watched) = self.watched else { return Ok(()) };
        let messages = u64::from(!received.is_answer());
        match watched.sent(messages, bytes as u64, self.heard_at) {
            Verdict::Fine => {}
            Verdict::Slow(until) => self.slowed_until = Some(until),
            Verdict::Cut(_) => return Err(End::Flood),
        }
        Ok(())
    }

    /// A client that sends a large packet over a slow network is not silent meanwhile.
    pub(super) fn hear_progress(&mut self) {
        if self.input.len() >= self.heard_bytes + HEARD_BYTES {
            (self.heard_at, self.heard_bytes) = (Instant::now(), self.input.len());
        }
    }

    /// Counts a refused subscription of a robot.
    pub(super) fn refuse_filter(&mut self) -> Result<(), End> {
        self.refused_filters += 1;
        if self.watched.is_some() && self.refused_filters > MAX_REFUSED_FILTERS {
            return Err(End::Violation("goes on subscribing to what is not for it"));
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
