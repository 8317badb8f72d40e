//! Moves the blobs of a data directory into the servers' common store. Each blob is written, read
//! back and compared before its row makes it stored, and only then its file becomes a local copy. So
//! the move may be interrupted anywhere and run again. No server may use the data directory or the
//! database meanwhile.

use std::fs;
use std::path::Path;

use futures_util::TryStreamExt as _;
use sha2::{Sha256, Sha512};
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;

use super::cache::Cache;
use super::upload::hash;
use super::{
    BlobError, CommonStore, blob, blob_files, cache_directory, local_directory, modified_ms,
    on_disk,
};
use crate::store::StoredBlob;

/// A blob that cannot be moved stops the move; the others that were moved stay moved.
#[derive(Debug, thiserror::Error)]
pub enum MoveError {
    #[error(transparent)]
    Blobs(#[from] BlobError),
    /// The object read back differs from what was written.
    #[error("the store gave back other bytes than were written for {digest}; its file stays")]
    Different { digest: Digest },
}

/// The outcome of a move.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Moved {
    /// Blobs written to the store.
    pub blobs: usize,
    pub bytes: u64,
    /// Blobs that the store had already, from an interrupted move or another server.
    pub known: usize,
    /// Files that did not hold their blob. They were renamed.
    pub damaged: usize,
}

/// Moves all blobs of `data`, and reports after each blob what has happened so far and how many
/// blobs are left.
pub async fn move_to_common_store(
    data: &Path,
    max_cache_bytes: u64,
    store: &CommonStore,
    mut progress: impl FnMut(Moved, usize),
) -> Result<Moved, MoveError> {
    let directory = local_directory(data);
    let mut files = blob_files(&directory).map_err(BlobError::disk("list", &directory))?;
    files.sort_by_key(|(_, entry)| entry.file_name());
    let cache = Cache::open(cache_directory(data), max_cache_bytes)?;
    let (mut moved, count) = (Moved::default(), files.len());
    for (at, (digest, entry)) in files.into_iter().enumerate() {
        let path = entry.path();
        let metadata = entry.metadata().map_err(BlobError::disk("inspect", &path))?;
        let touched_ms = modified_ms(&metadata).map_err(BlobError::disk("inspect", &path))?;
        match move_one(store, digest, &path, metadata.len(), touched_ms).await? {
            Outcome::Written => {
                moved.blobs += 1;
                moved.bytes += metadata.len();
            }
            Outcome::Known => moved.known += 1,
            Outcome::Damaged => moved.damaged += 1,
        }
        if path.exists() {
            let (room, is_full) = cache.take_room(metadata.len());
            let kept = match is_full {
                true => fs::remove_file(&path),
                false => cache.adopt(room, &path, digest),
            };
            kept.map_err(BlobError::disk("rename", &path))?;
        }
        progress(moved, count - at - 1);
    }
    Ok(moved)
}

enum Outcome {
    Written,
    Known,
    Damaged,
}

async fn move_one(
    store: &CommonStore,
    digest: Digest,
    path: &Path,
    bytes: u64,
    touched_ms: u64,
) -> Result<Outcome, MoveError> {
    let file = path.to_owned();
    let hashed = on_disk(move || {
        let actual = match digest.algorithm() {
            Algorithm::Sha256 => hash::<Sha256>(&file).map(|hash| Digest::from_sha256(hash.into())),
            Algorithm::Sha512 => hash::<Sha512>(&file).map(|hash| Digest::from_sha512(hash.into())),
        };
        actual.map_err(BlobError::disk("read", &file))
    });
    if hashed.await? != digest {
        let aside = path.with_extension(blob::DAMAGED);
        fs::rename(path, aside).map_err(BlobError::disk("rename", path))?;
        return Ok(Outcome::Damaged);
    }
    if store.find(digest).await?.is_some() {
        return Ok(Outcome::Known);
    }
    let written = store.write_object(digest, path, bytes).await?;
    if read_back(store, &written).await? != digest {
        return Err(MoveError::Different { digest });
    }
    store.record(written, touched_ms).await?;
    Ok(Outcome::Written)
}

/// The digest of the object's content.
async fn read_back(store: &CommonStore, written: &StoredBlob) -> Result<Digest, BlobError> {
    let mut object = store.read_object(written).await?;
    let mut hasher = super::fetch::Hasher::new(written.digest.algorithm());
    while let Some(chunk) = object.content.try_next().await? {
        hasher.update(&chunk);
    }
    Ok(hasher.finish())
}
