//! Why a pull ends without the package in its place, and what follows from it.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use task_archive::Refusal;
use task_proto::report::FailureCode;
use task_proto::{Digest, RepositoryName};

use crate::system::disk::{self, DiskFull, Need};

/// How long a server is left alone whose bytes stay others than the ordered ones.
const OTHER_BYTES_PAUSE: Duration = Duration::from_secs(60);

/// Why a pull did not end with the package in its place.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// The caller took it back.
    #[error("the pull was cancelled")]
    Cancelled,
    /// No connection, or it broke.
    #[error("the server can't be reached, or the connection broke")]
    Unreachable(#[source] reqwest::Error),
    /// The answer ended before the blob's last byte.
    #[error("the answer ended after {received} of {size} bytes")]
    Interrupted {
        /// Bytes there are now.
        received: u64,
        /// The blob's size.
        size: u64,
    },
    /// Too little came for too long.
    #[error("the server sent next to nothing for {} s", .0.as_secs())]
    Stalled(Duration),
    /// Something answered that is not a taskd server or a registry: a captive portal, a proxy.
    #[error("something else answers in the server's place: {0}")]
    NotTheServer(String),
    /// The server is overloaded, restarting or broken.
    #[error("the server answers {status}")]
    Busy {
        /// The HTTP status.
        status: u16,
        /// When it wants to be asked again.
        retry_after: Option<Duration>,
    },
    /// The token is not accepted.
    #[error("the server does not accept this robot's token")]
    Unauthorized,
    /// The server will not give this blob to this robot.
    #[error("the server answers {status} for blob {digest} of {repository}")]
    Unavailable {
        /// The HTTP status.
        status: u16,
        /// What was asked for.
        digest: Digest,
        /// Where: that of its package.
        repository: RepositoryName,
    },
    /// More bytes are announced than such a blob may have.
    #[error("blob {digest} is said to have {size} bytes, {most} are possible")]
    TooLarge {
        /// What was asked for.
        digest: Digest,
        /// What is announced.
        size: u64,
        /// What is possible.
        most: u64,
    },
    /// The bytes are not the ordered ones, also when they were fetched again.
    #[error("the server's bytes for {digest} are others: {reason}")]
    DigestMismatch {
        /// The ordered digest.
        digest: Digest,
        /// What was found.
        reason: String,
    },
    /// The bytes are the ordered ones, but no task manifest for this package.
    #[error("the package's task manifest can't be used: {0}")]
    ManifestInvalid(String),
    /// The bytes are the ordered ones, but hold what a package must not.
    #[error(transparent)]
    ArchiveRefused(#[from] Refusal),
    /// There is not enough room.
    #[error(transparent)]
    DiskFull(#[from] DiskFull),
    /// The disk fails in another way.
    #[error("cannot use {}", path.display())]
    Disk {
        /// What was being read or written.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

impl FetchError {
    /// The code that a report gives; `None` for a pull that was cancelled, which is no failure.
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

    /// Whether the same pull may succeed later without anyone's doing.
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

    /// Whether what was gathered is to go: it is of no use, or takes up the room that is missing.
    pub(super) fn spoils_gathered(&self) -> bool {
        matches!(self, Self::DiskFull(_) | Self::DigestMismatch { .. })
            || !self.is_retryable() && !matches!(self, Self::Cancelled)
    }

    /// How long the server wants this robot to stay away, if all that is wrong is that it has no
    /// room for it now.
    pub fn told_to_wait(&self) -> Option<Duration> {
        match self {
            Self::Busy { status: 429 | 503, retry_after } => *retry_after,
            _ => None,
        }
    }

    /// How long to wait at least before it is tried again.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Busy { retry_after, .. } => *retry_after,
            Self::DigestMismatch { .. } => Some(OTHER_BYTES_PAUSE),
            Self::DiskFull(_) => Some(disk::FULL_PAUSE),
            _ => None,
        }
    }

    /// Whether it is the connection that failed, and not an answer.
    pub(super) fn is_cut(&self) -> bool {
        matches!(self, Self::Unreachable(_) | Self::Interrupted { .. } | Self::Stalled(_))
    }

    pub(super) fn other_bytes(digest: Digest, found: Digest) -> Self {
        Self::DigestMismatch { digest, reason: format!("they hash to {found}") }
    }

    /// A mismatch that is left after all that heals one on the way says so: what the server has is
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

    /// A write that failed because the disk is full is told with the figures of the file system
    /// that holds `path`.
    pub(crate) fn for_want_of_room(self, path: &Path, need: Need) -> Self {
        match self {
            Self::Disk { source, .. }
                if matches!(
                    source.kind(),
                    io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded
                ) =>
            {
                match disk::room(path) {
                    Ok(room) => DiskFull { free: room.free, total: room.total, need }.into(),
                    Err(source) => Self::disk(path, source),
                }
            }
            other => other,
        }
    }
}
