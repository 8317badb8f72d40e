//! Blobs that came with the order itself and need no pull. They stay in memory until used or
//! replaced; lost blobs are pulled.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use task_proto::Digest;
use task_proto::desired::BlobRef;

/// The blobs of the newest order that carried any.
#[derive(Default)]
pub(super) struct InlineBlobs(Mutex<HashMap<Digest, Bytes>>);

impl InlineBlobs {
    /// Replaces the stored blobs. The bytes must match their digests.
    pub(super) fn replace(&self, blobs: impl IntoIterator<Item = (BlobRef, Bytes)>) {
        *self.lock() = blobs.into_iter().map(|(blob, bytes)| (blob.digest, bytes)).collect();
    }

    /// The bytes of a blob, if an order carried them.
    pub(super) fn get(&self, blob: &BlobRef) -> Option<Bytes> {
        self.lock().get(&blob.digest).filter(|bytes| bytes.len() as u64 == blob.size).cloned()
    }

    /// Drops a blob after its use.
    pub(super) fn forget(&self, digest: &Digest) {
        self.lock().remove(digest);
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<Digest, Bytes>> {
        // Every change under the lock is complete in itself.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
