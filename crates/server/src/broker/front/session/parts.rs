//! A session's state in fan-outs: its package subscriptions, and the parts that its robot has not
//! acknowledged yet.

use std::collections::HashMap;
use std::sync::Arc;

use rumqttd::protocol::QoS;
use task_proto::Digest;
use task_proto::messages::topic::Topic;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::Notify;

use super::subscriptions::lower;
use super::{Count, End, Session};
use crate::broker::Part;
use crate::broker::front::access::MessageSource;
use crate::broker::front::codec::encode_publish_head;
use crate::broker::front::parts::{Due, PartSubscription};

/// Maximum unwritten bytes of a part after the robot's permission is withdrawn; more would keep the
/// connection busy in vain.
const MAX_WASTED_BYTES: usize = 256 * 1024;

/// The package subscriptions of a session.
#[derive(Default)]
pub(super) struct Parts {
    subscriptions: HashMap<Digest, PartSubscription>,
    /// Wakes the session when a package has news.
    news: Arc<Notify>,
    /// By packet id: parts that are sent and not acknowledged.
    in_flight: HashMap<u16, (Digest, u64)>,
    /// The part that needs no acknowledgement and is being written.
    writing: Option<(Digest, u64)>,
    /// The package whose part was sent last: the next turn belongs to another one.
    last: Option<Digest>,
}

impl Parts {
    pub(super) fn news(&self) -> Arc<Notify> {
        self.news.clone()
    }

    pub(super) fn join(&mut self, digest: Digest, subscription: PartSubscription) {
        self.subscriptions.insert(digest, subscription);
    }

    /// Ends the subscription to the package; later acknowledgements are ignored.
    pub(super) fn leave(&mut self, digest: &Digest) {
        self.subscriptions.remove(digest);
        self.in_flight.retain(|_, (of, _)| of != digest);
        self.writing.take_if(|(of, _)| of == digest);
    }

    /// The message with this packet id has arrived.
    pub(super) fn acknowledged(&mut self, packet_id: u16) {
        if let Some((digest, number)) = self.in_flight.remove(&packet_id) {
            self.done(&digest, number);
        }
    }

    /// All sent bytes are with the operating system.
    pub(super) fn written(&mut self) {
        if let Some((digest, number)) = self.writing.take() {
            self.done(&digest, number);
        }
    }

    fn done(&self, digest: &Digest, number: u64) {
        if let Some(subscription) = self.subscriptions.get(digest) {
            subscription.acknowledged(number);
        }
    }

    /// The first due action, with packages taking turns.
    fn first_due(&self, may_send: bool) -> Option<(Digest, Due)> {
        let by_turns = |is_last: bool| {
            self.subscriptions
                .iter()
                .filter(move |(digest, _)| (Some(**digest) == self.last) == is_last)
        };
        by_turns(false).chain(by_turns(true)).find_map(|(digest, subscription)| match subscription
            .due()
        {
            Due::Nothing => None,
            Due::Part(..) if !may_send => None,
            due => Some((*digest, due)),
        })
    }
}

/// Waits until there is an action: a part, if one may be sent, or a package that has ended.
/// Cancel-safe, since nothing is taken yet.
pub(super) async fn due(parts: &Parts, may_send: bool) -> (Digest, Due) {
    loop {
        if let Some(due) = parts.first_due(may_send) {
            return due;
        }
        parts.news.notified().await;
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Session<'_, S> {
    pub(super) fn handle_part(&mut self, digest: Digest, due: Due) -> Result<(), End> {
        match due {
            Due::Part(number, part) => self.send_part(digest, number, part),
            Due::Nothing => {}
            // The grant was withdrawn, and with it the subscription.
            Due::End => {
                let was_writing = self.parts.last == Some(digest);
                self.parts.leave(&digest);
                self.subscriptions
                    .retain(|_, (source, _)| *source != MessageSource::Package(digest));
                self.publish_subscriptions();
                if was_writing && self.output.shared_bytes() > MAX_WASTED_BYTES {
                    return Err(End::Withdrawn);
                }
            }
        }
        Ok(())
    }

    fn send_part(&mut self, digest: Digest, number: u64, part: Part) {
        let Some(subscription) = self.parts.subscriptions.get(&digest) else { return };
        let granted = self.qos_of(MessageSource::Package(digest)).unwrap_or(QoS::AtMostOnce);
        let qos = lower(granted, subscription.qos());
        subscription.take(number);
        let packet_id = self.outgoing.begin(qos);
        match qos {
            QoS::AtMostOnce => self.parts.writing = Some((digest, number)),
            QoS::AtLeastOnce | QoS::ExactlyOnce => {
                self.parts.in_flight.insert(packet_id, (digest, number));
            }
        }
        self.parts.last = Some(digest);
        self.count(Count::PacketsOut);
        self.count(Count::MessagesOut);
        let topic = self.context.prefix.format(&Topic::Package(digest));
        if encode_publish_head(&topic, qos, packet_id, part.len(), self.output.packets()) {
            self.output.packets().extend_from_slice(&part.header);
            self.output.share(part.bytes);
        }
    }
}
