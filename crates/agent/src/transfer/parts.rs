//! The contents that this robot collects from parts: the list that the MQTT session subscribes to,
//! and the channel from the session to the task that collects the parts. A part is acknowledged
//! when its [`Arrived`] is dropped, so a slow writer slows down the sender and nothing accumulates
//! here. This module knows neither MQTT packets nor the disk.

use std::collections::BTreeMap;
use task_proto::part::PartRange;

use bytes::Bytes;
use task_proto::Digest;
use tokio::sync::{mpsc, watch};

/// A collecting robot's request for missing parts.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Asks {
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
pub struct Listening(watch::Sender<Wishes>);

/// The wanted contents, and whether a session can receive their parts.
#[derive(Debug, Default)]
pub struct Wishes {
    is_away: bool,
    /// Counter of all requests so far.
    number: u64,
    wanted: BTreeMap<Digest, Wanted>,
}

/// A request to collect a content's parts. Each new request has a new number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wish {
    pub digest: Digest,
    number: u64,
}

/// One content with wanted parts.
#[derive(Debug)]
struct Wanted {
    number: u64,
    size: u64,
    parts: mpsc::Sender<Arrived>,
    hearing: watch::Sender<Hearing>,
}

/// State of the subscription to a content's parts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Hearing {
    /// The broker has not answered yet.
    #[default]
    Asked,
    /// No session is up.
    Away,
    /// The broker refuses the subscription for now.
    Refused,
    /// Parts published from now on arrive.
    Yes,
}

/// Receiver of one content's parts. Dropping the receiver ends the request.
#[derive(Debug)]
pub struct Ear {
    wish: Wish,
    listening: Listening,
    pub parts: mpsc::Receiver<Arrived>,
    /// State of the subscription.
    pub hearing: watch::Receiver<Hearing>,
}

/// An unparsed message on a content's topic.
#[derive(Debug)]
pub struct Arrived {
    /// Payload of the message.
    pub message: Bytes,
    /// Acknowledges the message when dropped, so that the sender may continue.
    pub acknowledgement: Acknowledgement,
}

/// A message's acknowledgement, which is due when this is dropped.
#[derive(Debug)]
pub struct Acknowledgement {
    due: Due,
    acknowledge: mpsc::Sender<Due>,
}

/// Packet id and quality of service of the message to acknowledge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Due {
    /// Packet id of the message.
    pub packet_id: u16,
    /// Quality of service of the message.
    pub qos: u8,
}

impl Listening {
    /// Requests the parts of a content of `size` bytes from now on.
    pub fn listen(&self, digest: Digest, size: u64) -> Ear {
        let (sender, parts) = mpsc::channel(QUEUED_PARTS);
        let (told, hearing) = watch::channel(Hearing::Asked);
        let mut number = 0;
        self.0.send_modify(|wishes| {
            wishes.number += 1;
            number = wishes.number;
            told.send_replace(if wishes.is_away { Hearing::Away } else { Hearing::Asked });
            wishes.wanted.insert(digest, Wanted { number, size, parts: sender, hearing: told });
        });
        Ear { wish: Wish { digest, number }, listening: self.clone(), parts, hearing }
    }

    /// A receiver that is notified when the wanted contents change.
    pub fn changes(&self) -> watch::Receiver<Wishes> {
        self.0.subscribe()
    }

    /// The contents that are wanted.
    pub fn wanted(&self) -> Vec<Wish> {
        self.0
            .borrow()
            .wanted
            .iter()
            .map(|(digest, wanted)| Wish { digest: *digest, number: wanted.number })
            .collect()
    }

    /// Size of the largest wanted content.
    pub fn largest_bytes(&self) -> u64 {
        self.0.borrow().wanted.values().map(|wanted| wanted.size).max().unwrap_or(0)
    }

    /// The channel for the parts of a content, if the content is wanted.
    pub fn way_to(&self, digest: &Digest) -> Option<mpsc::Sender<Arrived>> {
        self.0.borrow().wanted.get(digest).map(|wanted| wanted.parts.clone())
    }

    /// Sets the state of the subscription for this request.
    pub fn tell(&self, wish: &Wish, hearing: Hearing) {
        if let Some(wanted) =
            self.0.borrow().wanted.get(&wish.digest).filter(|wanted| wanted.number == wish.number)
        {
            wanted.hearing.send_replace(hearing);
        }
    }

    /// Sets whether a session is up. Either way all subscriptions are gone. Before the first call a
    /// session may still come up soon.
    pub fn session(&self, is_up: bool) {
        self.0.send_modify(|wishes| {
            wishes.is_away = !is_up;
            for wanted in wishes.wanted.values() {
                wanted.hearing.send_replace(if is_up { Hearing::Asked } else { Hearing::Away });
            }
        });
    }
}

impl Drop for Ear {
    fn drop(&mut self) {
        let Wish { digest, number } = self.wish;
        self.listening.0.send_if_modified(|Wishes { wanted, .. }| {
            // Another task may have requested the same content since.
            let is_mine = wanted.get(&digest).is_some_and(|wanted| wanted.number == number);
            is_mine && wanted.remove(&digest).is_some()
        });
    }
}

impl Acknowledgement {
    /// An acknowledgement of the message `due`, sent through `acknowledge`.
    pub fn new(due: Due, acknowledge: mpsc::Sender<Due>) -> Self {
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
    async fn a_part_is_acknowledged_when_it_was_dealt_with() {
        let listening = Listening::default();
        let digest = Digest::of(b"content");
        let mut ear = listening.listen(digest, 7);
        assert_eq!((listening.wanted(), listening.largest_bytes()), (vec![ear.wish], 7));
        let (acknowledge, mut acknowledged) = mpsc::channel(4);
        let due = Due { packet_id: 3, qos: 1 };
        let message = Bytes::from_static(b"part");
        let arrived = Arrived { message, acknowledgement: Acknowledgement::new(due, acknowledge) };
        listening.way_to(&digest).expect("wanted").send(arrived).await.expect("room");
        let arrived = ear.parts.recv().await.expect("sent");
        assert!(acknowledged.try_recv().is_err());
        drop(arrived);
        assert_eq!(acknowledged.try_recv(), Ok(due));
    }

    #[test]
    fn who_listens_anew_is_not_ended_by_the_one_before() {
        let listening = Listening::default();
        let digest = Digest::of(b"content");
        let first = listening.listen(digest, 7);
        let second = listening.listen(digest, 7);
        listening.tell(&first.wish, Hearing::Yes);
        assert_eq!(*second.hearing.borrow(), Hearing::Asked, "it has not subscribed");
        let mut changes = listening.changes();
        changes.mark_unchanged();
        drop(first);
        assert!(!changes.has_changed().expect("it lives"));
        listening.tell(&second.wish, Hearing::Yes);
        assert_eq!((*second.hearing.borrow(), listening.wanted().len()), (Hearing::Yes, 1));
        drop(second);
        assert!(changes.has_changed().expect("it lives") && listening.wanted().is_empty());
    }

    #[test]
    fn with_the_session_all_subscriptions_are_gone() {
        let listening = Listening::default();
        let hearing = |ear: &Ear| *ear.hearing.borrow();
        let first = listening.listen(Digest::of(b"first"), 1);
        assert_eq!(hearing(&first), Hearing::Asked, "a session may come about at any moment");
        listening.session(true);
        listening.tell(&first.wish, Hearing::Yes);
        listening.session(false);
        let second = listening.listen(Digest::of(b"second"), 2);
        assert_eq!((hearing(&first), hearing(&second)), (Hearing::Away, Hearing::Away));
        listening.session(true);
        assert_eq!((hearing(&first), hearing(&second)), (Hearing::Asked, Hearing::Asked));
    }
}
