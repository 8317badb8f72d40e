//! The subscriptions of a session: the robot's own topics, and the parts of contents that are being
//! collected. A refused subscription is repeated: the server may not be ready yet.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use rumqttc::{AsyncClient, QoS, SubAck, SubscribeReasonCode};
use task_proto::Digest;
use task_proto::topic::{Topic, TopicPrefix};
use tokio::time::Instant;

use crate::transfer::parts::{Hearing, Listening, Wish};

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
    unsent: VecDeque<Whose>,
    /// Packet id, request and time of each subscription that was sent.
    sent: Vec<(u16, Whose, Instant)>,
}

struct Subscription {
    wish: Wish,
    stands: Stands,
    refusals: u32,
}

enum Stands {
    Asked,
    Granted,
    /// Scheduled for this time.
    Due(Instant),
}

#[derive(Clone, Copy)]
enum Whose {
    /// One of the robot's own topics.
    Own,
    Content(Wish),
}

impl Subscriptions {
    /// Records a subscription request for one of the robot's own topics.
    pub(super) fn asked_for_own(&mut self) {
        self.unsent.push_back(Whose::Own);
    }

    /// Records the packet id of the oldest request that was passed to rumqttc.
    pub(super) fn sent(&mut self, id: u16) {
        if let Some(whose) = self.unsent.pop_front() {
            self.sent.push((id, whose, Instant::now()));
        }
    }

    /// Handles the broker's answer. Returns the round-trip time if it is a useful measurement of
    /// the link.
    pub(super) fn answered(&mut self, answer: &SubAck, listening: &Listening) -> Option<Duration> {
        let at = self.sent.iter().position(|(id, ..)| *id == answer.pkid)?;
        let (_, whose, sent_at) = self.sent.swap_remove(at);
        let Whose::Content(wish) = whose else { return Some(sent_at.elapsed()) };
        // The content may have been requested anew since this subscription was sent.
        let subscription =
            self.contents.get_mut(&wish.digest).filter(|subscription| subscription.wish == wish)?;
        if matches!(answer.return_codes[..], [SubscribeReasonCode::Success(_)]) {
            subscription.stands = Stands::Granted;
            listening.tell(&wish, Hearing::Yes);
        } else {
            let pause = FIRST_RETRY.saturating_mul(1 << subscription.refusals.min(8)).min(RETRY);
            subscription.refusals = subscription.refusals.saturating_add(1);
            subscription.stands =
                Stands::Due(Instant::now() + pause.mul_f64(0.5 + rand::random::<f64>()));
            listening.tell(&wish, Hearing::Refused);
        }
        None
    }

    /// Time of the next [`Self::tune`] if the wanted contents stay the same.
    pub(super) fn next_try(&self) -> Instant {
        let due = self.contents.values().filter_map(|subscription| match subscription.stands {
            Stands::Due(at) => Some(at),
            Stands::Asked | Stands::Granted => None,
        });
        due.min().unwrap_or_else(|| Instant::now() + LONG)
    }

    /// Subscribes to the wanted contents and unsubscribes from the others.
    pub(super) fn tune(
        &mut self,
        client: &AsyncClient,
        prefix: &TopicPrefix,
        listening: &Listening,
    ) {
        let now = Instant::now();
        let wanted = listening.wanted();
        let topic = |digest: &Digest| prefix.format(&Topic::Package(*digest));
        self.contents.retain(|digest, subscription| {
            let is_wanted = wanted.iter().any(|wish| wish.digest == *digest);
            // Requests are rare. If the queue is full, the request is repeated later.
            let is_over = !is_wanted && client.try_unsubscribe(topic(digest)).is_ok();
            if !is_wanted {
                subscription.stands = Stands::Due(now + RETRY);
            }
            !is_over
        });
        for wish in wanted {
            let new = Subscription { wish, stands: Stands::Due(now), refusals: 0 };
            let subscription = self.contents.entry(wish.digest).or_insert(new);
            let is_due = matches!(subscription.stands, Stands::Due(at) if at <= now);
            if subscription.wish == wish && !is_due {
                continue;
            }
            subscription.wish = wish;
            // A subscription with the highest quality of service delivers each part with the one
            // that its publisher chose.
            subscription.stands = match client.try_subscribe(topic(&wish.digest), QoS::ExactlyOnce)
            {
                Ok(()) => {
                    self.unsent.push_back(Whose::Content(wish));
                    Stands::Asked
                }
                Err(_) => Stands::Due(now + RETRY),
            };
        }
    }
}
