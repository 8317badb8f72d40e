//! The message bus between servers. A message that is lost, doubled or late costs time and nothing
//! else.

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;

use super::message::ClusterMessage;

/// Messages from the other servers, or a gap.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Received {
    Messages(Vec<ClusterMessage>),
    /// Something may have been missed.
    Gap,
}

/// Carries messages between the servers of a cluster.
pub(super) trait Bus: Send + Sync {
    /// Sends messages to all other servers, as far as possible. An empty list is sent too: it lets
    /// the others notice that an earlier one was lost.
    fn announce(&self, messages: Vec<ClusterMessage>) -> BoxFuture<'_, ()>;

    /// Waits for the next messages. Dropping the future loses none.
    fn receive(&self) -> BoxFuture<'_, Received>;

    /// The reason why nothing arrives; `None`: the bus works, as far as known.
    fn problem(&self) -> Option<String>;
}

/// A bus without other servers: nothing is sent and nothing arrives.
pub(super) struct Alone;

impl Bus for Alone {
    fn announce(&self, _: Vec<ClusterMessage>) -> BoxFuture<'_, ()> {
        std::future::ready(()).boxed()
    }

    fn receive(&self) -> BoxFuture<'_, Received> {
        std::future::pending().boxed()
    }

    fn problem(&self) -> Option<String> {
        None
    }
}
