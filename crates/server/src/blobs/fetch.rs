//! Fetches of blobs from the common store into the cache: one for each blob, however many wait for
//! it. Readers follow the file as it grows. The last bytes stay back until the whole hashes to the
//! blob's digest, so no reader gets a wrong blob whole.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use futures_util::{Stream, TryStreamExt as _};
use sha2::{Digest as _, Sha256, Sha512};
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;
use tokio::sync::{Semaphore, watch};

use super::{Blob, BlobError, Shared, on_disk};
use crate::store::StoredBlob;

/// Fetches at once; more wait.
const CONCURRENT_FETCHES: usize = 16;
/// Bytes gathered before one hash and one write.
const BATCH_BYTES: usize = 1 << 20;
/// The last bytes of a blob, which are only given out when the whole is verified.
const HELD_BACK_BYTES: u64 = 1 << 20;
const SLICE_BYTES: u64 = 128 * 1024;

/// The fetches under way.
pub(super) struct Fetches {
    running: Mutex<HashMap<Digest, Arrival>>,
    permits: Semaphore,
}

/// A blob that is being fetched. Clones follow the same fetch.
#[derive(Clone)]
pub struct Arrival {
    blob: Blob,
    progress: watch::Receiver<Progress>,
}

#[derive(Debug, Clone)]
enum Progress {
    /// The store has not answered.
    Waiting,
    /// The number of bytes in the file.
    Arrived(u64),
    /// All bytes are there and right.
    Whole,
    /// The store does not hold the blob.
    Absent,
    Failed(Arc<BlobError>),
}

/// The outcome of [`Fetches::begin`].
pub(super) enum Begun {
    Running(Arrival),
    /// A fetch has just ended: the copy is in the cache.
    Cached,
}

/// Ends a fetch for those who come later, also if its task ends early.
struct Registration {
    shared: Arc<Shared>,
    digest: Digest,
}

impl Drop for Registration {
    fn drop(&mut self) {
        if let Some(common) = &self.shared.common {
            common.fetches.running().remove(&self.digest);
        }
    }
}

impl Default for Fetches {
    fn default() -> Self {
        Self { running: Mutex::default(), permits: Semaphore::new(CONCURRENT_FETCHES) }
    }
}

impl Fetches {
    /// The fetch of this blob, if one is under way.
    pub(super) fn find(&self, digest: Digest) -> Option<Arrival> {
        self.running().get(&digest).cloned()
    }

    /// Begins to fetch a blob, or joins the fetch that is under way. The fetch goes on if the
    /// callers leave.
    pub(super) fn begin(shared: &Arc<Shared>, row: StoredBlob) -> Result<Begun, BlobError> {
        let Some(common) = &shared.common else { return Ok(Begun::Cached) };
        let mut running = common.fetches.running();
        if let Some(arrival) = running.get(&row.digest) {
            return Ok(Begun::Running(arrival.clone()));
        }
        if shared.path(row.digest).exists() {
            return Ok(Begun::Cached);
        }
        let path = common.cache.partial_path();
        let file = File::options().read(true).write(true).create_new(true).open(&path);
        let file = Arc::new(file.map_err(BlobError::disk("create", &path))?);
        let (sender, progress) = watch::channel(Progress::Waiting);
        let blob = Blob::growing(row.digest, row.bytes, file.clone(), shared.disk.clone());
        let arrival = Arrival { blob, progress };
        running.insert(row.digest, arrival.clone());
        drop(running);
        common.cache.record_use(row.digest, &file);
        let registered = Registration { shared: shared.clone(), digest: row.digest };
        tokio::spawn(async move { run(&registered.shared, &row, &file, &path, &sender).await });
        Ok(Begun::Running(arrival))
    }

    fn running(&self) -> MutexGuard<'_, HashMap<Digest, Arrival>> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Fetches one blob to its end, and puts the file into the cache.
async fn run(
    shared: &Arc<Shared>,
    row: &StoredBlob,
    file: &Arc<File>,
    path: &Path,
    progress: &watch::Sender<Progress>,
) {
    let Some(common) = &shared.common else { return };
    let room = shared.make_room(&common.cache, row.bytes).await;
    let fetched = match common.fetches.permits.acquire().await {
        Ok(_permit) => fetch(shared, row, file, progress).await,
        Err(_) => Ok(false),
    };
    match fetched {
        Ok(true) => {
            // Readers need not wait for the disk.
            progress.send_replace(Progress::Whole);
            let kept = sync(file, path).await.and_then(|()| {
                let adopted = common.cache.adopt(room, path, row.digest);
                adopted.map_err(BlobError::disk("rename", path))
            });
            if let Err(error) = kept {
                let error = &error as &dyn std::error::Error;
                tracing::warn!(error, digest = %row.digest, "a fetched blob is not kept");
                let _ = fs::remove_file(path);
            }
        }
        Ok(false) => {
            let _ = fs::remove_file(path);
            progress.send_replace(Progress::Absent);
        }
        Err(error) => {
            let _ = fs::remove_file(path);
            progress.send_replace(Progress::Failed(Arc::new(error)));
        }
    }
}

/// Copies the object into the file. False if the store does not hold the blob.
async fn fetch(
    shared: &Arc<Shared>,
    row: &StoredBlob,
    file: &Arc<File>,
    progress: &watch::Sender<Progress>,
) -> Result<bool, BlobError> {
    let Some(common) = &shared.common else { return Ok(false) };
    let Some(mut object) = common.store.read(row).await? else { return Ok(false) };
    progress.send_replace(Progress::Arrived(0));
    let mut hasher = Hasher::new(row.digest.algorithm());
    let mut offset = 0;
    loop {
        let (mut batch, mut length) = (Vec::new(), 0);
        while length < BATCH_BYTES
            && let Some(chunk) = object.content.try_next().await?
        {
            length += chunk.len();
            batch.push(chunk);
        }
        if length == 0 {
            break;
        }
        // The store announced fewer bytes, and room was taken for these.
        if offset + length as u64 > row.bytes {
            common.store.remove_damaged(row).await?;
            return Ok(false);
        }
        let file = file.clone();
        hasher = on_disk(move || {
            let mut at = offset;
            for chunk in &batch {
                file.write_all_at(chunk, at)
                    .map_err(BlobError::disk("write", Path::new("blob-cache")))?;
                at += chunk.len() as u64;
                hasher.update(chunk);
            }
            Ok(hasher)
        })
        .await?;
        offset += length as u64;
        progress.send_replace(Progress::Arrived(offset));
    }
    if offset < row.bytes {
        let early = io::Error::from(io::ErrorKind::UnexpectedEof);
        return Err(super::common_store_error("read an object to its end")(early));
    }
    if hasher.finish() == row.digest {
        return Ok(true);
    }
    common.store.remove_damaged(row).await?;
    Ok(false)
}

async fn sync(file: &Arc<File>, path: &Path) -> Result<(), BlobError> {
    let (file, path) = (file.clone(), path.to_owned());
    on_disk(move || file.sync_all().map_err(BlobError::disk("sync", &path))).await
}

impl Arrival {
    pub fn digest(&self) -> Digest {
        self.blob.digest()
    }

    pub fn size(&self) -> u64 {
        self.blob.size()
    }

    pub fn quoted_digest(&self) -> &Bytes {
        self.blob.quoted_digest()
    }

    /// Waits for the store's answer. False if the store does not hold the blob.
    pub(super) async fn has_begun(&mut self) -> Result<bool, BlobError> {
        self.wait(|progress| !matches!(progress, Progress::Waiting)).await
    }

    /// Waits for the whole blob, and returns its file; `None` if the store does not hold the blob.
    pub(super) async fn whole(mut self) -> Result<Option<Arc<File>>, BlobError> {
        let is_over =
            |progress: &Progress| !matches!(progress, Progress::Waiting | Progress::Arrived(_));
        Ok(self.wait(is_over).await?.then(|| self.blob.file()))
    }

    async fn wait(&mut self, until: impl Fn(&Progress) -> bool) -> Result<bool, BlobError> {
        let progress = match self.progress.wait_for(until).await {
            Ok(progress) => progress.clone(),
            Err(closed) => return Err(super::common_store_error("be read to its end")(closed)),
        };
        match progress {
            Progress::Failed(error) => Err(BlobError::Fetch(error)),
            Progress::Absent => Ok(false),
            Progress::Waiting | Progress::Arrived(_) | Progress::Whole => Ok(true),
        }
    }

    /// The bytes of `range`, which lies inside the blob, as they arrive. The stream fails if the
    /// blob turns out to be wrong.
    pub fn content(self, range: Range<u64>) -> impl Stream<Item = io::Result<Bytes>> + Send {
        futures_util::stream::try_unfold((self, range), |(mut arrival, range)| async move {
            if range.is_empty() {
                return Ok(None);
            }
            let readable = arrival.readable_beyond(range.start).await?;
            let end = readable.min(range.end).min(range.start + SLICE_BYTES);
            let bytes = arrival.blob.slice(range.start..end).await.map_err(io::Error::other)?;
            Ok(Some((bytes, (arrival, end..range.end))))
        })
    }

    /// Waits until bytes beyond `start` can be given out, and returns the end of these.
    async fn readable_beyond(&mut self, start: u64) -> io::Result<u64> {
        let size = self.size();
        let readable = move |progress: &Progress| match progress {
            Progress::Arrived(bytes) => (*bytes).min(size.saturating_sub(HELD_BACK_BYTES)),
            Progress::Whole => size,
            Progress::Waiting | Progress::Absent | Progress::Failed(_) => 0,
        };
        let is_over =
            |progress: &Progress| !matches!(progress, Progress::Waiting | Progress::Arrived(_));
        let until = |progress: &Progress| readable(progress) > start || is_over(progress);
        let is_right = self.wait(until).await.map_err(io::Error::other)?;
        let end = readable(&self.progress.borrow());
        if is_right && end > start {
            Ok(end)
        } else {
            Err(io::Error::other("the store's copy of the blob is damaged"))
        }
    }
}

/// The running hash of either algorithm.
pub(super) enum Hasher {
    Sha256(Sha256),
    Sha512(Sha512),
}

impl Hasher {
    pub(super) fn new(algorithm: Algorithm) -> Self {
        match algorithm {
            Algorithm::Sha256 => Self::Sha256(Sha256::new()),
            Algorithm::Sha512 => Self::Sha512(Sha512::new()),
        }
    }

    pub(super) fn update(&mut self, bytes: &[u8]) {
        match self {
            Self::Sha256(hasher) => hasher.update(bytes),
            Self::Sha512(hasher) => hasher.update(bytes),
        }
    }

    pub(super) fn finish(self) -> Digest {
        match self {
            Self::Sha256(hasher) => Digest::from_sha256(hasher.finalize().into()),
            Self::Sha512(hasher) => Digest::from_sha512(hasher.finalize().into()),
        }
    }
}
