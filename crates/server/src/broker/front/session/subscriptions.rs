//! A session's subscriptions, and the delivery of matching router messages.

use rumqttd::protocol::{Packet, QoS, SubAck, SubscribeReasonCode, UnsubAck};
use task_proto::Digest;
use task_proto::api::Subscription;
use tokio::io::{AsyncRead, AsyncWrite};

use super::{End, Session};
use crate::broker::front::access::{Hearing, Visitor, matches, may_subscribe};
use crate::broker::front::parts::Member;
use crate::broker::router::Heard;

/// Maximum length of a filter: far longer than any topic, and a session may keep many filters.
const MAX_FILTER_BYTES: usize = 1024;

impl<S: AsyncRead + AsyncWrite + Unpin> Session<'_, S> {
    pub(super) fn subscribe(&mut self, pkid: u16, filters: Vec<(String, QoS)>) -> Result<(), End> {
        // No client can know the limit, so filters beyond it are refused and are no violation.
        let (count, max_filters) = (filters.len(), self.context.limits.max_filters);
        let mut return_codes = Vec::with_capacity(count);
        for (filter, qos) in filters.into_iter().take(max_filters) {
            let has_room = self.hearing.len() < max_filters || self.hearing.contains_key(&filter);
            let fits = has_room && filter.len() <= MAX_FILTER_BYTES;
            let hearing =
                may_subscribe(&self.visitor, &self.context.prefix, &filter).filter(|_| fits);
            let is_heard = match hearing {
                Some(Hearing::Package(digest)) => self.join(digest),
                Some(_) => true,
                None => {
                    self.refuse_filter()?;
                    false
                }
            };
            return_codes.push(match hearing {
                Some(hearing) if is_heard => {
                    self.hearing.insert(filter, (hearing, qos));
                    SubscribeReasonCode::Success(qos)
                }
                _ => {
                    // The earlier subscription to this filter, if it has ended meanwhile.
                    self.hearing.remove(&filter);
                    SubscribeReasonCode::Failure
                }
            });
        }
        return_codes.resize(count, SubscribeReasonCode::Failure);
        self.note_subscriptions();
        self.send(Packet::SubAck(SubAck { pkid, return_codes }, None));
        Ok(())
    }

    pub(super) fn note_subscriptions(&self) {
        let subscription = |(filter, (_, qos)): (&String, &(Hearing, QoS))| Subscription {
            topic_filter: filter.clone(),
            qos: *qos as u8,
        };
        self.seat.listens_to(self.hearing.iter().map(subscription).collect());
    }

    pub(super) fn unsubscribe(&mut self, pkid: u16, filters: &[String]) {
        for filter in filters {
            if let Some((Hearing::Package(digest), _)) = self.hearing.remove(filter) {
                self.parts.leave(&digest);
            }
        }
        self.note_subscriptions();
        self.send(Packet::UnsubAck(UnsubAck { pkid, reasons: Vec::new() }, None));
    }

    /// Sends a router message if a subscription matches: once, with the highest matching QoS.
    pub(super) fn pass_on(&mut self, heard: Heard) {
        let matching = self.hearing.iter().filter(|(filter, _)| matches(filter, &heard.topic));
        let best = matching.map(|(_, (_, qos))| *qos).max_by_key(|qos| *qos as u8);
        if let Some(granted) = best {
            self.send_message(heard.topic, heard.payload, lower(granted, heard.qos));
        }
    }

    /// Counts this session among the package's subscribers; false if it has no permission.
    fn join(&mut self, digest: Digest) -> bool {
        let Visitor::Robot { robot, .. } = &self.visitor else { return false };
        // A subscription from an earlier fan-out of the same package no longer counts.
        self.parts.leave(&digest);
        let Some(grant) = self.context.grants.of(&digest, robot) else { return false };
        let member = Member::join(grant, robot, self.parts.news());
        member.map(|member| self.parts.join(digest, member)).is_some()
    }
}

/// The lower of two qualities of service.
pub(super) fn lower(a: QoS, b: QoS) -> QoS {
    if (a as u8) < b as u8 { a } else { b }
}
