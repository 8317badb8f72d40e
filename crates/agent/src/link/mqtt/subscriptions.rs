//! What a session is subscribed to: the robot's own topics, and the parts of the contents that
//! somebody gathers. A refused subscription is tried again: the server may not have got so far yet.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use rumqttc::{AsyncClient, QoS, SubAck, SubscribeReasonCode};
use task_proto::Digest;
use task_proto::topic::{Topic, TopicPrefix};
use tokio::time::Instant;

use crate::transfer::parts::{Hearing, Listening, Wish};

/// How long to wait on average after a refusal: a little at first, because the server may just be
/// about to begin, then twice as long each time, up to the most.
const FIRST_RETRY: Duration = Duration::from_millis(50);
const RETRY: Duration = Duration::from_secs(1);
/// How far a timer is set when there is nothing to wait for.
const LONG: Duration = Duration::from_secs(3600);

/// The subscriptions of one session.
#[derive(Default)]
pub(super) struct Subscriptions {
    contents: BTreeMap<Digest, Subscription>,
    /// Handed to rumqttc, which has not given them a packet id yet.
    unsent: VecDeque<Whose>,
    /// Sent under this packet id, and when.
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
    /// To be tried at this time.
    Due(Instant),
}

#[derive(Clone, Copy)]
enum Whose {
    /// One of the robot's own topics.
    Own,
    Content(Wish),
}

impl Subscriptions {
    /// One of the robot's own topics was asked for.
    pub(super) fn asked_for_own(&mut self) {
        self.unsent.push_back(Whose::Own);
    }

    /// A subscription that was asked for went out under this packet id.
    pub(super) fn sent(&mut self, id: u16) {
        if let Some(whose) = self.unsent.pop_front() {
            self.sent.push((id, whose, Instant::now()));
        }
    }

    /// Takes the broker's answer; how long it took where that says something of the link.
    pub(super) fn answered(&mut self, answer: &SubAck, listening: &Listening) -> Option<Duration> {
        let at = self.sent.iter().position(|(id, ..)| *id == answer.pkid)?;
        let (_, whose, sent_at) = self.sent.swap_remove(at);
        let Whose::Content(wish) = whose else { return Some(sent_at.elapsed()) };
        // It may be wanted anew since it was asked for.
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

    /// When to [`Self::tune`] although nothing else is wanted than before.
    pub(super) fn next_try(&self) -> Instant {
        let due = self.contents.values().filter_map(|subscription| match subscription.stands {
            Stands::Due(at) => Some(at),
            Stands::Asked | Stands::Granted => None,
        });
        due.min().unwrap_or_else(|| Instant::now() + LONG)
    }

    /// Asks for what is wanted, and ends what is not wanted any more.
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
            // Requests go out in good time: when there is no room for one, it is tried again.
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
            // With the highest quality of service each part comes with the one that it was sent
            // with.
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
