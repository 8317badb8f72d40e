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
pub(in crate::http) const READING: Duration = Duration::from_secs(10 * 60);
/// The most archives read at the same time: each keeps a processor busy.
const AT_ONCE: usize = 2;

/// The limited places for readers.
#[derive(Clone)]
pub struct ArchiveReaders(Arc<Semaphore>);

impl Default for ArchiveReaders {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(AT_ONCE)))
    }
}

impl ArchiveReaders {
    /// Reads the blob with `read`. If this future is dropped, the reader gets an error and ends.
    pub(in crate::http) async fn read<T: Send + 'static>(
        &self,
        blob: &Blob,
        read: impl FnOnce(&mut dyn Read) -> Result<T, UnpackError> + Send + 'static,
    ) -> Result<T, UnpackError> {
        let turn = self.0.clone().acquire_owned().await;
        let given_up = Arc::new(AtomicBool::new(false));
        let mut reader = GivenUp { inner: blob.reader(), given_up: given_up.clone() };
        let _guard = GiveUp(given_up);
        let reading = tokio::task::spawn_blocking(move || {
            let result = read(&mut reader);
            drop(turn);
            result
        });
        match reading.await {
            Ok(result) => result,
            Err(panic) => std::panic::resume_unwind(panic.into_panic()),
        }
    }
}

/// Tells the reader on drop that no request waits for it.
struct GiveUp(Arc<AtomicBool>);

impl Drop for GiveUp {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// A reader that fails once no request waits for it: a request has a deadline, a thread has none.
struct GivenUp<R> {
    inner: R,
    given_up: Arc<AtomicBool>,
}

impl<R: Read> Read for GivenUp<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.given_up.load(Ordering::Relaxed) {
            return Err(io::Error::new(io::ErrorKind::TimedOut, "nobody waits for it"));
        }
        self.inner.read(buffer)
    }
}
