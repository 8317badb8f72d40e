//! The subscriptions of a session: the robot's own topics, and the parts of contents that are being
//! collected. A refused subscription is repeated: the server may not be ready yet.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use rumqttc::{AsyncClient, QoS, SubAck, SubscribeReasonCode};
use task_proto::Digest;
use task_proto::messages::topic::{Topic, TopicPrefix};
use tokio::time::Instant;

use crate::transfer::parts::{ContentRequest, PartSubscriptions, SubscriptionState};

/// Average wait after a refusal: short at first, because the server may be about to begin, then
/// doubled each time up to [`RETRY`].
const FIRST_RETRY: Duration = Duration::from_millis(50);
const RETRY: Duration = Duration::from_secs(1);
/// Timer delay when no retry is due.
const LONG: Duration = Duration::from_secs(3600);

/// The subscriptions of one session.
#[derive(Default)]
pub(super) struct Subscriptions {
    contents: BTreeMap<Digest, Subscription>,
    /// Requests passed to rumqttc, but without a packet id so far.
    unsent: VecDeque<SubscriptionTarget>,
    /// Packet id, request and time of each subscription that was sent.
    sent: Vec<(u16, SubscriptionTarget, Instant)>,
}

struct Subscription {
    content_request: ContentRequest,
    status: SubscriptionStatus,
    refusals: u32,
}

enum SubscriptionStatus {
    Pending,
    Granted,
    /// Scheduled for this time.
    Due(Instant),
}

#[derive(Clone, Copy)]
enum SubscriptionTarget {
    /// One of the robot's own topics.
    Own,
    Content(ContentRequest),
}

impl Subscriptions {
    /// Records a subscription request for one of the robot's own topics.
    pub(super) fn add_own(&mut self) {
        self.unsent.push_back(SubscriptionTarget::Own);
    }

    /// Records the packet id of the oldest request that was passed to rumqttc.
    pub(super) fn sent(&mut self, id: u16) {
        if let Some(target) = self.unsent.pop_front() {
            self.sent.push((id, target, Instant::now()));
        }
    }

    /// Handles the broker's answer. Returns the round-trip time if it is a useful measurement of
    /// the link.
    pub(super) fn handle_suback(
        &mut self,
        answer: &SubAck,
        part_subscriptions: &PartSubscriptions,
    ) -> Option<Duration> {
        let at = self.sent.iter().position(|(id, ..)| *id == answer.pkid)?;
        let (_, target, sent_at) = self.sent.swap_remove(at);
        let SubscriptionTarget::Content(content_request) = target else {
            return Some(sent_at.elapsed());
        };
        // The content may have been requested anew since this subscription was sent.
        let subscription = self
            .contents
            .get_mut(&content_request.digest)
            .filter(|subscription| subscription.content_request == content_request)?;
        if matches!(answer.return_codes[..], [SubscribeReasonCode::Success(_)]) {
            subscription.status = SubscriptionStatus::Granted;
            part_subscriptions.set_state(&content_request, SubscriptionState::Active);
        } else {
            let pause = FIRST_RETRY.saturating_mul(1 << subscription.refusals.min(8)).min(RETRY);
            subscription.refusals = subscription.refusals.saturating_add(1);
            subscription.status = SubscriptionStatus::Due(
                Instant::now() + pause.mul_f64(0.5 + rand::random::<f64>()),
            );
            part_subscriptions.set_state(&content_request, SubscriptionState::Refused);
        }
        None
    }

    /// Time of the next [`Self::update`] if the wanted contents stay the same.
    pub(super) fn next_retry(&self) -> Instant {
        let due = self.contents.values().filter_map(|subscription| match subscription.status {
            SubscriptionStatus::Due(at) => Some(at),
            SubscriptionStatus::Pending | SubscriptionStatus::Granted => None,
        });
        due.min().unwrap_or_else(|| Instant::now() + LONG)
    }

    /// Subscribes to the wanted contents and unsubscribes from the others.
    pub(super) fn update(
        &mut self,
        client: &AsyncClient,
        prefix: &TopicPrefix,
        part_subscriptions: &PartSubscriptions,
    ) {
        let now = Instant::now();
        let wanted = part_subscriptions.wanted();
        let topic = |digest: &Digest| prefix.format(&Topic::Package(*digest));
        self.contents.retain(|digest, subscription| {
            let is_wanted = wanted.iter().any(|content_request| content_request.digest == *digest);
            // Requests are rare. If the queue is full, the request is repeated later.
            let is_over = !is_wanted && client.try_unsubscribe(topic(digest)).is_ok();
            if !is_wanted {
                subscription.status = SubscriptionStatus::Due(now + RETRY);
            }
            !is_over
        });
        for content_request in wanted {
            let new =
                Subscription { content_request, status: SubscriptionStatus::Due(now), refusals: 0 };
            let subscription = self.contents.entry(content_request.digest).or_insert(new);
            let is_due = matches!(subscription.status, SubscriptionStatus::Due(at) if at <= now);
            if subscription.content_request == content_request && !is_due {
                continue;
            }
            subscription.content_request = content_request;
            // A subscription with the highest quality of service delivers each part with the one
            // that its publisher chose.
            subscription.status =
                match client.try_subscribe(topic(&content_request.digest), QoS::ExactlyOnce) {
                    Ok(()) => {
                        self.unsent.push_back(SubscriptionTarget::Content(content_request));
                        SubscriptionStatus::Pending
                    }
                    Err(_) => SubscriptionStatus::Due(now + RETRY),
                };
        }
    }
}
