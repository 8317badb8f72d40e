//! The message size limit of a session, which is fixed for the lifetime of the session.

use super::{AROUND_MESSAGE_BYTES, MAX_MESSAGE_BYTES, MqttAccess};
use crate::link::state::Shared;

/// The size limit, and the kind of messages that it must admit.
#[derive(Clone, Copy)]
pub(super) struct MessageRoom {
    pub(super) bytes: usize,
    /// Whether a whole package must fit.
    holds_packages: bool,
}

impl MessageRoom {
    pub(super) fn of(access: &MqttAccess, shared: &Shared, holds_packages: bool) -> Self {
        let wanted = if holds_packages { Self::for_wanted(shared) } else { 0 };
        Self { bytes: wanted.max(access.message_bytes), holds_packages }
    }

    /// Message size of the largest wanted package.
    fn for_wanted(shared: &Shared) -> usize {
        let message = shared.listening.largest_bytes().saturating_add(AROUND_MESSAGE_BYTES as u64);
        usize::try_from(message.min(MAX_MESSAGE_BYTES)).unwrap_or(usize::MAX)
    }

    /// Whether a message with a wanted package would exceed the limit.
    pub(super) fn is_too_narrow(&self, shared: &Shared) -> bool {
        self.holds_packages && Self::for_wanted(shared) > self.bytes
    }

    /// Whether a message of `bytes` exceeded the limit and may hold a wanted package.
    pub(super) fn was_too_narrow(&self, bytes: usize, shared: &Shared) -> bool {
        bytes > self.bytes && bytes <= Self::for_wanted(shared)
    }
}
