//! Errors of a pull, and the reaction to each.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use task_archive::Refusal;
use task_proto::messages::report::FailureCode;
use task_proto::{Digest, RepositoryName};

use crate::system::disk::{self, DiskFull, Need};

/// Pause before the next request to a server that repeatedly sends bytes with a wrong digest.
const MISMATCH_PAUSE: Duration = Duration::from_secs(60);

/// Reasons why a pull did not put the package in its place.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// The caller cancelled the pull.
    #[error("the pull was cancelled")]
    Cancelled,
    /// The connection failed or broke.
    #[error("the server can't be reached, or the connection broke")]
    Unreachable(#[source] reqwest::Error),
    /// The answer ended before the blob's last byte.
    #[error("the answer ended after {received} of {size} bytes")]
    Interrupted {
        /// Bytes present so far.
        received: u64,
        size: u64,
    },
    /// Too few bytes arrived within the stall timeout.
    #[error("the server sent almost nothing for {} s", .0.as_secs())]
    Stalled(Duration),
    /// The answer does not come from a taskd server or a registry, but from a captive portal or a
    /// proxy.
    #[error("not a taskd server: {0}")]
    NotTheServer(String),
    /// The server is overloaded, restarting or broken.
    #[error("the server answers {status}")]
    Busy {
        status: u16,
        /// Wait that the server requests.
        retry_after: Option<Duration>,
    },
    /// The token is not accepted.
    #[error("the server does not accept this robot's token")]
    Unauthorized,
    /// The server does not provide this blob to this robot.
    #[error("the server answers {status} for blob {digest} of {repository}")]
    Unavailable {
        status: u16,
        digest: Digest,
        /// Repository of the blob's package.
        repository: RepositoryName,
    },
    /// The announced size exceeds the limit for such a blob.
    #[error("blob {digest} is announced with {size} bytes, the limit is {most}")]
    TooLarge { digest: Digest, size: u64, most: u64 },
    /// The bytes do not match the ordered digest, even when fetched again.
    #[error("the server's bytes do not match {digest}: {reason}")]
    DigestMismatch { digest: Digest, reason: String },
    /// The bytes match the digest, but are not a task manifest for this package.
    #[error("the package's task manifest can't be used: {0}")]
    ManifestInvalid(String),
    /// The bytes match the digest, but hold entries that a package must not contain.
    #[error(transparent)]
    ArchiveRefused(#[from] Refusal),
    /// The disk has too little free space.
    #[error(transparent)]
    DiskFull(#[from] DiskFull),
    /// The disk failed in another way.
    #[error("cannot use {}", path.display())]
    Disk {
        /// The path being read or written.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
}

impl FetchError {
    /// The failure code in a report. `None` for a cancelled pull, which is not a failure.
    pub fn code(&self) -> Option<FailureCode> {
        match self {
            Self::Cancelled => None,
            Self::Unreachable(_)
            | Self::Interrupted { .. }
            | Self::Stalled(_)
            | Self::NotTheServer(_)
            | Self::Busy { .. } => Some(FailureCode::SERVER_UNREACHABLE),
            Self::Unauthorized => Some(FailureCode::UNAUTHORIZED),
            Self::Unavailable { .. } => Some(FailureCode::PACKAGE_UNAVAILABLE),
            Self::DigestMismatch { .. } | Self::TooLarge { .. } => {
                Some(FailureCode::DIGEST_MISMATCH)
            }
            Self::ManifestInvalid(_) => Some(FailureCode::MANIFEST_INVALID),
            Self::ArchiveRefused(_) => Some(FailureCode::ARCHIVE_REFUSED),
            Self::DiskFull(_) => Some(FailureCode::DISK_FULL),
            Self::Disk { .. } => Some(FailureCode::IO_ERROR),
        }
    }

    /// Whether the same pull may succeed later without intervention.
    pub fn is_retryable(&self) -> bool {
        self.is_cut()
            || matches!(
                self,
                Self::NotTheServer(_)
                    | Self::Busy { .. }
                    | Self::Unauthorized
                    | Self::DigestMismatch { .. }
                    | Self::DiskFull(_)
            )
    }

    /// Whether to delete the collected bytes: they are useless, or they take up the space that is
    /// missing.
    pub(super) fn discards_content(&self) -> bool {
        matches!(self, Self::DiskFull(_) | Self::DigestMismatch { .. })
            || !self.is_retryable() && !matches!(self, Self::Cancelled)
    }

    /// Wait that the server requests, if its only problem is a lack of capacity for this robot now.
    pub fn retry_later(&self) -> Option<Duration> {
        match self {
            Self::Busy { status: 429 | 503, retry_after } => *retry_after,
            _ => None,
        }
    }

    /// Shortest wait before the next attempt.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Busy { retry_after, .. } => *retry_after,
            Self::DigestMismatch { .. } => Some(MISMATCH_PAUSE),
            Self::DiskFull(_) => Some(disk::FULL_PAUSE),
            _ => None,
        }
    }

    /// Whether the connection failed, as opposed to an answer with an error.
    pub(super) fn is_cut(&self) -> bool {
        matches!(self, Self::Unreachable(_) | Self::Interrupted { .. } | Self::Stalled(_))
    }

    pub(super) fn digest_mismatch(digest: Digest, found: Digest) -> Self {
        Self::DigestMismatch { digest, reason: format!("they hash to {found}") }
    }

    /// Marks a digest mismatch that survived all repairs of transfer faults: the server's copy is
    /// damaged.
    pub(super) fn confirmed(self) -> Self {
        match self {
            Self::DigestMismatch { digest, reason } => {
                let reason =
                    format!("{reason}, also when fetched again; the server's copy is damaged");
                Self::DigestMismatch { digest, reason }
            }
            other => other,
        }
    }

    pub(crate) fn disk(path: &Path, source: io::Error) -> Self {
        Self::Disk { path: path.to_owned(), source }
    }

    /// Turns a write error on a full disk into one with the figures of the file system that holds
    /// `path`.
    pub(crate) fn or_disk_full(self, path: &Path, need: Need) -> Self {
        match self {
            Self::Disk { source, .. }
                if matches!(
                    source.kind(),
                    io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded
                ) =>
            {
                match disk::space(path) {
                    Ok(room) => DiskFull { free: room.free, total: room.total, need }.into(),
                    Err(source) => Self::disk(path, source),
                }
            }
            other => other,
        }
    }
}
