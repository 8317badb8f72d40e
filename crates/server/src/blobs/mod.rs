//! Owns the bytes of packages on disk, under the digest they hash to; it never changes a blob that
//! is whole.
//!
//! A blob lies in `blobs/<algorithm>/<hex>`. We rename it into place when it is complete, verified
//! and synced. The blob store knows no references: [`collector`] decides which blobs may be
//! deleted. A blob's modification time records the last request by a pusher; it never says anything
//! about the content.

mod blob;
mod body;
pub mod collector;
mod upload;

use std::collections::{HashSet, VecDeque};
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;
use task_proto::size::format_bytes;
use task_proto::time::millis;
use tokio::sync::{OwnedRwLockReadGuard, OwnedRwLockWriteGuard, RwLock, Semaphore};

pub use blob::{Blob, BytesConsumer};
pub use body::BlobBody;
use upload::Uploads;
pub use upload::{InvalidUploadId, UploadId};

use crate::config::BlobRead;

/// Limit of concurrent disk reads for answers. More would not be faster, and would keep the
/// processor from tasks that wait for something else.
const DISK_READS: usize = 2;

/// The blob store's limits and choices.
#[derive(Debug, Clone, Copy)]
pub struct BlobSettings {
    /// The way in which blobs are read.
    pub reading: BlobRead,
    /// The largest blob that is accepted.
    pub max_blob_bytes: u64,
    /// The most uploads that may be unfinished at once.
    pub max_uploads: usize,
    /// The most blobs kept open for the next reader.
    pub max_open_blobs: usize,
    /// The most bytes kept of one robot's uploads. While older blobs are being deleted, the robot
    /// may have twice as many on the disk.
    pub max_robot_bytes: u64,
    /// Free disk space that people's uploads leave for the database and everything else, in bytes.
    /// Robots' uploads leave twice as much.
    pub reserve_bytes: u64,
}

impl Default for BlobSettings {
    fn default() -> Self {
        Self {
            reading: BlobRead::Mmap,
            max_blob_bytes: 16 << 30,
            max_uploads: 256,
            max_open_blobs: 64,
            max_robot_bytes: 40 << 30,
            reserve_bytes: 0,
        }
    }
}

/// An error of the blob store.
#[derive(Debug, thiserror::Error)]
pub enum BlobError {
    /// There is no such unfinished upload.
    #[error("no such upload: it was finished, cancelled or dropped")]
    UploadUnknown,
    /// Another request writes to the same upload.
    #[error("another request is writing to this upload")]
    UploadBusy,
    /// [`BlobSettings::max_uploads`] is reached and no upload can be evicted; or a robot has
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
}

impl BlobError {
    /// Whether the error means that there is no room for the bytes.
    fn is_out_of_space(&self) -> bool {
        matches!(
            self,
            Self::DiskFull
                | Self::DiskReserved { .. }
                | Self::RobotQuotaExceeded { .. }
                | Self::TooLarge { .. }
        )
    }

    fn disk(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::DiskFull,
            _ => Self::Disk { action, path, source },
        }
    }
}

/// The blob store. Clones share one store.
#[derive(Clone)]
pub struct Blobs {
    shared: Arc<Shared>,
}

struct Shared {
    directory: PathBuf,
    settings: BlobSettings,
    uploads: Uploads,
    /// Recently opened blobs, the latest first: opening and mapping a small blob costs more than
    /// its bytes.
    open: Mutex<VecDeque<Blob>>,
    /// Blobs with a running check of their file after a failed read.
    checked: Mutex<HashSet<Digest>>,
    disk: Arc<Semaphore>,
    collection: Arc<RwLock<()>>,
}

/// While this guard lives, no blob is collected: a caller that found a blob present can rely on it.
pub struct CollectionHold {
    _guard: OwnedRwLockReadGuard<()>,
}

/// While this guard lives, there is no [`CollectionHold`], so blobs can be deleted.
pub struct CollectionGuard {
    _guard: OwnedRwLockWriteGuard<()>,
}

impl Blobs {
    /// Opens the store in `data`, and creates the directories `blobs` and `uploads` there.
    pub fn open(data: &Path, settings: BlobSettings) -> Result<Self, BlobError> {
        let directory = data.join("blobs");
        for algorithm in Algorithm::ALL {
            let directory = directory.join(algorithm.as_str());
            fs::create_dir_all(&directory).map_err(BlobError::disk("create", &directory))?;
        }
        let uploads = Uploads::open(data.join("uploads"), settings)?;
        let open = Mutex::new(VecDeque::with_capacity(settings.max_open_blobs));
        let disk = Arc::new(Semaphore::new(DISK_READS));
        let shared = Shared {
            directory,
            settings,
            uploads,
            open,
            checked: Mutex::default(),
            disk,
            collection: Arc::default(),
        };
        Ok(Self { shared: Arc::new(shared) })
    }

    /// The limits and choices this store was opened with.
    pub fn settings(&self) -> BlobSettings {
        self.shared.settings
    }

    /// Blocks the collector while the guard lives.
    pub async fn hold_collection(&self) -> CollectionHold {
        CollectionHold { _guard: Arc::clone(&self.shared.collection).read_owned().await }
    }

    /// Waits until no caller blocks the collector, and then makes new callers of
    /// [`Self::hold_collection`] wait.
    pub async fn begin_collection(&self) -> CollectionGuard {
        CollectionGuard { _guard: Arc::clone(&self.shared.collection).write_owned().await }
    }

    /// The blob; `None` if the store does not have it.
    pub async fn get(&self, digest: Digest) -> Result<Option<Blob>, BlobError> {
        if let Some(blob) = self.shared.find_open(digest) {
            return Ok(Some(blob));
        }
        let shared = self.shared.clone();
        let opened = on_disk(move || match Blob::open(digest, &shared) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            opened => opened.map(Some).map_err(BlobError::disk("open", &shared.path(digest))),
        });
        Ok(opened.await?.map(|blob| self.shared.keep_open(blob)))
    }

    /// Stores small bytes from memory, and returns their digest.
    pub async fn put(&self, algorithm: Algorithm, bytes: Bytes) -> Result<Digest, BlobError> {
        let digest = algorithm.digest(&bytes);
        let partial = self.shared.uploads.unused_path();
        let target = self.path(digest);
        on_disk(move || {
            let write = || {
                let mut file = File::create_new(&partial)?;
                file.write_all(&bytes)?;
                file.sync_all()
            };
            let stored = write()
                .map_err(BlobError::disk("write", &partial))
                .and_then(|()| move_into_place(&partial, &target));
            if stored.is_err() {
                // Best effort: the next start removes a file that remains.
                let _ = fs::remove_file(&partial);
            }
            stored
        })
        .await?;
        Ok(digest)
    }

    /// Updates the blob's modification time, because a pusher relies on the blob; false if it is
    /// absent.
    pub async fn touch(&self, digest: Digest, now_ms: u64) -> Result<bool, BlobError> {
        let path = self.path(digest);
        on_disk(move || {
            let modified = SystemTime::UNIX_EPOCH + Duration::from_millis(now_ms);
            match File::open(&path).and_then(|file| file.set_modified(modified)) {
                Ok(()) => Ok(true),
                Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
                Err(error) => Err(BlobError::disk("touch", &path)(error)),
            }
        })
        .await
    }

    /// The blobs last touched before `before_ms`.
    pub async fn untouched_since(&self, before_ms: u64) -> Result<Vec<Digest>, BlobError> {
        let directory = self.shared.directory.clone();
        on_disk(move || {
            let mut found = Vec::new();
            let mut list = |algorithm: Algorithm| {
                for entry in fs::read_dir(directory.join(algorithm.as_str()))? {
                    let entry = entry?;
                    let name = entry.file_name();
                    let named =
                        name.to_str().map(|hex| format!("{}:{hex}", algorithm.as_str()).parse());
                    let Some(Ok(digest)) = named else { continue };
                    if modified_ms(&entry.metadata()?)? < before_ms {
                        found.push(digest);
                    }
                }
                Ok(())
            };
            Algorithm::ALL
                .into_iter()
                .try_for_each(&mut list)
                .map_err(BlobError::disk("list", &directory))?;
            Ok(found)
        })
        .await
    }

    /// The total size of all blobs, in bytes.
    pub async fn used_bytes(&self) -> Result<u64, BlobError> {
        let directory = self.shared.directory.clone();
        on_disk(move || {
            let sum = |algorithm: Algorithm| {
                // A blob that is deleted meanwhile takes no room.
                let entries = fs::read_dir(directory.join(algorithm.as_str()))?.flatten();
                Ok(entries
                    .filter_map(|entry| entry.metadata().ok())
                    .map(|metadata| metadata.len())
                    .sum::<u64>())
            };
            Algorithm::ALL
                .into_iter()
                .map(sum)
                .sum::<io::Result<u64>>()
                .map_err(BlobError::disk("list", &directory))
        })
        .await
    }

    /// Whether the blob is present and was last touched before `before_ms`.
    pub async fn is_untouched_since(
        &self,
        digest: Digest,
        before_ms: u64,
    ) -> Result<bool, BlobError> {
        let path = self.path(digest);
        on_disk(move || match fs::metadata(&path).and_then(|metadata| modified_ms(&metadata)) {
            Ok(modified) => Ok(modified < before_ms),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(BlobError::disk("inspect", &path)(error)),
        })
        .await
    }

    /// Deletes a blob. Only the collector may do so, because it knows that nothing refers to the
    /// blob.
    pub async fn delete(
        &self,
        digest: Digest,
        _collection: &CollectionGuard,
    ) -> Result<(), BlobError> {
        self.shared.close(digest);
        let path = self.path(digest);
        on_disk(move || match fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                Err(BlobError::disk("delete", &path)(error))
            }
            _ => Ok(()),
        })
        .await?;
        // A reader may have opened the blob in between. That reader keeps its copy; later ones must
        // not find it.
        self.shared.close(digest);
        Ok(())
    }

    fn path(&self, digest: Digest) -> PathBuf {
        self.shared.path(digest)
    }
}

impl Shared {
    fn path(&self, digest: Digest) -> PathBuf {
        self.directory.join(digest.algorithm().as_str()).join(digest.hex())
    }

    /// The blob, if it is open. This makes it the last one to be closed.
    fn find_open(&self, digest: Digest) -> Option<Blob> {
        let mut open = self.open_blobs();
        let at = open.iter().position(|blob| blob.digest == digest)?;
        let blob = open.remove(at)?;
        open.push_front(blob.clone());
        Some(blob)
    }

    /// Keeps `blob` open. If a concurrent reader has opened it first, that mapping is used, so that
    /// many first readers at once share one mapping.
    fn keep_open(&self, blob: Blob) -> Blob {
        let mut open = self.open_blobs();
        if let Some(earlier) = open.iter().find(|other| other.digest == blob.digest) {
            return earlier.clone();
        }
        open.push_front(blob.clone());
        open.truncate(self.settings.max_open_blobs);
        blob
    }

    fn close(&self, digest: Digest) {
        self.open_blobs().retain(|blob| blob.digest != digest);
    }

    fn open_blobs(&self) -> MutexGuard<'_, VecDeque<Blob>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Runs disk work on a blocking thread.
async fn on_disk<T, F>(work: F) -> Result<T, BlobError>
where
    T: Send + 'static,
    F: FnOnce() -> Result<T, BlobError> + Send + 'static,
{
    match tokio::task::spawn_blocking(work).await {
        Ok(done) => done,
        Err(panic) => std::panic::resume_unwind(panic.into_panic()),
    }
}

/// Renames a synced file into the store, so that its new name survives a power cut.
fn move_into_place(partial: &Path, target: &Path) -> Result<(), BlobError> {
    fs::rename(partial, target).map_err(BlobError::disk("rename", partial))?;
    let directory = target.parent().unwrap_or(target);
    File::open(directory)
        .and_then(|file| file.sync_all())
        .map_err(BlobError::disk("sync", directory))
}

fn modified_ms(metadata: &fs::Metadata) -> io::Result<u64> {
    Ok(metadata.modified()?.duration_since(SystemTime::UNIX_EPOCH).map_or(0, millis))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mapping(blob: &Blob) -> *const u8 {
        blob.mapped.as_ref().expect("mapped").as_ptr()
    }

    #[tokio::test]
    async fn readers_share_one_mapping() {
        let data = tempfile::tempdir().expect("a directory");
        let blobs = Blobs::open(data.path(), BlobSettings::default()).expect("opened");
        let digest =
            blobs.put(Algorithm::Sha256, Bytes::from_static(b"content")).await.expect("stored");
        let readers: Vec<_> = (0..64)
            .map(|_| {
                tokio::spawn({
                    let blobs = blobs.clone();
                    async move { blobs.get(digest).await }
                })
            })
            .collect();
        let first = blobs.get(digest).await.expect("read").expect("there");
        for reader in readers {
            let blob = reader.await.expect("no panic").expect("read").expect("there");
            assert_eq!(mapping(&blob), mapping(&first));
        }
        for _ in 0..3 {
            let again = blobs.get(digest).await.expect("read").expect("there");
            assert_eq!(mapping(&again), mapping(&first));
        }
    }
}
