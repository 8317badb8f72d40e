//! What a session hears: its subscriptions, and what of the router's messages they let through.

use futures_util::future::BoxFuture;
use rumqttd::protocol::{Packet, QoS, SubAck, SubscribeReasonCode, UnsubAck};
use task_proto::Digest;
use task_proto::topic::Topic;
use tokio::io::{AsyncRead, AsyncWrite};

use super::{End, Session, lower};
use crate::broker::front::access::{Hearing, Visitor, matches, may_subscribe};
use crate::broker::front::parts::Member;
use crate::broker::router::{Heard, Listener, Listening, RouterError, part_of};

/// A SUBSCRIBE whose answer waits for a link to the router.
pub(super) struct Opening {
    packet_id: u16,
    filters: Vec<(String, QoS)>,
    link: BoxFuture<'static, Result<Listener, RouterError>>,
}

/// The link that is being opened; never if there is none.
pub(super) async fn opened(opening: &mut Option<Opening>) -> Result<Listener, RouterError> {
    match opening {
        Some(opening) => (&mut opening.link).await,
        None => std::future::pending().await,
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Session<'_, S> {
    pub(super) fn subscribe(&mut self, packet_id: u16, filters: Vec<(String, QoS)>) -> Result<(), End> {
        if filters.len() > self.context.limits.max_filters {
            return Err(End::Violation("subscribes to too many filters at a time"));
        }
        let needs_link = self.listener.is_none() && filters.iter().any(|(filter, _)| self.may_hear_parts(filter));
        if needs_link {
            let router = self.context.router.clone();
            let link = Box::pin(async move { router.listen(Listening::Parts).await });
            self.opening = Some(Opening { packet_id, filters, link });
        } else {
            self.subscribe_now(packet_id, filters);
        }
        Ok(())
    }

    /// The link is there, or can't be had: then parts are not heard and the rest is.
    pub(super) fn link_opened(&mut self, link: Result<Listener, RouterError>) {
        let Some(Opening { packet_id, filters, .. }) = self.opening.take() else { return };
        match link {
            Ok(link) => self.listener = Some(link),
            Err(error) => tracing::debug!(peer = %self.peer, "no link for a package's parts: {error}"),
        }
        self.subscribe_now(packet_id, filters);
        self.drop_idle_link();
    }

    fn subscribe_now(&mut self, pkid: u16, filters: Vec<(String, QoS)>) {
        let mut return_codes = Vec::with_capacity(filters.len());
        for (filter, qos) in filters {
            let has_room = self.hearing.len() < self.context.limits.max_filters || self.hearing.contains_key(&filter);
            let hearing = may_subscribe(&self.visitor, &self.context.prefix, &filter).filter(|_| has_room);
            let is_heard = match hearing {
                Some(Hearing::Package(digest)) => self.join(digest),
                Some(_) => true,
                None => false,
            };
            return_codes.push(match hearing {
                Some(hearing) if is_heard => {
                    self.hearing.insert(filter, (hearing, qos));
                    SubscribeReasonCode::Success(qos)
                }
                _ => SubscribeReasonCode::Failure,
            });
        }
        self.send(Packet::SubAck(SubAck { pkid, return_codes }, None));
    }

    pub(super) fn unsubscribe(&mut self, pkid: u16, filters: &[String]) {
        for filter in filters {
            if let Some((Hearing::Package(digest), _)) = self.hearing.remove(filter) {
                self.members.remove(&digest);
            }
        }
        self.drop_idle_link();
        self.send(Packet::UnsubAck(UnsubAck { pkid, reasons: Vec::new() }, None));
    }

    /// Sends what came out of the router if a subscription matches, once, as the best of them has it.
    pub(super) fn pass_on(&mut self, heard: Heard) {
        if let Some((digest, number)) = part_of(&heard.topic) {
            return self.pass_on_part(digest, number, heard);
        }
        let matching = self.hearing.iter().filter(|(filter, _)| matches(filter, &heard.topic));
        let best = matching.map(|(_, (_, qos))| *qos).max_by_key(|qos| *qos as u8);
        if let Some(granted) = best {
            self.send_message(heard.topic, heard.payload, lower(granted, heard.qos));
        }
    }

    fn pass_on_part(&mut self, digest: Digest, number: u64, heard: Heard) {
        let Some(member) = self.members.get(&digest) else { return };
        let Some(granted) = self.qos_of(Hearing::Package(digest)).filter(|_| member.take(number)) else {
            // The grant was withdrawn, and with it the subscription.
            self.members.remove(&digest);
            self.hearing.retain(|_, (hearing, _)| *hearing != Hearing::Package(digest));
            return self.drop_idle_link();
        };
        let topic = self.context.prefix.format(&Topic::Package(digest));
        self.send_message(topic, heard.payload, lower(granted, heard.qos));
    }

    fn may_hear_parts(&self, filter: &str) -> bool {
        let Visitor::Robot { robot, .. } = &self.visitor else { return false };
        match may_subscribe(&self.visitor, &self.context.prefix, filter) {
            Some(Hearing::Package(digest)) => self.context.grants.of(&digest, robot).is_some(),
            _ => false,
        }
    }

    /// Counts this session among those who hear the package; false if it may not, or can't for want of a link.
    fn join(&mut self, digest: Digest) -> bool {
        let Visitor::Robot { robot, .. } = &self.visitor else { return false };
        if self.listener.is_none() {
            return false;
        }
        // One of an earlier fan-out of the same package counts no longer.
        self.members.remove(&digest);
        let member = self.context.grants.of(&digest, robot).and_then(|grant| Member::join(grant, robot));
        member.map(|member| self.members.insert(digest, member)).is_some()
    }

    /// A robot has a link only while it hears some package.
    fn drop_idle_link(&mut self) {
        if self.members.is_empty() && matches!(self.visitor, Visitor::Robot { .. }) {
            self.listener = None;
        }
    }
}
