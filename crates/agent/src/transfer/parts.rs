//! Whose parts this robot wants to hear: what the MQTT session subscribes to, and the way of a part
//! from the session to whoever gathers it. A part is acknowledged when its [`Arrived`] is dropped,
//! so who is slow to write slows the sender down and nothing piles up here. It knows neither MQTT's
//! packets nor the disk.

use std::collections::BTreeMap;
use task_proto::part::PartRange;

use bytes::Bytes;
use task_proto::Digest;
use tokio::sync::{mpsc, watch};

/// What a robot that listens says of the parts it lacks.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Asks {
    /// What its next report says, whatever that is sent for.
    pub missing: Option<Vec<PartRange>>,
    /// Counts up each time that a report is to be sent for it, also if it says the same as the last
    /// one.
    pub times: u32,
}

/// Parts that nobody has taken yet, of one content. A part may be a whole package.
const QUEUED_PARTS: usize = 2;

/// The contents whose parts are wanted. Clones are the same.
#[derive(Debug, Clone, Default)]
pub struct Listening(watch::Sender<Wishes>);

/// What is wanted, and whether there is a session to hear it by.
#[derive(Debug, Default)]
pub struct Wishes {
    is_away: bool,
    /// How often something was wanted.
    number: u64,
    wanted: BTreeMap<Digest, Wanted>,
}

/// That somebody gathers a content's parts. Who does it anew has another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wish {
    /// The content.
    pub digest: Digest,
    number: u64,
}

/// One content whose parts are wanted.
#[derive(Debug)]
struct Wanted {
    number: u64,
    size: u64,
    parts: mpsc::Sender<Arrived>,
    hearing: watch::Sender<Hearing>,
}

/// How the subscription to a content's parts stands.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Hearing {
    /// There is no answer yet.
    #[default]
    Asked,
    /// There is no session.
    Away,
    /// The broker does not allow it now.
    Refused,
    /// Parts that are published from now on arrive.
    Yes,
}

/// Who gathers the parts of one content. Dropped, nobody does.
#[derive(Debug)]
pub struct Ear {
    wish: Wish,
    listening: Listening,
    /// What arrives.
    pub parts: mpsc::Receiver<Arrived>,
    /// How the subscription stands.
    pub hearing: watch::Receiver<Hearing>,
}

/// A message on a content's topic, not looked into.
#[derive(Debug)]
pub struct Arrived {
    /// The message.
    pub message: Bytes,
    /// The sender may go on when this is dropped.
    pub acknowledgement: Acknowledgement,
}

/// A message's acknowledgement, which is due when this is dropped.
#[derive(Debug)]
pub struct Acknowledgement {
    due: Due,
    acknowledge: mpsc::Sender<Due>,
}

/// Which message to acknowledge, and how.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Due {
    /// Its packet id.
    pub packet_id: u16,
    /// Its quality of service.
    pub qos: u8,
}

impl Listening {
    /// Wants the parts of the content of `size` bytes from now on.
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

    /// Changes when other contents are wanted than before.
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

    /// The largest content that is wanted.
    pub fn largest_bytes(&self) -> u64 {
        self.0.borrow().wanted.values().map(|wanted| wanted.size).max().unwrap_or(0)
    }

    /// Where the parts of a content go, if it is wanted.
    pub fn way_to(&self, digest: &Digest) -> Option<mpsc::Sender<Arrived>> {
        self.0.borrow().wanted.get(digest).map(|wanted| wanted.parts.clone())
    }

    /// Says how the subscription stands that was made for this wish.
    pub fn tell(&self, wish: &Wish, hearing: Hearing) {
        if let Some(wanted) =
            self.0.borrow().wanted.get(&wish.digest).filter(|wanted| wanted.number == wish.number)
        {
            wanted.hearing.send_replace(hearing);
        }
    }

    /// Says whether there is a session; either way there are no subscriptions yet. Until it was
    /// said there may be one soon.
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
            // Another may want the same content by now.
            let is_mine = wanted.get(&digest).is_some_and(|wanted| wanted.number == number);
            is_mine && wanted.remove(&digest).is_some()
        });
    }
}

impl Acknowledgement {
    /// Of the message `due`, to be asked for through `acknowledge`.
    pub fn new(due: Due, acknowledge: mpsc::Sender<Due>) -> Self {
        Self { due, acknowledge }
    }
}

impl Drop for Acknowledgement {
    fn drop(&mut self) {
        // Without its session there is nobody to acknowledge it to; brokers have far fewer messages
        // in flight than fit.
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
