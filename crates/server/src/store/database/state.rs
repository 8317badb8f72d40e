//! The state of the database as seen by its users: which server it is on, whether it answers, whether
//! it is corrupt, and the time of the last full check. Each change is logged once, here. A database that was found
//! corrupt stays so until the next start, which checks it.

use std::fmt::Display;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use sqlx::Error;
use tokio::sync::watch;

use super::fault::Fault;
use crate::domain::database_url::without_password;

/// The known state of one database. Clones share it.
#[derive(Debug, Clone)]
pub struct DatabaseState(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    corruption: OnceLock<String>,
    /// The server that has taken over, once known.
    successor: watch::Sender<Option<String>>,
    is_available: watch::Sender<bool>,
    /// The last reason why it was not available.
    unavailability: Mutex<String>,
    /// Number of connections that failed because the database was away.
    losses: AtomicU64,
    /// The server of the newest connection, without its password.
    server: Mutex<String>,
    /// Whether a caller was told that the database does not answer.
    was_reported_unavailable: AtomicBool,
    /// Whether the last write found the disk full.
    is_full: AtomicBool,
    /// Whether the tables are those of this version.
    is_open: AtomicBool,
    /// Time of the last full check without a finding; 0 before the first.
    fully_checked_at_ms: AtomicU64,
    /// The database's own protection of its pages.
    page_protection: OnceLock<&'static str>,
}

impl DatabaseState {
    /// The state of a database that has not answered yet.
    pub(in crate::store) fn unknown() -> Self {
        Self(Arc::new(Inner {
            corruption: OnceLock::new(),
            successor: watch::Sender::new(None),
            is_available: watch::Sender::new(false),
            unavailability: Mutex::default(),
            losses: AtomicU64::new(0),
            server: Mutex::default(),
            was_reported_unavailable: AtomicBool::new(false),
            is_full: AtomicBool::new(false),
            is_open: AtomicBool::new(false),
            fully_checked_at_ms: AtomicU64::new(0),
            page_protection: OnceLock::new(),
        }))
    }

    /// The first finding, if the database is corrupt.
    pub fn corruption(&self) -> Option<&str> {
        self.0.corruption.get().map(String::as_str)
    }

    /// Whether the database is open and has answered since it was last found away.
    pub fn is_available(&self) -> bool {
        *self.0.is_available.borrow()
    }

    /// Resolves when the database is open and answers. Cancel-safe.
    pub async fn available(&self) {
        // The sender lives as long as this value.
        let _ = self.0.is_available.subscribe().wait_for(|is_available| *is_available).await;
    }

    /// Resolves when the database does not answer any more. Cancel-safe.
    pub async fn unavailable(&self) {
        let _ = self.0.is_available.subscribe().wait_for(|is_available| !is_available).await;
    }

    /// Resolves to the other server when it has taken over the database. Cancel-safe.
    pub async fn taken_over(&self) -> String {
        match self.0.successor.subscribe().wait_for(Option::is_some).await.as_deref() {
            Ok(Some(successor)) => successor.clone(),
            // The sender lives as long as this value.
            _ => std::future::pending().await,
        }
    }

    /// For people: the reason why orders are refused; `None` if no problem is known.
    pub fn problem(&self) -> Option<String> {
        match self.corruption() {
            Some(finding) => Some(format!("it is corrupt: {finding}")),
            None if !self.is_available() => {
                let reason = lock(&self.0.unavailability);
                let separator = if reason.is_empty() { "" } else { ": " };
                Some(format!("it does not answer{separator}{reason}"))
            }
            None => None,
        }
    }

    /// The number of connections that were lost so far. Those opened before the last loss may lead
    /// to a server that is the primary no more.
    pub(in crate::store) fn losses(&self) -> u64 {
        self.0.losses.load(Ordering::Acquire)
    }

    /// Records that a connection was lost.
    pub(in crate::store) fn record_loss(&self) {
        self.0.losses.fetch_add(1, Ordering::AcqRel);
    }

    /// Records the URL of a new connection.
    pub(in crate::store) fn record_server(&self, url: &str) {
        let mut server = lock(&self.0.server);
        let is_first = server.is_empty();
        if *server != without_password(url) {
            *server = without_password(url);
            if !is_first {
                tracing::info!(%server, "another database server takes the writes now");
            }
        }
    }

    /// The time of the last full check without a finding.
    pub fn fully_checked_at_ms(&self) -> Option<u64> {
        Some(self.0.fully_checked_at_ms.load(Ordering::Relaxed)).filter(|at_ms| *at_ms > 0)
    }

    /// For people: the database's own protection of its pages, if this server can't check them.
    pub fn page_protection(&self) -> Option<&'static str> {
        self.0.page_protection.get().copied()
    }

    /// Whether the database was opened.
    pub fn is_open(&self) -> bool {
        self.0.is_open.load(Ordering::Acquire)
    }

    /// Marks the database as open for use.
    pub(in crate::store) fn mark_open(&self) {
        self.0.is_open.store(true, Ordering::Release);
    }

    pub(in crate::store) fn set_page_protection(&self, page_protection: &'static str) {
        let _ = self.0.page_protection.set(page_protection);
    }

    pub(in crate::store) fn record_full_check(&self, now_ms: u64) {
        self.0.fully_checked_at_ms.store(now_ms, Ordering::Relaxed);
    }

    /// Records that the database has answered.
    pub(in crate::store) fn mark_available(&self) {
        let set_available = |is_available: &mut bool| !std::mem::replace(is_available, true);
        let became_available =
            !self.is_available() && self.0.is_available.send_if_modified(set_available);
        if became_available && self.0.was_reported_unavailable.swap(false, Ordering::Relaxed) {
            tracing::info!("the database answers again");
        }
    }

    /// Records the fault that an error shows.
    pub(in crate::store) fn record_error(&self, error: &Error) {
        match Fault::of(error) {
            Some(Fault::Corrupt) => self.record_corruption(error),
            Some(Fault::Unreachable) => {
                self.record_loss();
                *lock(&self.0.unavailability) = Fault::description(error);
                self.0.was_reported_unavailable.store(true, Ordering::Relaxed);
                let set_unavailable =
                    |is_available: &mut bool| std::mem::replace(is_available, false);
                if self.0.is_available.send_if_modified(set_unavailable) {
                    tracing::warn!(%error, "the database does not answer; requests that need it are refused until it does");
                }
            }
            Some(Fault::Full) if !self.0.is_full.swap(true, Ordering::Relaxed) => {
                tracing::warn!(%error, "the database's disk is full; writes are refused");
            }
            Some(Fault::Full | Fault::Busy) | None => {}
        }
    }

    /// Records that another server has taken over, so that this one has to end.
    pub(in crate::store) fn record_takeover(&self, successor: &impl Display) {
        let set = |known: &mut Option<String>| match known {
            Some(_) => false,
            None => {
                *known = Some(successor.to_string());
                true
            }
        };
        self.0.successor.send_if_modified(set);
    }

    /// Records a completed write.
    pub(in crate::store) fn record_commit(&self) {
        if self.0.is_full.load(Ordering::Relaxed) && self.0.is_full.swap(false, Ordering::Relaxed) {
            tracing::info!("the database's disk has room again");
        }
    }

    /// Records a finding of damage.
    pub(in crate::store) fn record_corruption(&self, finding: impl Display) {
        let finding = finding.to_string();
        if self.0.corruption.set(finding.clone()).is_ok() {
            tracing::error!(
                finding,
                "the database is corrupt: orders and reports are refused; see docs/server.md"
            );
        }
    }
}

fn lock(text: &Mutex<String>) -> MutexGuard<'_, String> {
    // Every change under these locks is one assignment.
    text.lock().unwrap_or_else(PoisonError::into_inner)
}
