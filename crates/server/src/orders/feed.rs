//! The feed: the latest noteworthy events of the fleet, as rows of the database. Similar events are
//! gathered for a moment and reported together, so that a restart of the server is one line and not
//! ten thousand. Gathering never waits for the database to store an entry: what the database does
//! not take in time is dropped and counted. Events that must not be lost are in the audit.

mod pending;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use task_proto::api::FeedKind;
use task_proto::telemetry::log::LogLevel;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use self::pending::Pending;
use super::changes::{Change, Changes};
use crate::broker::{Broker, Health};
use crate::store::{FeedAudience, NewFeedEntry, Store};
use crate::system::clock::Clock;
use crate::system::data_directory::disk_space;

/// Interval between two passes over the gathered events.
const TICK: Duration = Duration::from_secs(1);
/// Interval between checks of the disk, in ticks.
const DISK_TICKS: u64 = 60;
/// The most batches that wait to be stored: those of a minute.
const MAX_BATCHES: usize = 60;
/// Longer texts are cut.
const MAX_CHARACTERS: usize = 500;
/// Below this share of free space, in percent, the disk is nearly full.
const MIN_FREE_PERCENT: u64 = 5;

/// Inputs of the feed.
pub struct FeedSource {
    /// The database, for names and for the entries.
    pub store: Store,
    /// The broker, for its health.
    pub broker: Broker,
    pub clock: Clock,
    /// A directory on the monitored disk.
    pub data: PathBuf,
}

/// Gathers events and reports them, until `stop`. Then the entries that still wait are stored.
pub async fn run(source: FeedSource, changes: Changes, stop: CancellationToken) {
    let (queue, batches) = queue();
    let store = source.store.clone();
    tokio::join!(gather(source, queue, &changes, stop), store_batches(batches, &store, &changes));
}

async fn gather(
    source: FeedSource,
    queue: BatchSender,
    changes: &Changes,
    stop: CancellationToken,
) {
    let (mut events, mut notices) = (changes.fleet_events(), changes.subscribe_here());
    let mut health = source.broker.health();
    let (mut pending, mut tick_count) = (Pending::default(), 0u64);
    let (mut was_healthy, mut had_space) = (true, true);
    let mut ticks = tokio::time::interval(TICK);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        let mut entries = Vec::new();
        tokio::select! {
            () = stop.cancelled() => return,
            event = events.recv() => match event {
                Ok(event) => pending.take(event),
                // Events beyond the channel's capacity are too many to read.
                Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => return,
            },
            notice = notices.recv() => match notice {
                Ok(Change::Deployment(id)) => pending.deployment(id),
                Ok(Change::RobotRemoved(robot)) => pending.removed(*robot),
                Err(RecvError::Closed) => return,
                Ok(_) | Err(RecvError::Lagged(_)) => {}
            },
            Ok(()) = health.changed() => entries.extend(broker_entry(&health.borrow_and_update(), &mut was_healthy)),
            _ = ticks.tick() => {
                tick_count += 1;
                if tick_count % DISK_TICKS == 1 {
                    entries.extend(disk_entry(&source, &mut had_space));
                }
                entries.extend(pending.due(&source.store, source.clock.now_ms()).await);
            }
        }
        queue.send(entries, source.clock.now_ms());
    }
}

/// Entries of one moment.
struct Batch {
    entries: Vec<NewFeedEntry>,
    at_ms: u64,
}

/// The end of the queue that takes batches, and never waits.
struct BatchSender {
    batches: mpsc::Sender<Batch>,
    dropped: Arc<AtomicU64>,
}

/// The end of the queue that the writer reads.
struct BatchReceiver {
    batches: mpsc::Receiver<Batch>,
    /// The number of entries dropped since the database last stored some.
    dropped: Arc<AtomicU64>,
}

fn queue() -> (BatchSender, BatchReceiver) {
    let ((sender, receiver), dropped) = (mpsc::channel(MAX_BATCHES), Arc::<AtomicU64>::default());
    let sender = BatchSender { batches: sender, dropped: dropped.clone() };
    (sender, BatchReceiver { batches: receiver, dropped })
}

impl BatchSender {
    /// Queues entries of the time `at_ms`. A full queue drops them.
    fn send(&self, mut entries: Vec<NewFeedEntry>, at_ms: u64) {
        if entries.is_empty() {
            return;
        }
        entries.iter_mut().for_each(|entry| entry.text = one_line(&entry.text));
        let count = entries.len() as u64;
        if self.batches.try_send(Batch { entries, at_ms }).is_err() {
            self.dropped.fetch_add(count, Ordering::Relaxed);
        }
    }
}

/// Stores batches and announces their numbers, until the queue has ended.
async fn store_batches(mut queue: BatchReceiver, store: &Store, changes: &Changes) {
    while let Some(Batch { entries, at_ms }) = queue.batches.recv().await {
        match store.feed().append(&entries, at_ms).await {
            Ok(numbers) => {
                let dropped = queue.dropped.swap(0, Ordering::Relaxed);
                if dropped > 0 {
                    tracing::warn!(dropped, "the database did not store entries of the feed");
                }
                let (first, last) = numbers.into_inner();
                changes.announce(Change::Feed { first, last });
            }
            Err(error) => {
                queue.dropped.fetch_add(entries.len() as u64, Ordering::Relaxed);
                error.log("entries of the feed could not be stored");
            }
        }
    }
}

/// A text that may come from a robot, as one line of limited length.
fn one_line(text: &str) -> String {
    let mut characters = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    let line: String = characters.by_ref().take(MAX_CHARACTERS).collect();
    if characters.next().is_some() { line + "…" } else { line }
}

fn broker_entry(health: &Health, was_healthy: &mut bool) -> Option<NewFeedEntry> {
    let (is_healthy, text) = match health {
        Health::Serving => (true, "the MQTT broker works again".to_owned()),
        Health::Recovering(seen) | Health::Failed(seen) => {
            (false, format!("the MQTT broker has a problem: {seen}"))
        }
    };
    (std::mem::replace(was_healthy, is_healthy) != is_healthy)
        .then(|| server_entry(FeedKind::Broker, is_healthy, text))
}

fn disk_entry(source: &FeedSource, had_space: &mut bool) -> Option<NewFeedEntry> {
    let (free, all) = disk_space(&source.data)?;
    let percent = free.saturating_mul(100).checked_div(all)?;
    let has_space = percent >= MIN_FREE_PERCENT;
    let text = format!("{percent}% of the server's disk is free");
    (std::mem::replace(had_space, has_space) != has_space)
        .then(|| server_entry(FeedKind::Disk, has_space, text))
}

fn server_entry(kind: FeedKind, is_healthy: bool, text: String) -> NewFeedEntry {
    let level = if is_healthy { LogLevel::Info } else { LogLevel::Error };
    let (robot, deployment, audience) = (None, None, FeedAudience::Everybody);
    NewFeedEntry { kind, level, robot, deployment, text, audience }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::sqlite_url;

    #[tokio::test]
    async fn entries_beyond_the_queue_are_dropped_and_counted() {
        let (sender, mut receiver) = queue();
        let entries = || vec![server_entry(FeedKind::Disk, true, "one\ntwo".to_owned()); 3];
        sender.send(Vec::new(), 0);
        for at_ms in 0..MAX_BATCHES as u64 + 2 {
            sender.send(entries(), at_ms);
        }
        assert_eq!(receiver.dropped.load(Ordering::Relaxed), 6);
        drop(sender);
        let mut kept = Vec::new();
        while let Some(Batch { entries, at_ms }) = receiver.batches.recv().await {
            assert!(entries.iter().all(|entry| entry.text == "one two"));
            kept.push(at_ms);
        }
        assert_eq!(kept, (0..MAX_BATCHES as u64).collect::<Vec<_>>());
    }

    #[tokio::test]
    async fn entries_that_the_database_refuses_are_dropped_and_counted() {
        let directory = tempfile::tempdir().expect("a directory");
        let url = sqlite_url(&directory.path().join("taskd.db"));
        let refusing = Store::open(&url).await.expect("opens");
        refusing.close().await;
        let ((sender, receiver), changes) = (queue(), Changes::new());
        let (dropped, mut notices) = (receiver.dropped.clone(), changes.subscribe());
        let entry = |text: &str| server_entry(FeedKind::Disk, true, text.to_owned());
        sender.send(vec![entry("one"), entry("two")], 7);
        sender.send(vec![entry("three")], 8);
        drop(sender);
        store_batches(receiver, &refusing, &changes).await;
        assert_eq!(dropped.load(Ordering::Relaxed), 3);

        let ((sender, receiver), store) = (queue(), Store::open(&url).await.expect("opens"));
        let dropped = receiver.dropped.clone();
        dropped.store(3, Ordering::Relaxed);
        sender.send(vec![entry("four"), entry("five")], 9);
        drop(sender);
        store_batches(receiver, &store, &changes).await;
        assert_eq!(dropped.load(Ordering::Relaxed), 0, "it was logged");
        assert_eq!(notices.try_recv(), Ok(Change::Feed { first: 9, last: 10 }));
        let stored = store.feed().after(0).await.expect("reads");
        assert_eq!(
            stored.iter().map(|(entry, _)| &*entry.text).collect::<Vec<_>>(),
            ["four", "five"]
        );
        store.close().await;
    }

    #[test]
    fn failure_and_recovery_are_reported_once_each() {
        let mut was_healthy = true;
        assert!(broker_entry(&Health::Serving, &mut was_healthy).is_none());
        let recovering = Health::Recovering("no canary".to_owned());
        assert_eq!(
            broker_entry(&recovering, &mut was_healthy).map(|entry| entry.level),
            Some(LogLevel::Error)
        );
        assert!(
            broker_entry(&Health::Recovering("still none".to_owned()), &mut was_healthy).is_none()
        );
        assert_eq!(
            broker_entry(&Health::Serving, &mut was_healthy).map(|entry| entry.level),
            Some(LogLevel::Info)
        );
    }
}
