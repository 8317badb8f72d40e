//! The contents that this robot collects from parts: the list that the MQTT session subscribes to,
//! and the channel from the session to the task that collects the parts. A part is acknowledged
//! when its [`ReceivedPart`] is dropped, so a slow writer slows down the sender and nothing
//! accumulates here. This module knows neither MQTT packets nor the disk.

use std::collections::BTreeMap;
use task_proto::messages::part::PartRange;

use bytes::Bytes;
use task_proto::Digest;
use tokio::sync::{mpsc, watch};

/// A collecting robot's request for missing parts.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PartRequest {
    /// Missing parts, for the next report whatever its cause.
    pub missing: Option<Vec<PartRange>>,
    /// Counter that increases each time this request needs a report of its own, even if the missing
    /// parts are unchanged.
    pub times: u32,
}

/// Capacity of one content's queue of received parts. A part may be a whole package.
const QUEUED_PARTS: usize = 2;

/// The contents with wanted parts. Clones share one list.
#[derive(Debug, Clone, Default)]
pub struct PartSubscriptions(watch::Sender<ContentRequests>);

/// The wanted contents, and whether a session can receive their parts.
#[derive(Debug, Default)]
pub struct ContentRequests {
    is_away: bool,
    /// Counter of all requests so far.
    number: u64,
    wanted: BTreeMap<Digest, WantedContent>,
}

/// A request to collect a content's parts. Each new request has a new number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ContentRequest {
    pub digest: Digest,
    number: u64,
}

/// One content with wanted parts.
#[derive(Debug)]
struct WantedContent {
    number: u64,
    size: u64,
    parts: mpsc::Sender<ReceivedPart>,
    subscription_state: watch::Sender<SubscriptionState>,
}

/// State of the subscription to a content's parts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum SubscriptionState {
    /// The broker has not answered yet.
    #[default]
    Pending,
    /// No session is up.
    Disconnected,
    /// The broker refuses the subscription for now.
    Refused,
    /// Parts published from now on arrive.
    Active,
}

/// Receiver of one content's parts. Dropping the receiver ends the request.
#[derive(Debug)]
pub struct PartReceiver {
    content_request: ContentRequest,
    part_subscriptions: PartSubscriptions,
    pub parts: mpsc::Receiver<ReceivedPart>,
    /// State of the subscription.
    pub subscription_state: watch::Receiver<SubscriptionState>,
}

/// An unparsed message on a content's topic.
#[derive(Debug)]
pub struct ReceivedPart {
    /// Payload of the message.
    pub message: Bytes,
    /// Acknowledges the message when dropped, so that the sender may continue.
    pub acknowledgement: Acknowledgement,
}

/// A message's acknowledgement, which is due when this is dropped.
#[derive(Debug)]
pub struct Acknowledgement {
    due: PendingAck,
    acknowledge: mpsc::Sender<PendingAck>,
}

/// Packet id and quality of service of the message to acknowledge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PendingAck {
    /// Packet id of the message.
    pub packet_id: u16,
    /// Quality of service of the message.
    pub qos: u8,
}

impl PartSubscriptions {
    /// Requests the parts of a content of `size` bytes from now on.
    pub fn subscribe(&self, digest: Digest, size: u64) -> PartReceiver {
        let (sender, parts) = mpsc::channel(QUEUED_PARTS);
        let (state_sender, subscription_state) = watch::channel(SubscriptionState::Pending);
        let mut number = 0;
        self.0.send_modify(|content_requests| {
            content_requests.number += 1;
            number = content_requests.number;
            state_sender.send_replace(if content_requests.is_away {
                SubscriptionState::Disconnected
            } else {
                SubscriptionState::Pending
            });
            content_requests.wanted.insert(
                digest,
                WantedContent { number, size, parts: sender, subscription_state: state_sender },
            );
        });
        PartReceiver {
            content_request: ContentRequest { digest, number },
            part_subscriptions: self.clone(),
            parts,
            subscription_state,
        }
    }

    /// A receiver that is notified when the wanted contents change.
    pub fn changes(&self) -> watch::Receiver<ContentRequests> {
        self.0.subscribe()
    }

    /// The contents that are wanted.
    pub fn wanted(&self) -> Vec<ContentRequest> {
        self.0
            .borrow()
            .wanted
            .iter()
            .map(|(digest, wanted)| ContentRequest { digest: *digest, number: wanted.number })
            .collect()
    }

    /// Size of the largest wanted content.
    pub fn largest_bytes(&self) -> u64 {
        self.0.borrow().wanted.values().map(|wanted| wanted.size).max().unwrap_or(0)
    }

    /// The channel for the parts of a content, if the content is wanted.
    pub fn part_sender(&self, digest: &Digest) -> Option<mpsc::Sender<ReceivedPart>> {
        self.0.borrow().wanted.get(digest).map(|wanted| wanted.parts.clone())
    }

    /// Sets the state of the subscription for this request.
    pub fn set_state(
        &self,
        content_request: &ContentRequest,
        subscription_state: SubscriptionState,
    ) {
        if let Some(wanted) = self
            .0
            .borrow()
            .wanted
            .get(&content_request.digest)
            .filter(|wanted| wanted.number == content_request.number)
        {
            wanted.subscription_state.send_replace(subscription_state);
        }
    }

    /// Sets whether a session is up. Either way all subscriptions are gone. Before the first call a
    /// session may still come up soon.
    pub fn set_session_up(&self, is_up: bool) {
        self.0.send_modify(|content_requests| {
            content_requests.is_away = !is_up;
            for wanted in content_requests.wanted.values() {
                wanted.subscription_state.send_replace(if is_up {
                    SubscriptionState::Pending
                } else {
                    SubscriptionState::Disconnected
                });
            }
        });
    }
}

impl Drop for PartReceiver {
    fn drop(&mut self) {
        let ContentRequest { digest, number } = self.content_request;
        self.part_subscriptions.0.send_if_modified(|ContentRequests { wanted, .. }| {
            // Another task may have requested the same content since.
            let is_mine = wanted.get(&digest).is_some_and(|wanted| wanted.number == number);
            is_mine && wanted.remove(&digest).is_some()
        });
    }
}

impl Acknowledgement {
    /// An acknowledgement of the message `due`, sent through `acknowledge`.
    pub fn new(due: PendingAck, acknowledge: mpsc::Sender<PendingAck>) -> Self {
        Self { due, acknowledge }
    }
}

impl Drop for Acknowledgement {
    fn drop(&mut self) {
        // After the session's end there is no receiver for the acknowledgement. The queue never
        // fills, because brokers have far fewer messages in flight.
        let _ = self.acknowledge.try_send(self.due);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn part_is_acknowledged_when_dropped() {
        let part_subscriptions = PartSubscriptions::default();
        let digest = Digest::of(b"content");
        let mut part_receiver = part_subscriptions.subscribe(digest, 7);
        assert_eq!(
            (part_subscriptions.wanted(), part_subscriptions.largest_bytes()),
            (vec![part_receiver.content_request], 7)
        );
        let (acknowledge, mut acknowledged) = mpsc::channel(4);
        let due = PendingAck { packet_id: 3, qos: 1 };
        let message = Bytes::from_static(b"part");
        let arrived =
            ReceivedPart { message, acknowledgement: Acknowledgement::new(due, acknowledge) };
        part_subscriptions.part_sender(&digest).expect("wanted").send(arrived).await.expect("room");
        let arrived = part_receiver.parts.recv().await.expect("sent");
        assert!(acknowledged.try_recv().is_err());
        drop(arrived);
        assert_eq!(acknowledged.try_recv(), Ok(due));
    }

    #[test]
    fn dropped_receiver_keeps_a_newer_subscription() {
        let part_subscriptions = PartSubscriptions::default();
        let digest = Digest::of(b"content");
        let first = part_subscriptions.subscribe(digest, 7);
        let second = part_subscriptions.subscribe(digest, 7);
        part_subscriptions.set_state(&first.content_request, SubscriptionState::Active);
        assert_eq!(
            *second.subscription_state.borrow(),
            SubscriptionState::Pending,
            "it has not subscribed"
        );
        let mut changes = part_subscriptions.changes();
        changes.mark_unchanged();
        drop(first);
        assert!(!changes.has_changed().expect("it lives"));
        part_subscriptions.set_state(&second.content_request, SubscriptionState::Active);
        assert_eq!(
            (*second.subscription_state.borrow(), part_subscriptions.wanted().len()),
            (SubscriptionState::Active, 1)
        );
        drop(second);
        assert!(changes.has_changed().expect("it lives") && part_subscriptions.wanted().is_empty());
    }

    #[test]
    fn session_change_resets_all_subscriptions() {
        let part_subscriptions = PartSubscriptions::default();
        let subscription_state =
            |part_receiver: &PartReceiver| *part_receiver.subscription_state.borrow();
        let first = part_subscriptions.subscribe(Digest::of(b"first"), 1);
        assert_eq!(
            subscription_state(&first),
            SubscriptionState::Pending,
            "a session may come about at any moment"
        );
        part_subscriptions.set_session_up(true);
        part_subscriptions.set_state(&first.content_request, SubscriptionState::Active);
        part_subscriptions.set_session_up(false);
        let second = part_subscriptions.subscribe(Digest::of(b"second"), 2);
        assert_eq!(
            (subscription_state(&first), subscription_state(&second)),
            (SubscriptionState::Disconnected, SubscriptionState::Disconnected)
        );
        part_subscriptions.set_session_up(true);
        assert_eq!(
            (subscription_state(&first), subscription_state(&second)),
            (SubscriptionState::Pending, SubscriptionState::Pending)
        );
    }
}
