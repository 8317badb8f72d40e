//! The bus through the database: `NOTIFY` in small transactions of its own, and one connection that
//! only listens. This module keeps no message that can't be delivered.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use tokio::sync::mpsc;
use tokio_util::task::AbortOnDropHandle;

use super::bus::{Bus, Received};
use super::message::{ClusterMessage, Packet, pack};
use crate::store::{NotificationListener, Store};

/// Packets that wait to be handled. If there are more, the rest is missed.
const MAX_WAITING: usize = 1024;
/// The longest silence on the connection that listens, which hears this server's own packets too;
/// one is sent with each heartbeat.
const MAX_SILENCE: Duration = Duration::from_secs(7);
/// Pause before the next attempt to listen.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);
/// Maximum runs whose packets are counted.
const MAX_SENDERS: usize = 1024;

/// Sends and receives through the database.
pub(super) struct PostgresBus {
    store: Store,
    run: Arc<str>,
    sequence: AtomicU64,
    received: tokio::sync::Mutex<mpsc::Receiver<Received>>,
    inlet: Inlet,
    _listening: AbortOnDropHandle<()>,
}

/// The end of the queue of received packets that takes them, and never waits.
#[derive(Clone)]
struct Inlet {
    queue: mpsc::Sender<Received>,
    /// Whether the queue was full.
    has_overflown: Arc<AtomicBool>,
    problem: Arc<Mutex<Option<String>>>,
}

impl PostgresBus {
    pub(super) fn new(store: Store, run: Arc<str>) -> Self {
        let (queue, received) = mpsc::channel(MAX_WAITING);
        let problem = Some("it has not been reached yet".to_owned());
        let inlet =
            Inlet { queue, has_overflown: Arc::default(), problem: Arc::new(Mutex::new(problem)) };
        let listening = tokio::spawn(listen(store.clone(), run.clone(), inlet.clone()));
        Self {
            store,
            run,
            sequence: AtomicU64::new(0),
            received: tokio::sync::Mutex::new(received),
            inlet,
            _listening: AbortOnDropHandle::new(listening),
        }
    }

    async fn send(&self, messages: Vec<ClusterMessage>) {
        let next = || self.sequence.fetch_add(1, Ordering::Relaxed) + 1;
        for packet in pack(&self.run, next, messages) {
            // The number of a packet that is not sent is missing, which the others notice.
            if let Err(error) = self.store.notify(&packet).await {
                error.log("the other servers were not notified; they look by themselves");
            }
        }
    }
}

impl Bus for PostgresBus {
    fn announce(&self, messages: Vec<ClusterMessage>) -> BoxFuture<'_, ()> {
        self.send(messages).boxed()
    }

    fn receive(&self) -> BoxFuture<'_, Received> {
        async move {
            let mut received = self.received.lock().await;
            if self.inlet.has_overflown.swap(false, Ordering::AcqRel) {
                return Received::Gap;
            }
            match received.recv().await {
                Some(received) => received,
                // The listening task ends only with this value.
                None => std::future::pending().await,
            }
        }
        .boxed()
    }

    fn problem(&self) -> Option<String> {
        self.inlet.problem.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Inlet {
    fn put(&self, received: Received) {
        if self.queue.try_send(received).is_err() {
            self.has_overflown.store(true, Ordering::Release);
        }
    }

    /// Records whether the bus works. Returns whether that is new.
    fn set_problem(&self, problem: Option<String>) -> bool {
        let mut known = self.problem.lock().unwrap_or_else(PoisonError::into_inner);
        let is_new = known.is_some() != problem.is_some();
        *known = problem;
        is_new
    }
}

/// Listens without end. Each new connection is a gap.
async fn listen(store: Store, run: Arc<str>, inlet: Inlet) {
    let mut was_connected = false;
    loop {
        store.state().available().await;
        match store.listen().await {
            Ok(listener) => {
                inlet.put(Received::Gap);
                if inlet.set_problem(None) && was_connected {
                    tracing::info!("other servers' notifications arrive again");
                }
                was_connected = true;
                read(listener, &run, &inlet).await;
                inlet.set_problem(Some("the connection that listens was lost".to_owned()));
                tracing::warn!("the connection for other servers' notifications was lost");
            }
            Err(error) => {
                inlet.set_problem(Some(error.to_string()));
                error.log("other servers' notifications can't be received");
            }
        }
        tokio::time::sleep(RETRY_INTERVAL).await;
    }
}

/// Reads until the connection is lost or silent.
async fn read(mut listener: NotificationListener, run: &str, inlet: &Inlet) {
    let mut senders = Senders::default();
    while let Ok(Some(text)) = tokio::time::timeout(MAX_SILENCE, listener.next()).await {
        let Ok(packet) = serde_json::from_str::<Packet>(&text) else {
            tracing::debug!("another server's notification can't be read");
            inlet.put(Received::Gap);
            continue;
        };
        if packet.run == run {
            continue;
        }
        if senders.has_skipped(&packet) {
            inlet.put(Received::Gap);
        }
        let messages = packet.into_messages();
        if !messages.is_empty() {
            inlet.put(Received::Messages(messages));
        }
    }
}

/// The last packet of each sender.
#[derive(Default)]
struct Senders(HashMap<String, u64>);

impl Senders {
    /// Counts a packet. Returns whether one before it was missed.
    fn has_skipped(&mut self, packet: &Packet) -> bool {
        if self.0.len() >= MAX_SENDERS && !self.0.contains_key(&packet.run) {
            self.0.clear();
        }
        let before = self.0.insert(packet.run.clone(), packet.sequence);
        before.is_some_and(|before| packet.sequence > before + 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn skipped_number_of_a_sender_is_noticed() {
        let mut senders = Senders::default();
        let mut receives = |run: &str, sequence: u64| {
            let text = format!(r#"{{"run": "{run}", "sequence": {sequence}}}"#);
            senders.has_skipped(&serde_json::from_str(&text).expect("a packet"))
        };
        assert!(!receives("b-1", 7), "the first that is heard");
        assert!(!receives("c-1", 1) && !receives("b-1", 8) && !receives("b-1", 8));
        assert!(receives("b-1", 10) && !receives("b-1", 11) && !receives("c-1", 2));
    }
}
