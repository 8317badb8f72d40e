//! Looks into the environments of many processes. The kernel keeps who reads one waiting for as
//! long as that process's memory is locked, which a driver or a network file system that hangs, or
//! anybody with a file system of their own, makes for ever. So somebody else reads here, and a
//! process whose environment does not come holds up one look, once.

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::Duration;

use super::ProcessEntry;

/// How long one environment may take to come.
const PATIENCE: Duration = Duration::from_millis(500);
/// As many that do not come are waited for in one look; what is left is not looked into.
const MAX_WAITS: usize = 10;

/// A process: its pid and when it started.
type Key = (u32, u64);

/// Those that are still waited for, by whoever read them when it was too late.
static SILENT: Silent = Silent(Mutex::new(None));

/// What `read` finds in the environment of each of `entries`, but for those that do not come.
/// `read` may wait for ever.
pub fn look<T: Send + 'static>(
    entries: Vec<ProcessEntry>,
    read: impl Fn(&ProcessEntry) -> T + Clone + Send + 'static,
) -> Vec<(ProcessEntry, T)> {
    SILENT.look(entries, read)
}

struct Silent(Mutex<Option<HashMap<Key, Reader>>>);

/// Who reads processes one after another, and how many it has read.
#[derive(Clone)]
struct Reader {
    read: Arc<AtomicUsize>,
    /// Which of them it was at when nobody waited any longer.
    at: usize,
}

impl Silent {
    fn look<T: Send + 'static>(
        &self,
        entries: Vec<ProcessEntry>,
        read: impl Fn(&ProcessEntry) -> T + Clone + Send + 'static,
    ) -> Vec<(ProcessEntry, T)> {
        let mut rest = self.without_silent(entries);
        let mut found = Vec::with_capacity(rest.len());
        for _ in 0..MAX_WAITS {
            let (sender, receiver) = mpsc::channel();
            let count = Arc::new(AtomicUsize::new(0));
            let (reading, counting, read) = (rest.clone(), count.clone(), read.clone());
            let work = move || {
                for entry in reading {
                    let what = read(&entry);
                    counting.fetch_add(1, Ordering::Release);
                    if sender.send((entry, what)).is_err() {
                        return;
                    }
                }
            };
            // Where no thread can be had, as when a task has taken them all, what there is has to
            // do it.
            match std::thread::Builder::new().name("environments".to_owned()).spawn(work.clone()) {
                Ok(_) => drop(work),
                Err(_) => work(),
            }
            let before = found.len();
            while let Ok(one) = receiver.recv_timeout(PATIENCE) {
                found.push(one);
            }
            rest.drain(..found.len() - before);
            let Some(silent) = rest.first() else { return found };
            tracing::warn!(
                pid = silent.pid,
                "the environment of this process does not come: its memory is locked"
            );
            self.note(silent, Reader { read: count, at: found.len() - before });
            rest.remove(0);
        }
        found
    }

    /// Without those that somebody is still waiting for; what is not there any more is forgotten.
    fn without_silent(&self, entries: Vec<ProcessEntry>) -> Vec<ProcessEntry> {
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
    fn one_that_does_not_come_is_waited_for_once_until_it_does() {
        let entry =
            |pid| ProcessEntry { pid, parent: 1, group: pid, start_ticks: 0, is_zombie: false };
        let entries: Vec<_> = (1..=4).map(entry).collect();
        let silent = Silent(Mutex::new(None));
        let (release, held) = mpsc::channel::<()>();
        let held = Arc::new(Mutex::new(held));
        let reads = Arc::new(AtomicUsize::new(0));
        let counting = reads.clone();
        let read = move |entry: &ProcessEntry| {
            if entry.pid == 2 {
                counting.fetch_add(1, Ordering::SeqCst);
                // Until it is released, which is when nobody can say more.
                let _ = held.lock().expect("sound").recv();
            }
            entry.pid * 10
        };
        let look = || {
            silent
                .look(entries.clone(), read.clone())
                .into_iter()
                .map(|(_, ten)| ten)
                .collect::<Vec<_>>()
        };
        assert_eq!(look(), [10, 30, 40]);
        assert_eq!(look(), [10, 30, 40]);
        assert_eq!(reads.load(Ordering::SeqCst), 1, "nobody waits for it again");
        drop(release);
        let waiting = silent.0.lock().expect("sound").as_ref().expect("noted")[&(2, 0)].clone();
        while waiting.read.load(Ordering::Acquire) == waiting.at {
            std::thread::yield_now();
        }
        assert_eq!(look(), [10, 20, 30, 40]);
    }
}
