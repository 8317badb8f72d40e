//! The state of the database as seen by its users: whether it answers, whether it is corrupt, and
//! the time of the last full check. Each change is logged once, here. A database that was found
//! corrupt stays so until the next start, which checks it.

use std::fmt::Display;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use sqlx::Error;
use tokio::sync::watch;

use super::fault::Fault;

/// The known state of one database. Clones share it.
#[derive(Debug, Clone)]
pub struct DatabaseState(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    corruption: OnceLock<String>,
    is_there: watch::Sender<bool>,
    /// Whether a caller was told that the database does not answer.
    was_missed: AtomicBool,
    /// Whether the last write found the disk full.
    is_full: AtomicBool,
    /// Whether the tables are those of this version.
    is_open: AtomicBool,
    /// Time of the last full check without a finding; 0 before the first.
    fully_checked_at_ms: AtomicU64,
    /// The database's own protection of its pages.
    guard: OnceLock<&'static str>,
}

impl DatabaseState {
    /// The state of a database that has not answered yet.
    pub(in crate::store) fn unknown() -> Self {
        Self(Arc::new(Inner {
            corruption: OnceLock::new(),
            is_there: watch::Sender::new(false),
            was_missed: AtomicBool::new(false),
            is_full: AtomicBool::new(false),
            is_open: AtomicBool::new(false),
            fully_checked_at_ms: AtomicU64::new(0),
            guard: OnceLock::new(),
        }))
    }

    /// The first finding, if the database is corrupt.
    pub fn corruption(&self) -> Option<&str> {
        self.0.corruption.get().map(String::as_str)
    }

    /// Whether the database is open and has answered since it was last found away.
    pub fn is_there(&self) -> bool {
        *self.0.is_there.borrow()
    }

    /// Resolves when the database is open and answers. Cancel-safe.
    pub async fn there(&self) {
        // The sender lives as long as this value.
        let _ = self.0.is_there.subscribe().wait_for(|is_there| *is_there).await;
    }

    /// Resolves when the database does not answer any more. Cancel-safe.
    pub async fn away(&self) {
        let _ = self.0.is_there.subscribe().wait_for(|is_there| !is_there).await;
    }

    /// For people: the reason why orders are refused; `None` if no problem is known.
    pub fn problem(&self) -> Option<String> {
        match self.corruption() {
            Some(finding) => Some(format!("it is corrupt: {finding}")),
            None if !self.is_there() => Some("it does not answer".to_owned()),
            None => None,
        }
    }

    /// The time of the last full check without a finding.
    pub fn fully_checked_at_ms(&self) -> Option<u64> {
        Some(self.0.fully_checked_at_ms.load(Ordering::Relaxed)).filter(|at_ms| *at_ms > 0)
    }

    /// For people: the database's own protection of its pages, if this server can't check them.
    pub fn guard(&self) -> Option<&'static str> {
        self.0.guard.get().copied()
    }

    /// Whether the database was opened.
    pub fn is_open(&self) -> bool {
        self.0.is_open.load(Ordering::Acquire)
    }

    /// Marks the database as open for use.
    pub(in crate::store) fn opened(&self) {
        self.0.is_open.store(true, Ordering::Release);
    }

    pub(in crate::store) fn guarded(&self, guard: &'static str) {
        let _ = self.0.guard.set(guard);
    }

    pub(in crate::store) fn fully_checked(&self, now_ms: u64) {
        self.0.fully_checked_at_ms.store(now_ms, Ordering::Relaxed);
    }

    /// Records that the database has answered.
    pub(in crate::store) fn answers(&self) {
        let came = |is_there: &mut bool| !std::mem::replace(is_there, true);
        let has_come = !self.is_there() && self.0.is_there.send_if_modified(came);
        if has_come && self.0.was_missed.swap(false, Ordering::Relaxed) {
            tracing::info!("the database answers again");
        }
    }

    /// Records the fault that an error shows.
    pub(in crate::store) fn note(&self, error: &Error) {
        match Fault::of(error) {
            Some(Fault::Corrupt) => self.is_corrupt(error),
            Some(Fault::Away) => {
                self.0.was_missed.store(true, Ordering::Relaxed);
                let went = |is_there: &mut bool| std::mem::replace(is_there, false);
                if self.0.is_there.send_if_modified(went) {
                    tracing::warn!(%error, "the database does not answer; what needs it is refused until it does");
                }
            }
            Some(Fault::Full) if !self.0.is_full.swap(true, Ordering::Relaxed) => {
                tracing::warn!(%error, "the database's disk is full; what needs room is refused");
            }
            Some(Fault::Full | Fault::Busy) | None => {}
        }
    }

    /// Records a completed write.
    pub(in crate::store) fn committed(&self) {
        if self.0.is_full.load(Ordering::Relaxed) && self.0.is_full.swap(false, Ordering::Relaxed) {
            tracing::info!("the database's disk has room again");
        }
    }

    /// Records a finding of damage.
    pub(in crate::store) fn is_corrupt(&self, finding: impl Display) {
        let finding = finding.to_string();
        if self.0.corruption.set(finding.clone()).is_ok() {
            tracing::error!(
                finding,
                "the database is corrupt: orders and reports are refused; see docs/server.md"
            );
        }
    }
}
