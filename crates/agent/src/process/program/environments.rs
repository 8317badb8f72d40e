//! Reads the environments of many processes. The kernel blocks the reader for as long as the memory
//! of the other process is locked. A hanging driver, a hanging network file system, or any user
//! with a file system of their own can make this permanent. So a separate thread does the reading,
//! and a process whose environment does not arrive delays one call, once.

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::Duration;

use super::ProcessEntry;

/// Maximum time for one environment to arrive.
const READ_TIMEOUT: Duration = Duration::from_millis(500);
/// Maximum number of missing environments per call; the remaining processes are not examined.
const MAX_WAITS: usize = 10;

/// A process: its pid and its start time.
type Key = (u32, u64);

/// Processes that an abandoned reader thread still waits for.
static STALLED: StalledReads = StalledReads(Mutex::new(None));

/// Results of `read` on the environment of each of `entries`, except those that do not arrive.
/// `read` may block forever.
pub fn read_all<T: Send + 'static>(
    entries: Vec<ProcessEntry>,
    read: impl Fn(&ProcessEntry) -> T + Clone + Send + 'static,
) -> Vec<(ProcessEntry, T)> {
    STALLED.read_all(entries, read)
}

struct StalledReads(Mutex<Option<HashMap<Key, Reader>>>);

/// A thread that reads processes one after another, and the number of processes it has read.
#[derive(Clone)]
struct Reader {
    read: Arc<AtomicUsize>,
    /// Index of the process at which the reader was abandoned.
    at: usize,
}

impl StalledReads {
    fn read_all<T: Send + 'static>(
        &self,
        entries: Vec<ProcessEntry>,
        read: impl Fn(&ProcessEntry) -> T + Clone + Send + 'static,
    ) -> Vec<(ProcessEntry, T)> {
        let mut rest = self.without_stalled(entries);
        let mut found = Vec::with_capacity(rest.len());
        for _ in 0..MAX_WAITS {
            let (sender, receiver) = mpsc::channel();
            let count = Arc::new(AtomicUsize::new(0));
            let reading = rest.clone();
            let counting = count.clone();
            let read = read.clone();
            let work = move || {
                for entry in reading {
                    let what = read(&entry);
                    counting.fetch_add(1, Ordering::Release);
                    if sender.send((entry, what)).is_err() {
                        return;
                    }
                }
            };
            // Where no thread is available, for example because a task has taken them all, the
            // calling thread does the work.
            match std::thread::Builder::new().name("environments".to_owned()).spawn(work.clone()) {
                Ok(_) => drop(work),
                Err(_) => work(),
            }
            let before = found.len();
            while let Ok(one) = receiver.recv_timeout(READ_TIMEOUT) {
                found.push(one);
            }
            rest.drain(..found.len() - before);
            let Some(stalled) = rest.first() else { return found };
            tracing::warn!(
                pid = stalled.pid,
                "cannot read the environment of a process: its memory is locked"
            );
            self.note(stalled, Reader { read: count, at: found.len() - before });
            rest.remove(0);
        }
        found
    }

    /// Filters out processes that a reader still waits for, and forgets those that no longer exist.
    fn without_stalled(&self, entries: Vec<ProcessEntry>) -> Vec<ProcessEntry> {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(known) = known.as_mut() else { return entries };
        known.retain(|_, reader| reader.read.load(Ordering::Acquire) == reader.at);
        entries.into_iter().filter(|entry| !known.contains_key(&key(entry))).collect()
    }

    fn note(&self, entry: &ProcessEntry, reader: Reader) {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        known.get_or_insert_default().insert(key(entry), reader);
    }
}

fn key(entry: &ProcessEntry) -> Key {
    (entry.pid, entry.start_ticks)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stalled_process_delays_only_the_first_call() {
        let entry =
            |pid| ProcessEntry { pid, parent: 1, group: pid, start_ticks: 0, is_zombie: false };
        let entries: Vec<_> = (1..=4).map(entry).collect();
        let stalled = StalledReads(Mutex::new(None));
        let (release, held) = mpsc::channel::<()>();
        let held = Arc::new(Mutex::new(held));
        let reads = Arc::new(AtomicUsize::new(0));
        let counting = reads.clone();
        let read = move |entry: &ProcessEntry| {
            if entry.pid == 2 {
                counting.fetch_add(1, Ordering::SeqCst);
                // Blocks until the test drops `release`.
                let _ = held.lock().expect("sound").recv();
            }
            entry.pid * 10
        };
        let read_all = || {
            stalled
                .read_all(entries.clone(), read.clone())
                .into_iter()
                .map(|(_, ten)| ten)
                .collect::<Vec<_>>()
        };
        assert_eq!(read_all(), [10, 30, 40]);
        assert_eq!(read_all(), [10, 30, 40]);
        assert_eq!(reads.load(Ordering::SeqCst), 1, "the stalled process is not waited for again");
        drop(release);
        let waiting = stalled.0.lock().expect("sound").as_ref().expect("noted")[&(2, 0)].clone();
        while waiting.read.load(Ordering::Acquire) == waiting.at {
            std::thread::yield_now();
        }
        assert_eq!(read_all(), [10, 20, 30, 40]);
    }
}
