//! Owns rumqttd's router thread: a message published here reaches every subscriber. The router
//! never sees a client's bytes, topics or filters unchecked, because some of them kill its thread.
//! The router also keeps a log for each filter and a record for each link name for ever, so we use
//! two filters and a fixed set of names. Subscribers select their messages themselves.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use rumqttd::local::{LinkBuilder, LinkError, LinkRx, LinkTx};
use rumqttd::protocol::{Disconnect, DisconnectReasonCode, Packet, Publish, QoS};
use rumqttd::{Notification, RouterConfig};
use task_proto::messages::topic::TopicPrefix;
use tokio::sync::{Notify, oneshot};
use tokio_util::sync::CancellationToken;

/// The topic of the watchdog's canary. No prefix can contain a space, so there is no collision.
pub(super) const CANARY_TOPIC: &str = "router canary";
/// Maximum backlog of the publishing link; when the router is this far behind, messages to
/// subscribers are dropped.
const MAX_BACKLOG: usize = 1000;
/// The router's log for each of the two filters: the maximum lag of a subscriber before messages
/// are lost.
const SEGMENT_BYTES: usize = 2 * 1024 * 1024;
const SEGMENTS: usize = 4;
/// Messages that the router hands a subscriber at a time.
const MAX_BATCH: u64 = 32;
/// Links besides the subscribers': the publisher's, the canary's, and some that are just ending.
const OTHER_LINKS: usize = 16;
/// Time limit for the router to answer a new link.
const LINK_TIMEOUT: Duration = Duration::from_secs(5);

/// The router, also across restarts of its thread.
pub(super) struct Router {
    everything: String,
    /// The free link names.
    free_slots: Mutex<Vec<usize>>,
    max_links: usize,
    subscribers: AtomicUsize,
    dropped: AtomicU64,
    current: Mutex<Arc<Running>>,
    failure_observed: Notify,
}

/// One life of the router's thread.
struct Running {
    connect: Connect,
    publisher: Mutex<LinkTx>,
    /// Cancelled when another thread has replaced this one.
    replaced: CancellationToken,
}

/// Builds a link by name, if the thread lives. This call blocks. (The type of the router's sender
/// can't be named, so a closure holds the sender.)
type Connect = Arc<dyn Fn(&str) -> Option<(LinkTx, LinkRx)> + Send + Sync>;

/// The topics of a subscriber.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Topics {
    /// Everything below the prefix.
    Everything,
    Canary,
}

/// A message from the router.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Message {
    pub(super) topic: String,
    pub(super) payload: Bytes,
    pub(super) qos: QoS,
}

/// The reason why there is no subscriber, or why a subscription has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum RouterError {
    #[error("the router's thread has ended")]
    Gone,
    #[error("the router does not answer")]
    Stuck,
    #[error("the maximum number of subscribers is reached")]
    Full,
}

impl Router {
    /// Starts the router's thread.
    pub(super) async fn start(
        prefix: &TopicPrefix,
        max_subscribers: usize,
    ) -> Result<Arc<Self>, RouterError> {
        let everything = format!("{prefix}/#");
        let max_links = max_subscribers + OTHER_LINKS;
        let running = Running::start(&everything, max_links).await?;
        Ok(Arc::new(Self {
            everything,
            free_slots: Mutex::new((0..max_subscribers).rev().collect()),
            max_links,
            subscribers: AtomicUsize::new(0),
            dropped: AtomicU64::new(0),
            current: Mutex::new(Arc::new(running)),
            failure_observed: Notify::new(),
        }))
    }

    /// Replaces the thread by a new one. Subscribers of the old thread see that it is gone.
    pub(super) async fn restart(&self) -> Result<(), RouterError> {
        let running = Arc::new(Running::start(&self.everything, self.max_links).await?);
        let before = std::mem::replace(&mut *lock(&self.current), running);
        before.replaced.cancel();
        Ok(())
    }

    /// Publishes to all current subscribers. Never waits; messages that a failing router can't take
    /// are dropped, and the watchdog is told.
    pub(super) fn publish(&self, topic: &str, qos: QoS, payload: Bytes) {
        if topic != CANARY_TOPIC && self.subscribers.load(Ordering::Relaxed) == 0 {
            return;
        }
        if !self.enqueue(topic, qos, payload) {
            self.dropped.fetch_add(1, Ordering::Relaxed);
            tracing::debug!(topic, "the router is behind; dropped a message for subscribers");
        }
    }

    fn enqueue(&self, topic: &str, qos: QoS, payload: Bytes) -> bool {
        let running = lock(&self.current).clone();
        let mut publisher = lock(&running.publisher);
        let is_behind = publisher.buffer().len() >= MAX_BACKLOG;
        if !is_behind {
            // Inside the router all messages are QoS 0, so the real QoS travels as one more level
            // of the topic.
            let message =
                Publish::new(Bytes::from(format!("{topic}/{}", qos as u8)), payload, false);
            publisher.buffer().push_back(Packet::Publish(message, None));
        }
        // Signals that the buffer is not empty; a full channel already contains many such notes.
        if let Err(LinkError::TrySend(flume::TrySendError::Disconnected(_))) =
            publisher.try_unsubscribe(NO_FILTER)
        {
            self.failure_observed.notify_one();
        }
        if is_behind {
            // The note itself must not make the backlog longer.
            publisher.buffer().pop_back();
        }
        !is_behind
    }

    /// Messages dropped so far.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// A new subscriber, which receives messages published from now on.
    pub(super) async fn subscribe(
        self: &Arc<Self>,
        topics: Topics,
    ) -> Result<Subscriber, RouterError> {
        let running = lock(&self.current).clone();
        let (filter, name, slot) = match topics {
            Topics::Everything => {
                let slot = SubscriberSlot::take(self.clone())?;
                (self.everything.clone(), format!("listener-{}", slot.number), Some(slot))
            }
            Topics::Canary => (format!("{CANARY_TOPIC}/#"), "canary".to_owned(), None),
        };
        let link = Link::open(&running.connect, name, slot).await?;
        let mut subscriber =
            Subscriber { link, replaced: running.replaced.clone(), must_confirm: false };
        subscriber.subscribe_to(filter).await?;
        Ok(subscriber)
    }

    /// Returns when an observation proves that the router is dead.
    pub(super) async fn failure_observed(&self) {
        self.failure_observed.notified().await;
    }

    /// Kills the router's thread in the same way as a client once could: by a topic that is not
    /// ASCII.
    #[cfg(test)]
    pub(super) fn kill(&self) {
        let running = lock(&self.current).clone();
        let _ = lock(&running.publisher).publish("é", "x");
    }
}

/// A filter without subscribers.
const NO_FILTER: &str = "";

impl Running {
    async fn start(everything: &str, max_links: usize) -> Result<Self, RouterError> {
        let config = RouterConfig {
            max_connections: max_links,
            max_outgoing_packet_count: MAX_BATCH,
            max_segment_size: SEGMENT_BYTES,
            max_segment_count: SEGMENTS,
            initialized_filters: Some(vec![everything.to_owned(), format!("{CANARY_TOPIC}/#")]),
            ..RouterConfig::default()
        };
        let sender = rumqttd::Router::new(0, config).spawn();
        let connect: Connect = Arc::new(move |name| {
            LinkBuilder::new(name, sender.clone()).build().ok().map(|(tx, rx, _)| (tx, rx))
        });
        let mut link = Link::open(&connect, "publisher".to_owned(), None).await?;
        let publisher = link.tx.take().ok_or(RouterError::Gone)?;
        Ok(Self { connect, publisher: Mutex::new(publisher), replaced: CancellationToken::new() })
    }
}

/// A link to the router's thread, which is notified when the link is dropped.
struct Link {
    tx: Option<LinkTx>,
    rx: LinkRx,
    /// Freed only after the router was told that the link is gone.
    _slot: Option<SubscriberSlot>,
}

impl Link {
    async fn open(
        connect: &Connect,
        name: String,
        slot: Option<SubscriberSlot>,
    ) -> Result<Self, RouterError> {
        let (reply, answer) = oneshot::channel();
        let connect = connect.clone();
        // A separate thread: if the router dies now, this call waits for ever, and the runtime
        // would wait with it.
        std::thread::spawn(move || {
            let link = connect(&name).map(|(tx, rx)| Link { tx: Some(tx), rx, _slot: slot });
            // If the receiver is gone, the link is dropped, and so closed, right here.
            let _ = reply.send(link);
        });
        match tokio::time::timeout(LINK_TIMEOUT, answer).await {
            Ok(Ok(Some(link))) => Ok(link),
            Ok(_) => Err(RouterError::Gone),
            Err(_) => Err(RouterError::Stuck),
        }
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        let Some(mut tx) = self.tx.take() else { return };
        let reason_code = DisconnectReasonCode::NormalDisconnection;
        tx.buffer().push_back(Packet::Disconnect(Disconnect { reason_code }, None));
        if let Err(LinkError::TrySend(flume::TrySendError::Full(_))) = tx.try_unsubscribe(NO_FILTER)
        {
            // The router is busy and must not miss this: wait in a thread that holds up nothing
            // else.
            std::thread::spawn(move || tx.unsubscribe(NO_FILTER).is_ok());
        }
    }
}

/// One of the names of subscribers' links, freed when this is dropped.
struct SubscriberSlot {
    router: Arc<Router>,
    number: usize,
}

impl SubscriberSlot {
    fn take(router: Arc<Router>) -> Result<Self, RouterError> {
        let number = lock(&router.free_slots).pop().ok_or(RouterError::Full)?;
        router.subscribers.fetch_add(1, Ordering::Relaxed);
        Ok(Self { router, number })
    }
}

impl Drop for SubscriberSlot {
    fn drop(&mut self) {
        self.router.subscribers.fetch_sub(1, Ordering::Relaxed);
        lock(&self.router.free_slots).push(self.number);
    }
}

pub(super) struct Subscriber {
    link: Link,
    replaced: CancellationToken,
    /// The router waits for the confirmation that its last batch was taken.
    must_confirm: bool,
}

impl Subscriber {
    async fn subscribe_to(&mut self, filter: String) -> Result<(), RouterError> {
        let tx = self.link.tx.as_mut().ok_or(RouterError::Gone)?;
        tx.try_subscribe(filter).map_err(|error| match error {
            LinkError::TrySend(flume::TrySendError::Full(_)) => RouterError::Stuck,
            _ => RouterError::Gone,
        })?;
        let acknowledged = async {
            while !matches!(self.notification().await?, Some(Notification::DeviceAck(_))) {}
            Ok(())
        };
        tokio::time::timeout(LINK_TIMEOUT, acknowledged).await.unwrap_or(Err(RouterError::Stuck))
    }

    /// The next message. Cancel-safe.
    pub(super) async fn next(&mut self) -> Result<Message, RouterError> {
        loop {
            if self.must_confirm {
                self.link.rx.wake().await.map_err(|_| RouterError::Gone)?;
                self.must_confirm = false;
            }
            match self.notification().await? {
                Some(Notification::Forward(forward)) => {
                    return original_message(forward.publish).ok_or(RouterError::Gone);
                }
                // The last of its batch.
                Some(Notification::Unschedule) => self.must_confirm = true,
                _ => {}
            }
        }
    }

    async fn notification(&mut self) -> Result<Option<Notification>, RouterError> {
        tokio::select! {
            notification = self.link.rx.next() => notification.map_err(|_| RouterError::Gone),
            () = self.replaced.cancelled() => Err(RouterError::Gone),
        }
    }
}

/// Undoes what [`Router::publish`] did to the topic.
fn original_message(publish: Publish) -> Option<Message> {
    let (topic, qos) = std::str::from_utf8(&publish.topic).ok()?.rsplit_once('/')?;
    let qos = rumqttd::protocol::qos(qos.parse().ok()?)?;
    Some(Message { topic: topic.to_owned(), payload: publish.payload, qos })
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing
    // half-done.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
