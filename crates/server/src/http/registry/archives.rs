//! Reads whole archives from the blob store for HTTP requests: a few at a time, on threads of their
//! own, and only while the request is waiting.

use std::io::{self, Read};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use task_archive::UnpackError;
use tokio::sync::Semaphore;

use crate::blobs::Blob;

/// Time limit for reading one or two whole archives.
pub(in crate::http) const READ_TIMEOUT: Duration = Duration::from_secs(10 * 60);
/// The most archives read at the same time: each keeps a processor busy.
const MAX_CONCURRENT: usize = 2;

/// The limited slots for readers.
#[derive(Clone)]
pub struct ArchiveReaders(Arc<Semaphore>);

impl Default for ArchiveReaders {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(MAX_CONCURRENT)))
    }
}

impl ArchiveReaders {
    /// Reads the blob with `read`. If this future is dropped, the reader gets an error and ends.
    pub(in crate::http) async fn read<T: Send + 'static>(
        &self,
        blob: &Blob,
        read: impl FnOnce(&mut dyn Read) -> Result<T, UnpackError> + Send + 'static,
    ) -> Result<T, UnpackError> {
        let permit = self.0.clone().acquire_owned().await;
        let is_cancelled = Arc::new(AtomicBool::new(false));
        let mut reader =
            CancellableReader { inner: blob.reader(), is_cancelled: is_cancelled.clone() };
        let _guard = CancelOnDrop(is_cancelled);
        let reading = tokio::task::spawn_blocking(move || {
            let result = read(&mut reader);
            drop(permit);
            result
        });
        match reading.await {
            Ok(result) => result,
            Err(panic) => std::panic::resume_unwind(panic.into_panic()),
        }
    }
}

/// Tells the reader on drop that no request waits for it.
struct CancelOnDrop(Arc<AtomicBool>);

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// A reader that fails once no request waits for it: a request has a deadline, a thread has none.
struct CancellableReader<R> {
    inner: R,
    is_cancelled: Arc<AtomicBool>,
}

impl<R: Read> Read for CancellableReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.is_cancelled.load(Ordering::Relaxed) {
            return Err(io::Error::new(io::ErrorKind::TimedOut, "the request has ended"));
        }
        self.inner.read(buffer)
    }
}
