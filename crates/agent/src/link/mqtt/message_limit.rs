//! The message size limit of a session, which is fixed for the lifetime of the session.

use super::{AROUND_MESSAGE_BYTES, MAX_MESSAGE_BYTES, MqttAccess};
use crate::link::state::LinkState;

/// The size limit, and the kind of messages that it must admit.
#[derive(Clone, Copy)]
pub(super) struct MessageLimit {
    pub(super) bytes: usize,
    /// Whether a whole package must fit.
    holds_packages: bool,
}

impl MessageLimit {
    pub(super) fn of(access: &MqttAccess, link_state: &LinkState, holds_packages: bool) -> Self {
        let wanted = if holds_packages { Self::for_wanted(link_state) } else { 0 };
        Self { bytes: wanted.max(access.message_bytes), holds_packages }
    }

    /// Message size of the largest wanted package.
    fn for_wanted(link_state: &LinkState) -> usize {
        let message = link_state
            .part_subscriptions
            .largest_bytes()
            .saturating_add(AROUND_MESSAGE_BYTES as u64);
        usize::try_from(message.min(MAX_MESSAGE_BYTES)).unwrap_or(usize::MAX)
    }

    /// Whether a message with a wanted package would exceed the limit.
    pub(super) fn is_exceeded(&self, link_state: &LinkState) -> bool {
        self.holds_packages && Self::for_wanted(link_state) > self.bytes
    }

    /// Whether a message of `bytes` exceeded the limit and may hold a wanted package.
    pub(super) fn was_exceeded_by(&self, bytes: usize, link_state: &LinkState) -> bool {
        bytes > self.bytes && bytes <= Self::for_wanted(link_state)
    }
}
