//! A readable blob, and the check of its file after a failed read. A mapped page that cannot be
//! read raises SIGBUS in the process that touches it. Mapped bytes therefore only go to sockets,
//! where the kernel reads them and a failure ends one write.

use std::fs::{self, File};
use std::io::{self, IoSliceMut};
use std::ops::Range;
use std::os::unix::fs::{FileExt as _, MetadataExt as _};
use std::path::Path;
use std::sync::{Arc, PoisonError, Weak};

use bytes::Bytes;
use rustix::io::{Errno, ReadWriteFlags, preadv2};
use sha2::{Sha256, Sha512};
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;
use tokio::sync::Semaphore;

use super::body::BlobBody;
use super::upload::hash;
use super::{BlobError, Shared, on_disk};
use crate::config::BlobRead;

/// Bytes per read when a range is loaded into the page cache.
const READ_AHEAD_BYTES: usize = 64 * 1024;
/// The suffix of a file that no longer holds its blob.
pub(super) const DAMAGED: &str = "damaged";

/// A readable blob. It stays readable while this value lives, even if the blob is deleted.
#[derive(Clone)]
pub struct Blob {
    pub(super) digest: Digest,
    pub(super) size: u64,
    quoted_digest: Bytes,
    file: Arc<File>,
    /// The whole file, if blobs are mapped. Only the kernel may read these bytes.
    pub(super) mapped: Option<Bytes>,
    /// Permits for disk reads.
    disk: Arc<Semaphore>,
    store: Weak<Shared>,
}

/// The reader of an answer's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BytesConsumer {
    /// The kernel, which copies them to a socket. They may be mapped.
    Socket,
    /// This process, which encrypts them. They are copied from the file.
    Process,
}

impl Blob {
    pub(super) fn open(digest: Digest, store: &Arc<Shared>) -> io::Result<Self> {
        Self::of(digest, Arc::new(File::open(store.path(digest))?), store)
    }

    /// The blob in a file that is complete and never changes any more.
    pub(super) fn of(digest: Digest, file: Arc<File>, store: &Arc<Shared>) -> io::Result<Self> {
        if let Some(common) = &store.common {
            common.cache.record_use(digest, &file);
        }
        let size = file.metadata()?.len();
        let mapped = match store.settings.reading {
            // An empty file can't be mapped.
            BlobRead::Mmap if size > 0 => {
                // SAFETY: nothing writes to a file after it was renamed into the store, and
                // deleting it leaves the mapping intact. Should the disk or a person take bytes
                // away, this process never touches them: the mapping is given to sockets alone,
                // where the kernel gets an error in place of a signal.
                let mapping = unsafe { memmap2::Mmap::map(&*file) }?;
                Some(Bytes::from_owner(mapping))
            }
            BlobRead::Mmap | BlobRead::Pread => None,
        };
        let quoted_digest = format!("\"{digest}\"").into();
        let (disk, store) = (store.disk.clone(), Arc::downgrade(store));
        Ok(Self { digest, size, quoted_digest, file, mapped, disk, store })
    }

    /// A blob whose file is still growing to `size`. Only bytes that are there may be read. A
    /// failure starts no check of the file.
    pub(super) fn growing(
        digest: Digest,
        size: u64,
        file: Arc<File>,
        disk: Arc<Semaphore>,
    ) -> Self {
        let quoted_digest = format!("\"{digest}\"").into();
        Self { digest, size, quoted_digest, file, mapped: None, disk, store: Weak::new() }
    }

    pub(super) fn file(&self) -> Arc<File> {
        self.file.clone()
    }

    pub fn digest(&self) -> Digest {
        self.digest
    }

    /// The digest's text in double quotes, as HTTP writes a tag. All answers share it.
    pub fn quoted_digest(&self) -> &Bytes {
        &self.quoted_digest
    }

    /// The blob's size in bytes.
    pub fn size(&self) -> u64 {
        self.size
    }

    /// The bytes of `range`, which lies inside the blob, as the body of an answer.
    pub fn body(&self, range: Range<u64>, reader: BytesConsumer) -> BlobBody {
        BlobBody::new(self.clone(), range, reader)
    }

    /// A reader of the whole blob, for a thread that may wait for the disk.
    pub fn reader(&self) -> impl io::Read + Send + use<> {
        BlobReader { blob: self.clone(), offset: 0 }
    }

    /// The whole blob in memory. For small blobs: the caller has checked [`Blob::size`].
    pub async fn read(&self) -> Result<Bytes, BlobError> {
        self.slice(0..self.size).await
    }

    /// A copy of the bytes of `range`, which lies inside the blob.
    pub async fn slice(&self, range: Range<u64>) -> Result<Bytes, BlobError> {
        debug_assert!(range.end <= self.size);
        let name = self.digest.hex();
        let unreadable = BlobError::disk("read", Path::new(&name));
        let Ok(length) = usize::try_from(range.end - range.start) else {
            return Err(unreadable(io::ErrorKind::OutOfMemory.into()));
        };
        if let Some(bytes) = self.read_cached(range.start, length) {
            return Ok(bytes);
        }
        let read = self.clone().with_disk_permit(move |blob| blob.read_at(range.start, length));
        read.await.map_err(unreadable)
    }

    /// Copies `length` bytes at `offset`. Returns `None` if the read would wait for the disk or
    /// fail. The next step then reads on a blocking thread and meets the error again.
    pub(super) fn read_cached(&self, offset: u64, length: usize) -> Option<Bytes> {
        let mut bytes = vec![0; length];
        let mut read = 0;
        while read < length {
            let mut slices = [IoSliceMut::new(&mut bytes[read..])];
            match preadv2(&*self.file, &mut slices, offset + read as u64, ReadWriteFlags::NOWAIT) {
                Ok(0) => return None,
                Ok(count) => read += count,
                Err(Errno::INTR) => {}
                Err(_) => return None,
            }
        }
        Some(bytes.into())
    }

    /// Copies `length` bytes at `offset`; may wait for the disk.
    pub(super) fn read_at(&self, offset: u64, length: usize) -> io::Result<Bytes> {
        let mut bytes = vec![0; length];
        self.file.read_exact_at(&mut bytes, offset)?;
        Ok(bytes.into())
    }

    /// Makes the kernel read these bytes into the page cache. This does not use the mapping: all
    /// threads share its lock, and would wait for the disk with this one.
    pub(super) fn read_ahead(&self, offset: u64, length: usize) -> io::Result<()> {
        let mut buffer = vec![0; READ_AHEAD_BYTES.min(length)];
        let end = offset + length as u64;
        for start in (offset..end).step_by(READ_AHEAD_BYTES) {
            let length =
                usize::try_from(end - start).unwrap_or(READ_AHEAD_BYTES).min(READ_AHEAD_BYTES);
            self.file.read_exact_at(&mut buffer[..length], start)?;
        }
        Ok(())
    }

    /// Reads from the disk on a blocking thread, limited to a few readers at a time. After a
    /// failure the blob's file is checked.
    pub(super) async fn with_disk_permit<T, F>(self, read: F) -> io::Result<T>
    where
        T: Send + 'static,
        F: FnOnce(&Self) -> io::Result<T> + Send + 'static,
    {
        let permit = self.disk.clone().acquire_owned().await.map_err(io::Error::other)?;
        let reading = tokio::task::spawn_blocking(move || {
            let read = read(&self);
            drop(permit);
            if let Err(error) = &read {
                self.check_after_failure(error);
            }
            read
        });
        reading.await.map_err(io::Error::other)?
    }

    /// Starts a check of the blob's file, unless one is running.
    fn check_after_failure(&self, error: &io::Error) {
        let Some(store) = self.store.upgrade() else { return };
        let digest = self.digest;
        store.close(digest);
        if !store.checked.lock().unwrap_or_else(PoisonError::into_inner).insert(digest) {
            return;
        }
        tracing::error!(%digest, %error, "a blob could not be read; checking its file");
        tokio::spawn(async move {
            let file = store.path(digest);
            let checked = on_disk(move || quarantine_if_damaged(digest, &file)).await;
            if let (Ok(true), Some(common)) = (&checked, &store.common) {
                common.cache.forget_damaged(digest);
            }
            store.close(digest);
            store.checked.lock().unwrap_or_else(PoisonError::into_inner).remove(&digest);
            match checked {
                Ok(true) => tracing::error!(
                    %digest,
                    "a blob's file is damaged and was renamed to end in .{DAMAGED}: push the package again"
                ),
                Ok(false) => tracing::info!(%digest, "a blob's file is intact"),
                Err(error) => {
                    tracing::error!(%digest, error = &error as &dyn std::error::Error, "a blob's file could not be checked");
                }
            }
        });
    }
}

/// Renames a file that does not hold its blob, so that the blob counts as absent and can be pushed
/// again. Returns true after a rename, and false if the file is sound or gone.
fn quarantine_if_damaged(digest: Digest, path: &Path) -> Result<bool, BlobError> {
    let failed = |action| BlobError::disk(action, path);
    let before = match fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
        metadata => metadata.map_err(failed("inspect"))?.ino(),
    };
    let actual = match digest.algorithm() {
        Algorithm::Sha256 => hash::<Sha256>(path).map(|hash| Digest::from_sha256(hash.into())),
        Algorithm::Sha512 => hash::<Sha512>(path).map(|hash| Digest::from_sha512(hash.into())),
    };
    // A read error is that of a disk sector: the file will not get better.
    let is_sound = actual.is_ok_and(|actual| actual == digest);
    // A push may have put a good file in its place meanwhile.
    if is_sound || fs::metadata(path).map_err(failed("inspect"))?.ino() != before {
        return Ok(false);
    }
    fs::rename(path, path.with_extension(DAMAGED)).map_err(failed("rename"))?;
    Ok(true)
}

/// A blob's file with a separate offset: many readers share the file.
struct BlobReader {
    blob: Blob,
    offset: u64,
}

impl io::Read for BlobReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = self.blob.size.saturating_sub(self.offset);
        let count = match self.blob.file.read_at(buffer, self.offset) {
            Ok(0) if left > 0 && !buffer.is_empty() => Err(io::ErrorKind::UnexpectedEof.into()),
            read => read,
        };
        let count = count.inspect_err(|error| self.blob.check_after_failure(error))?;
        self.offset += count as u64;
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blobs::{BlobSettings, Blobs};

    #[tokio::test]
    async fn copied_bytes_stay_readable_after_the_file_was_truncated() {
        let data = tempfile::tempdir().expect("a directory");
        let blobs = Blobs::open(data.path(), BlobSettings::default()).expect("opened");
        let content = Bytes::from(vec![7; 1 << 20]);
        let digest = blobs.put(Algorithm::Sha256, content.clone(), 0).await.expect("stored");
        let blob = blobs.get(digest).await.expect("read").expect("there");
        let (slice, whole) = (blob.slice(0..content.len() as u64).await, blob.read().await);
        File::create(blobs.path(digest)).expect("truncated");
        assert_eq!((slice.expect("read"), whole.expect("read")), (content.clone(), content));
        // The mapping has no pages any more: touching them would end this process.
        let error = blob.slice(0..10).await.expect_err("unreadable");
        assert!(matches!(&error, BlobError::Disk { action: "read", .. }), "{error}");
    }

    #[test]
    fn intact_file_stays_and_a_changed_one_is_quarantined() {
        let data = tempfile::tempdir().expect("a directory");
        for algorithm in Algorithm::ALL {
            let digest = algorithm.digest(b"content");
            let path = data.path().join(digest.hex());
            assert!(!quarantine_if_damaged(digest, &path).expect("checked"), "there is no file");
            fs::write(&path, b"content").expect("written");
            assert!(!quarantine_if_damaged(digest, &path).expect("checked"));
            fs::write(&path, b"cOntent").expect("written");
            assert!(quarantine_if_damaged(digest, &path).expect("checked"));
            let aside = data.path().join(format!("{}.damaged", digest.hex()));
            assert_eq!(
                (path.exists(), fs::read(aside).expect("kept")),
                (false, b"cOntent".to_vec())
            );
        }
    }
}
