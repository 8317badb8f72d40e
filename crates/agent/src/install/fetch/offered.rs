//! Blobs that came with the order itself, so that they need not be pulled. They are kept in memory
//! until they are used or others come: what is lost is pulled.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use task_proto::Digest;
use task_proto::desired::BlobRef;

/// The blobs that came with the newest order that had any.
#[derive(Default)]
pub(super) struct Offered(Mutex<HashMap<Digest, Bytes>>);

impl Offered {
    /// Takes these in the place of those before. Their bytes must be what their digests say.
    pub(super) fn replace(&self, blobs: impl IntoIterator<Item = (BlobRef, Bytes)>) {
        *self.lock() = blobs.into_iter().map(|(blob, bytes)| (blob.digest, bytes)).collect();
    }

    /// The bytes of a blob, if it came.
    pub(super) fn get(&self, blob: &BlobRef) -> Option<Bytes> {
        self.lock().get(&blob.digest).filter(|bytes| bytes.len() as u64 == blob.size).cloned()
    }

    /// It has done its work.
    pub(super) fn forget(&self, digest: &Digest) {
        self.lock().remove(digest);
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<Digest, Bytes>> {
        // Every change under the lock is complete in itself.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
