//! Reading blobs: from a file of this machine, or while they arrive from the common store. This
//! module never changes a blob.

use std::io;

use bytes::Bytes;
use task_proto::Digest;

use super::fetch::{Arrival, Begun, Fetches};
use super::{Blob, BlobError, Blobs, on_disk};

/// A blob that can be answered with.
pub enum Content {
    /// The blob is on this machine.
    Local(Blob),
    /// The blob is on its way from the common store.
    Arriving(Arrival),
    /// The blob is in the common store alone. Its bytes can't be read.
    Elsewhere { quoted_digest: Bytes, size: u64 },
}

impl Content {
    pub fn quoted_digest(&self) -> &Bytes {
        match self {
            Self::Local(blob) => blob.quoted_digest(),
            Self::Arriving(arrival) => arrival.quoted_digest(),
            Self::Elsewhere { quoted_digest, .. } => quoted_digest,
        }
    }

    /// The blob's size in bytes.
    pub fn size(&self) -> u64 {
        match self {
            Self::Local(blob) => blob.size(),
            Self::Arriving(arrival) => arrival.size(),
            Self::Elsewhere { size, .. } => *size,
        }
    }
}

/// A blob that the store has.
enum Found {
    Local(Blob),
    Arriving(Arrival),
}

impl Blobs {
    /// The blob; `None` if the store does not have it. A blob that is only in the common store is
    /// fetched first.
    pub async fn get(&self, digest: Digest) -> Result<Option<Blob>, BlobError> {
        let arrival = match self.local_or_arriving(digest).await? {
            None => return Ok(None),
            Some(Found::Local(blob)) => return Ok(Some(blob)),
            Some(Found::Arriving(arrival)) => arrival,
        };
        let Some(file) = arrival.whole().await? else { return Ok(None) };
        let shared = self.shared.clone();
        let opened = on_disk(move || {
            Blob::of(digest, file, &shared).map_err(BlobError::disk("open", &shared.path(digest)))
        });
        Ok(Some(self.shared.keep_open(opened.await?)))
    }

    /// The blob, for an answer that can follow its arrival; `None` if the store does not have it.
    pub async fn content(&self, digest: Digest) -> Result<Option<Content>, BlobError> {
        Ok(match self.local_or_arriving(digest).await? {
            None => None,
            Some(Found::Local(blob)) => Some(Content::Local(blob)),
            Some(Found::Arriving(mut arrival)) => {
                arrival.has_begun().await?.then_some(Content::Arriving(arrival))
            }
        })
    }

    /// The blob without a fetch, for an answer that has none of its bytes; `None` if the store does
    /// not have it.
    pub async fn describe(&self, digest: Digest) -> Result<Option<Content>, BlobError> {
        if let Some(blob) = self.open_local(digest).await? {
            return Ok(Some(Content::Local(blob)));
        }
        let Some(common) = &self.shared.common else { return Ok(None) };
        let Some(row) = common.store.find(digest).await? else { return Ok(None) };
        let quoted_digest = format!("\"{digest}\"").into();
        Ok(Some(Content::Elsewhere { quoted_digest, size: row.bytes }))
    }

    /// The blob if it is on this machine; otherwise its fetch, which begins now unless it runs.
    async fn local_or_arriving(&self, digest: Digest) -> Result<Option<Found>, BlobError> {
        loop {
            if let Some(blob) = self.open_local(digest).await? {
                return Ok(Some(Found::Local(blob)));
            }
            let Some(common) = &self.shared.common else { return Ok(None) };
            if let Some(arrival) = common.fetches.find(digest) {
                return Ok(Some(Found::Arriving(arrival)));
            }
            let Some(row) = common.store.find(digest).await? else { return Ok(None) };
            match Fetches::begin(&self.shared, row)? {
                Begun::Running(arrival) => return Ok(Some(Found::Arriving(arrival))),
                // The copy has come since the first look.
                Begun::Cached => {}
            }
        }
    }

    async fn open_local(&self, digest: Digest) -> Result<Option<Blob>, BlobError> {
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
}
