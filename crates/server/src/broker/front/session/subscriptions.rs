//! A session's subscriptions, and the delivery of matching router messages.

use rumqttd::protocol::{Packet, QoS, SubAck, SubscribeReasonCode, UnsubAck};
use task_proto::Digest;
use task_proto::api::Subscription;
use tokio::io::{AsyncRead, AsyncWrite};

use super::{End, Session};
use crate::broker::front::access::{Client, MessageSource, matches, may_subscribe};
use crate::broker::front::parts::PartSubscription;
use crate::broker::router::Message;

/// Maximum length of a filter: far longer than any topic, and a session may keep many filters.
const MAX_FILTER_BYTES: usize = 1024;

impl<S: AsyncRead + AsyncWrite + Unpin> Session<'_, S> {
    pub(super) fn subscribe(&mut self, pkid: u16, filters: Vec<(String, QoS)>) -> Result<(), End> {
        // No client can know the limit, so filters beyond it are refused and are no violation.
        let (count, max_filters) = (filters.len(), self.context.limits.max_filters);
        let mut return_codes = Vec::with_capacity(count);
        for (filter, qos) in filters.into_iter().take(max_filters) {
            let has_room =
                self.subscriptions.len() < max_filters || self.subscriptions.contains_key(&filter);
            let fits = has_room && filter.len() <= MAX_FILTER_BYTES;
            let source =
                may_subscribe(&self.client, &self.context.prefix, &filter).filter(|_| fits);
            let is_accepted = match source {
                Some(MessageSource::Package(digest)) => self.join(digest),
                Some(_) => true,
                None => {
                    self.refuse_filter()?;
                    false
                }
            };
            return_codes.push(match source {
                Some(source) if is_accepted => {
                    self.subscriptions.insert(filter, (source, qos));
                    SubscribeReasonCode::Success(qos)
                }
                _ => {
                    // The earlier subscription to this filter, if it has ended meanwhile.
                    self.subscriptions.remove(&filter);
                    SubscribeReasonCode::Failure
                }
            });
        }
        return_codes.resize(count, SubscribeReasonCode::Failure);
        self.publish_subscriptions();
        self.send(Packet::SubAck(SubAck { pkid, return_codes }, None));
        Ok(())
    }

    pub(super) fn publish_subscriptions(&self) {
        let subscription = |(filter, (_, qos)): (&String, &(MessageSource, QoS))| Subscription {
            topic_filter: filter.clone(),
            qos: *qos as u8,
        };
        self.slot.set_subscriptions(self.subscriptions.iter().map(subscription).collect());
    }

    pub(super) fn unsubscribe(&mut self, pkid: u16, filters: &[String]) {
        for filter in filters {
            if let Some((MessageSource::Package(digest), _)) = self.subscriptions.remove(filter) {
                self.parts.leave(&digest);
            }
        }
        self.publish_subscriptions();
        self.send(Packet::UnsubAck(UnsubAck { pkid, reasons: Vec::new() }, None));
    }

    /// Sends a router message if a subscription matches: once, with the highest matching QoS.
    pub(super) fn deliver(&mut self, message: Message) {
        let matching =
            self.subscriptions.iter().filter(|(filter, _)| matches(filter, &message.topic));
        let best = matching.map(|(_, (_, qos))| *qos).max_by_key(|qos| *qos as u8);
        if let Some(granted) = best {
            self.send_message(message.topic, message.payload, lower(granted, message.qos));
        }
    }

    /// Counts this session among the package's subscribers; false if it has no permission.
    fn join(&mut self, digest: Digest) -> bool {
        let Client::Robot { robot, .. } = &self.client else { return false };
        // A subscription from an earlier fan-out of the same package no longer counts.
        self.parts.leave(&digest);
        let Some(grant) = self.context.grants.of(&digest, robot) else { return false };
        let subscription = PartSubscription::join(grant, robot, self.parts.news());
        subscription.map(|subscription| self.parts.join(digest, subscription)).is_some()
    }
}

/// The lower of two qualities of service.
pub(super) fn lower(a: QoS, b: QoS) -> QoS {
    if (a as u8) < b as u8 { a } else { b }
}
