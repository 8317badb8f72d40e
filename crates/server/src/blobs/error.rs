//! Errors of the blob store, in sentences that a pusher may read.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use task_proto::Digest;
use task_proto::size::format_bytes;

use crate::store::StoreError;

/// An error of the blob store.
#[derive(Debug, thiserror::Error)]
pub enum BlobError {
    /// There is no such unfinished upload.
    #[error("no such upload: it was finished, cancelled or dropped")]
    UploadUnknown,
    /// Another request writes to the same upload.
    #[error("another request is writing to this upload")]
    UploadBusy,
    /// [`super::BlobSettings::max_uploads`] is reached and no upload can be evicted; or a robot has
    /// reached its share.
    #[error("too many unfinished uploads, the limit is {max}; finish or cancel one")]
    TooManyUploads { max: usize },
    /// A chunk does not begin at the upload's offset.
    #[error("the chunk begins at byte {given}, but the upload is at byte {offset}")]
    OutOfOrder {
        /// Where the chunk begins.
        given: u64,
        offset: u64,
    },
    /// The blob exceeds the size limit.
    #[error("the blob is larger than this server's limit of {max} bytes")]
    TooLarge { max: u64 },
    /// The robot exceeds its share of the disk.
    #[error(
        "this robot's outputs take {stored_bytes} bytes of disk space, the limit is {max}: older outputs are deleted within hours (robots.output_bytes)"
    )]
    RobotQuotaExceeded {
        max: u64,
        /// Bytes stored for the robot, including unfinished uploads.
        stored_bytes: u64,
    },
    /// The bytes do not hash to the announced digest.
    #[error("the content's digest is {actual}, not {expected}")]
    WrongDigest {
        expected: Box<Digest>,
        /// The digest of the received bytes.
        actual: Box<Digest>,
    },
    /// The body broke off: the sender went away or fell silent.
    #[error("the request body ended early")]
    Interrupted(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The disk is full.
    #[error("the server's disk is full")]
    DiskFull,
    /// The upload would use the reserved part of the disk.
    #[error(
        "the server's disk is nearly full: the last {} are reserved for the database and robots' reports \
         (disk_reserve)", format_bytes(*reserve)
    )]
    DiskReserved {
        /// The reserved disk space, in bytes.
        reserve: u64,
    },
    /// A file operation failed.
    #[error("the blob store can't {action} {path}")]
    Disk { action: &'static str, path: PathBuf, source: io::Error },
    /// The common store did not do its part.
    #[error("the servers' store of packages (blobs.store) can't {action} now: try again later")]
    CommonStore { action: &'static str, source: Box<dyn std::error::Error + Send + Sync> },
    /// The common store answers, but is not the one with our objects.
    #[error(
        "the servers' store of packages (blobs.store) does not hold this fleet's packages: is its directory mounted?"
    )]
    OtherStore,
    /// A fetch that others may wait for as well has failed.
    #[error(transparent)]
    Fetch(Arc<BlobError>),
    /// The rows about the common store can't be read or written.
    #[error(transparent)]
    Database(#[from] StoreError),
    /// Blobs in the data directory would be out of reach.
    #[error(
        "{count} blobs lie in {}, and blobs.store names another place: run taskd blobs move with the same settings \
         before the start", directory.display()
    )]
    NotMoved { count: usize, directory: PathBuf },
}

impl BlobError {
    /// Whether the error means that there is no room for the bytes.
    pub(super) fn is_out_of_space(&self) -> bool {
        matches!(
            self,
            Self::DiskFull
                | Self::DiskReserved { .. }
                | Self::RobotQuotaExceeded { .. }
                | Self::TooLarge { .. }
        )
    }

    /// Whether the common store has failed, which another try may mend.
    pub fn is_store_unavailable(&self) -> bool {
        match self {
            Self::CommonStore { .. } | Self::OtherStore => true,
            Self::Fetch(error) => error.is_store_unavailable(),
            _ => false,
        }
    }

    pub(super) fn disk(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::DiskFull,
            _ => Self::Disk { action, path, source },
        }
    }
}

/// The error that the common store can't do this, because of its cause.
pub(super) fn common_store_error<E>(action: &'static str) -> impl Fn(E) -> BlobError + Send
where
    E: Into<Box<dyn std::error::Error + Send + Sync>>,
{
    move |error| BlobError::CommonStore { action, source: error.into() }
}
