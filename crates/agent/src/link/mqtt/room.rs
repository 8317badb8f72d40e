//! How large a message a session reads. It can't change while the session lasts.

use super::{AROUND_MESSAGE_BYTES, MAX_MESSAGE_BYTES, MqttAccess};
use crate::link::state::Shared;

/// The largest message, and what it is for.
#[derive(Clone, Copy)]
pub(super) struct MessageRoom {
    pub(super) bytes: usize,
    /// Whether it has to hold whole packages.
    holds_packages: bool,
}

impl MessageRoom {
    pub(super) fn of(access: &MqttAccess, shared: &Shared, holds_packages: bool) -> Self {
        let wanted = if holds_packages { Self::for_wanted(shared) } else { 0 };
        Self { bytes: wanted.max(access.message_bytes), holds_packages }
    }

    /// What the largest wanted package takes as one message.
    fn for_wanted(shared: &Shared) -> usize {
        let message = shared.listening.largest_bytes().saturating_add(AROUND_MESSAGE_BYTES as u64);
        usize::try_from(message.min(MAX_MESSAGE_BYTES)).unwrap_or(usize::MAX)
    }

    /// Whether a message of a wanted package does not fit.
    pub(super) fn is_too_narrow(&self, shared: &Shared) -> bool {
        self.holds_packages && Self::for_wanted(shared) > self.bytes
    }

    /// Whether a message of `bytes` did not fit, and may be one of a wanted package.
    pub(super) fn was_too_narrow(&self, bytes: usize, shared: &Shared) -> bool {
        bytes > self.bytes && bytes <= Self::for_wanted(shared)
    }
}
