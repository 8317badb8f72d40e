//! The directory of local copies of blobs that lie in the common store. Its size is bounded: the
//! copy that was opened longest ago goes first. A copy in use never goes. This module knows no
//! digest's content.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::SystemTime;

use nix::sys::stat::futimens;
use nix::sys::time::TimeSpec;
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;

use super::BlobError;

/// Below the root of the cache: files that are not complete.
const PARTIAL: &str = "partial";
/// The file whose time is that of the last look for orphans.
const SWEPT: &str = "swept";

pub(super) struct Cache {
    root: PathBuf,
    max_bytes: u64,
    /// The size of all copies, and of those under way.
    used: AtomicU64,
    /// Files that were opened and may be in use.
    opened: Mutex<HashMap<Digest, Weak<File>>>,
}

/// Room in the cache for a copy under way; it is given back unless the copy stays.
pub(super) struct Room<'c> {
    cache: &'c Cache,
    bytes: u64,
}

impl Drop for Room<'_> {
    fn drop(&mut self) {
        self.cache.used.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

impl Cache {
    /// Opens the directory. Removes the incomplete copies of an earlier process.
    pub(super) fn open(root: PathBuf, max_bytes: u64) -> Result<Self, BlobError> {
        let partial = root.join(PARTIAL);
        let open = || {
            fs::create_dir_all(&partial)?;
            for entry in fs::read_dir(&partial)? {
                fs::remove_file(entry?.path())?;
            }
            for algorithm in Algorithm::ALL {
                fs::create_dir_all(root.join(algorithm.as_str()))?;
            }
            copies(&root)
        };
        let found = open().map_err(BlobError::disk("open", &root))?;
        let used = found.iter().map(|copy| copy.bytes).sum();
        Ok(Self { root, max_bytes, used: AtomicU64::new(used), opened: Mutex::default() })
    }

    pub(super) fn path(&self, digest: Digest) -> PathBuf {
        self.root.join(digest.algorithm().as_str()).join(digest.hex())
    }

    /// The path of a new incomplete copy.
    pub(super) fn partial_path(&self) -> PathBuf {
        self.root.join(PARTIAL).join(format!("{:032x}", rand::random::<u128>()))
    }

    /// Records that a copy was opened.
    pub(super) fn record_use(&self, digest: Digest, file: &Arc<File>) {
        // Best effort: a wrong time only makes another copy go first.
        let _ = futimens(file, &TimeSpec::UTIME_NOW, &TimeSpec::UTIME_NOW);
        let mut opened = self.opened();
        let known = opened.entry(digest).or_default();
        if known.strong_count() == 0 {
            *known = Arc::downgrade(file);
        }
    }

    /// The number of users of the copy's file.
    pub(super) fn users(&self, digest: Digest) -> usize {
        self.opened().get(&digest).map_or(0, Weak::strong_count)
    }

    /// Takes room for a copy. The caller then makes that room by [`Self::evict`], if asked to.
    pub(super) fn take_room(&self, bytes: u64) -> (Room<'_>, bool) {
        let used = self.used.fetch_add(bytes, Ordering::Relaxed) + bytes;
        (Room { cache: self, bytes }, used > self.max_bytes)
    }

    /// Removes the copies that were opened longest ago, until a tenth of the cache is free.
    /// `may_remove` tells whether a copy is not in use, and closes it.
    pub(super) fn evict(&self, may_remove: impl Fn(Digest) -> bool) -> io::Result<()> {
        let target = self.max_bytes - self.max_bytes / 10;
        let mut found = copies(&self.root)?;
        found.sort_by_key(|copy| copy.opened_at);
        for copy in found {
            if self.used.load(Ordering::Relaxed) <= target {
                break;
            }
            if may_remove(copy.digest) {
                self.remove(&copy.path)?;
            }
        }
        self.opened().retain(|_, file| file.strong_count() > 0);
        Ok(())
    }

    /// Moves a complete and synced file into the cache, if the cache is large enough for it. In any
    /// case the file's own name is gone then.
    pub(super) fn adopt(&self, room: Room<'_>, file: &Path, digest: Digest) -> io::Result<()> {
        let target = self.path(digest);
        if room.bytes > self.max_bytes || target.exists() {
            return fs::remove_file(file);
        }
        fs::rename(file, target)?;
        // The copy keeps its room.
        std::mem::forget(room);
        Ok(())
    }

    /// Removes a copy, if there is one.
    pub(super) fn forget(&self, digest: Digest) -> io::Result<()> {
        self.remove(&self.path(digest))
    }

    /// Removes a copy that was renamed, because its file is damaged. The common store has the blob.
    pub(super) fn forget_damaged(&self, digest: Digest) {
        let path = self.path(digest).with_extension(super::blob::DAMAGED);
        if let Err(error) = self.remove(&path) {
            tracing::warn!(%error, %digest, "a damaged copy can't be removed");
        }
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let bytes = match fs::metadata(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            metadata => metadata?.len(),
        };
        match fs::remove_file(path) {
            // Another thread was first.
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
            removed => {
                removed?;
                self.used.fetch_sub(bytes, Ordering::Relaxed);
                Ok(())
            }
        }
    }

    /// When the common store was last searched for orphans.
    pub(super) fn swept_at(&self) -> io::Result<Option<SystemTime>> {
        match fs::metadata(self.root.join(SWEPT)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            metadata => metadata?.modified().map(Some),
        }
    }

    pub(super) fn record_sweep(&self, at: SystemTime) -> io::Result<()> {
        File::create(self.root.join(SWEPT))?.set_modified(at)
    }

    fn opened(&self) -> MutexGuard<'_, HashMap<Digest, Weak<File>>> {
        self.opened.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

struct Copy {
    digest: Digest,
    path: PathBuf,
    bytes: u64,
    opened_at: SystemTime,
}

fn copies(root: &Path) -> io::Result<Vec<Copy>> {
    let mut found = Vec::new();
    for (digest, entry) in super::blob_files(root)? {
        // A copy that goes meanwhile takes no room.
        let Ok(metadata) = entry.metadata() else { continue };
        let (bytes, opened_at) = (metadata.len(), metadata.modified()?);
        found.push(Copy { digest, path: entry.path(), bytes, opened_at });
    }
    Ok(found)
}
