//! Owns the bytes of packages, under the digest they hash to; it never changes a blob that is
//! whole.
//!
//! A blob lies in `blobs/<algorithm>/<hex>`. We rename it into place when it is complete, verified
//! and synced. The blob store knows no references: [`collector`] decides which blobs may be
//! deleted. A blob's modification time records the last request by a pusher; it never says anything
//! about the content.
//!
//! If servers have a common store ([`CommonStore`]), a blob is an object there and a row of the
//! database, and files in `blob-cache` are local copies, which may go at any time.

mod blob;
mod body;
mod cache;
pub mod collector;
mod common_store;
mod content;
mod error;
mod fetch;
mod local_move;
mod objects;
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
use task_proto::time::millis;
use tokio::sync::{OwnedRwLockReadGuard, OwnedRwLockWriteGuard, RwLock, Semaphore};

pub use blob::{Blob, BytesConsumer};
pub use body::BlobBody;
use cache::{Cache, Room};
pub use common_store::{CommonStore, CommonStoreError};
pub use content::Content;
pub use error::BlobError;
use error::common_store_error;
pub use fetch::Arrival;
use fetch::Fetches;
pub use local_move::{MoveError, Moved, move_to_common_store};
use upload::Uploads;
pub use upload::{InvalidUploadId, UploadId, upload_mark};

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
    /// The most bytes of local copies, if the blobs lie in a common store.
    pub max_cache_bytes: u64,
    /// The first digits of uploads' ids, by which the servers of a cluster know where an upload
    /// began; `None`: the server is alone.
    pub upload_mark: Option<u32>,
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
            max_cache_bytes: 50 << 30,
            upload_mark: None,
        }
    }
}

/// The blob store. Clones share one store.
#[derive(Clone)]
pub struct Blobs {
    shared: Arc<Shared>,
}

struct Shared {
    /// The directory of blobs, or of local copies.
    directory: PathBuf,
    common: Option<Common>,
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

/// The parts that only a common store needs.
struct Common {
    store: CommonStore,
    cache: Cache,
    fetches: Fetches,
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
        let directory = local_directory(data);
        for algorithm in Algorithm::ALL {
            let directory = directory.join(algorithm.as_str());
            fs::create_dir_all(&directory).map_err(BlobError::disk("create", &directory))?;
        }
        Self::open_in(data, settings, directory, None)
    }

    /// Fails if blobs of a server without a common store are in `data`: with such a store they would
    /// be out of reach.
    pub fn check_moved(data: &Path) -> Result<(), BlobError> {
        let directory = local_directory(data);
        let left = blob_files(&directory).map_err(BlobError::disk("list", &directory))?;
        match left.len() {
            0 => Ok(()),
            count => Err(BlobError::NotMoved { count, directory }),
        }
    }

    /// Opens the store whose blobs lie in a common store, with local copies in `data`.
    pub fn open_with(
        data: &Path,
        settings: BlobSettings,
        store: CommonStore,
    ) -> Result<Self, BlobError> {
        let directory = cache_directory(data);
        let cache = Cache::open(directory.clone(), settings.max_cache_bytes)?;
        let common = Common { store, cache, fetches: Fetches::default() };
        Self::open_in(data, settings, directory, Some(common))
    }

    fn open_in(
        data: &Path,
        settings: BlobSettings,
        directory: PathBuf,
        common: Option<Common>,
    ) -> Result<Self, BlobError> {
        let uploads = Uploads::open(data.join("uploads"), settings)?;
        let open = Mutex::new(VecDeque::with_capacity(settings.max_open_blobs));
        let disk = Arc::new(Semaphore::new(DISK_READS));
        let shared = Shared {
            directory,
            common,
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

    /// The servers' common store, if the blobs lie there.
    pub fn common_store(&self) -> Option<&CommonStore> {
        self.shared.common.as_ref().map(|common| &common.store)
    }

    /// Stores small bytes from memory, as of a pusher's request, and returns their digest.
    pub async fn put(
        &self,
        algorithm: Algorithm,
        bytes: Bytes,
        now_ms: u64,
    ) -> Result<Digest, BlobError> {
        let (digest, size) = (algorithm.digest(&bytes), bytes.len() as u64);
        let partial = self.shared.uploads.unused_path();
        let file = partial.clone();
        let written = on_disk(move || {
            let write = || {
                let mut file = File::create_new(&file)?;
                file.write_all(&bytes)?;
                file.sync_all()
            };
            write().map_err(BlobError::disk("write", &file))
        });
        let stored = match written.await {
            Ok(()) => self.store_file(digest, &partial, size, now_ms).await,
            failed => failed,
        };
        if stored.is_err() {
            // Best effort: the next start removes a file that remains.
            let _ = fs::remove_file(&partial);
        }
        stored.map(|()| digest)
    }

    /// Makes a verified and synced file the blob, as of a pusher's request. The file is moved; it
    /// stays in its place if the common store fails.
    async fn store_file(
        &self,
        digest: Digest,
        file: &Path,
        bytes: u64,
        now_ms: u64,
    ) -> Result<(), BlobError> {
        let Some(common) = &self.shared.common else {
            let (file, target) = (file.to_owned(), self.path(digest));
            on_disk(move || move_into_place(&file, &target)).await?;
            return self.touch(digest, now_ms).await.map(drop);
        };
        common.store.put(digest, file, bytes, now_ms).await?;
        let room = self.shared.make_room(&common.cache, bytes).await;
        if let Err(error) = common.cache.adopt(room, file, digest) {
            // The blob is stored: only the local copy is missing.
            tracing::warn!(%error, %digest, "a pushed blob is not kept as a local copy");
            let _ = fs::remove_file(file);
        }
        Ok(())
    }

    /// Records that a pusher relies on the blob, by its modification time or its row; false if it
    /// is absent.
    pub async fn touch(&self, digest: Digest, now_ms: u64) -> Result<bool, BlobError> {
        if let Some(common) = &self.shared.common {
            return common.store.touch(digest, now_ms).await;
        }
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
        if let Some(common) = &self.shared.common {
            return common.store.untouched_since(before_ms).await;
        }
        let directory = self.shared.directory.clone();
        on_disk(move || {
            let list = || {
                let mut found = Vec::new();
                for (digest, entry) in blob_files(&directory)? {
                    if modified_ms(&entry.metadata()?)? < before_ms {
                        found.push(digest);
                    }
                }
                Ok(found)
            };
            list().map_err(BlobError::disk("list", &directory))
        })
        .await
    }

    /// The total size of all blobs, in bytes.
    pub async fn used_bytes(&self) -> Result<u64, BlobError> {
        if let Some(common) = &self.shared.common {
            return common.store.used_bytes().await;
        }
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

    /// Deletes those of `candidates` that nothing needs and no pusher asked for since `before_ms`
    /// from the common store, and returns their number.
    async fn remove_from_common_store(
        &self,
        common: &Common,
        candidates: &[Digest],
        before_ms: u64,
    ) -> Result<usize, BlobError> {
        let removed = common.store.remove_unneeded(candidates, before_ms).await?;
        for &digest in &removed {
            self.shared.close(digest);
            if let Err(error) = common.cache.forget(digest) {
                tracing::warn!(%error, %digest, "the copy of a deleted blob can't be removed");
            }
        }
        Ok(removed.len())
    }

    /// Searches the common store for objects without a blob, if the last search was a while ago.
    /// Returns the number of those that were deleted.
    async fn remove_orphans(&self, now_ms: u64, interval: Duration) -> Result<usize, BlobError> {
        let Some(common) = &self.shared.common else { return Ok(0) };
        let now = SystemTime::UNIX_EPOCH + Duration::from_millis(now_ms);
        let failed = BlobError::disk("inspect", &self.shared.directory);
        let swept_at = common.cache.swept_at().map_err(failed)?;
        let is_due = swept_at.is_none_or(|at| now.duration_since(at).is_ok_and(|t| t >= interval));
        if !is_due {
            return Ok(0);
        }
        let removed = common.store.remove_orphans(now_ms).await?;
        let failed = BlobError::disk("write", &self.shared.directory);
        common.cache.record_sweep(now).map_err(failed)?;
        Ok(removed)
    }

    fn path(&self, digest: Digest) -> PathBuf {
        self.shared.path(digest)
    }
}

impl Shared {
    /// Takes room in the cache for a copy. Copies that are not in use make room for it; if all are
    /// in use, the cache is larger for a while.
    async fn make_room<'c>(self: &Arc<Self>, cache: &'c Cache, bytes: u64) -> Room<'c> {
        let (room, is_full) = cache.take_room(bytes);
        if is_full {
            let shared = self.clone();
            let evicted = on_disk(move || {
                let Some(common) = &shared.common else { return Ok(()) };
                let evicted = common.cache.evict(|digest| shared.close_unused(digest));
                evicted.map_err(BlobError::disk("make room in", &shared.directory))
            });
            if let Err(error) = evicted.await {
                let error = &error as &dyn std::error::Error;
                tracing::warn!(error, "local copies of blobs can't be removed");
            }
        }
        room
    }

    /// Closes the blob if it has no reader. False if the blob is in use.
    fn close_unused(&self, digest: Digest) -> bool {
        let Some(common) = &self.common else { return false };
        let mut open = self.open_blobs();
        let kept = open.iter().filter(|blob| blob.digest == digest).count();
        if common.cache.users(digest) > kept {
            return false;
        }
        open.retain(|blob| blob.digest != digest);
        true
    }

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

/// Where blobs lie in a data directory without a common store.
fn local_directory(data: &Path) -> PathBuf {
    data.join("blobs")
}

/// Where local copies lie in a data directory with a common store.
fn cache_directory(data: &Path) -> PathBuf {
    data.join("blob-cache")
}

/// The files below `directory` that are named after a digest.
fn blob_files(directory: &Path) -> io::Result<Vec<(Digest, fs::DirEntry)>> {
    let mut found = Vec::new();
    for algorithm in Algorithm::ALL {
        let entries = match fs::read_dir(directory.join(algorithm.as_str())) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            entries => entries?,
        };
        for entry in entries {
            let entry = entry?;
            let name = entry.file_name();
            let digest = name.to_str().map(|hex| format!("{}:{hex}", algorithm.as_str()).parse());
            if let Some(Ok(digest)) = digest {
                found.push((digest, entry));
            }
        }
    }
    Ok(found)
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
            blobs.put(Algorithm::Sha256, Bytes::from_static(b"content"), 0).await.expect("stored");
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
