//! The blocking half of a pull: replays the `.part`, receives new bytes from the connection, hashes
//! them, appends them to the `.part` and unpacks them. Only this module decides whether the tree
//! moves to its place.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use sha2::{Digest as _, Sha256};
use task_archive::{Limits, UnpackError};
use task_proto::Digest;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::messages::report::Progress;
use task_proto::packages::manifest::ContentFacts;
use tokio::sync::{OwnedMutexGuard, mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::{FetchError, Fetcher};
use crate::system::disk::Need;
use crate::system::durable;

/// One attempt to unpack a package's content.
pub(super) struct Intake {
    blob: BlobRef,
    part: PathBuf,
    staging: PathBuf,
    limits: Limits,
    /// Bytes of the `.part` to replay.
    present: u64,
    receiver: mpsc::Receiver<Bytes>,
    progress: watch::Sender<Progress>,
    stop: CancellationToken,
    /// Lock on the content, held until all work of this attempt has ended, possibly after the pull
    /// was dropped.
    _lock: Arc<OwnedMutexGuard<()>>,
}

impl Intake {
    pub(super) fn new(
        fetcher: &Fetcher,
        package: &PackageRef,
        present: u64,
        receiver: mpsc::Receiver<Bytes>,
        progress: watch::Sender<Progress>,
        stop: CancellationToken,
        lock: Arc<OwnedMutexGuard<()>>,
    ) -> Self {
        let blob = package.content;
        Self {
            blob,
            part: fetcher.data.blob_part(&blob.digest),
            staging: fetcher.data.staging().join(package.manifest.digest.hex()),
            limits: fetcher.settings().limits,
            present,
            receiver,
            progress,
            stop,
            _lock: lock,
        }
    }

    /// Reads all bytes, unpacks them, and moves the tree to `src`.
    pub(super) fn run(
        self,
        facts: &ContentFacts,
        src: &Path,
        need: Need,
    ) -> Result<(), FetchError> {
        let part = self.part.clone();
        let staging = self.staging.clone();
        let result = self.unpack(facts).and_then(|()| place(&staging, src));
        let cleaned = match &result {
            // The bytes are unpacked or useless. Bytes with another digest stay, because a repair
            // may mend them.
            Ok(()) | Err(FetchError::ArchiveRefused(_)) => durable::remove_file(&part),
            Err(_) => Ok(()),
        };
        if let Err(error) = cleaned.and_then(|()| durable::remove_dir_all(&staging)) {
            tracing::warn!(%error, part = %part.display(), "cannot remove the leftovers of a pull");
        }
        result.map_err(|error| error.or_disk_full(part.parent().unwrap_or(&part), need))
    }

    fn unpack(self, facts: &ContentFacts) -> Result<(), FetchError> {
        let blob = self.blob;
        let limits = self.limits;
        let staging = self.staging.clone();
        durable::remove_dir_all(&staging).map_err(|source| FetchError::disk(&staging, source))?;
        if let Some(parent) = staging.parent() {
            durable::create_dir_all(parent).map_err(|source| FetchError::disk(parent, source))?;
        }
        let mut bytes = Bytestream::open(self)?;
        let unpacked = task_archive::unpack(&mut bytes, blob.size, facts, &limits, &staging);
        if let Err(UnpackError::Disk { path, source }) = unpacked {
            return Err(FetchError::Disk { path, source });
        }
        // Read to the end even after a refusal: only the digest tells whether the package or the
        // network is at fault.
        if bytes.failure.is_none() {
            let _ = io::copy(&mut bytes, &mut io::sink());
        }
        if let Some(failure) = bytes.failure {
            return Err(failure);
        }
        let found = Digest::from_sha256(bytes.hasher.finalize().into());
        if found != blob.digest {
            return Err(FetchError::digest_mismatch(blob.digest, found));
        }
        match unpacked {
            Ok(()) => Ok(()),
            Err(UnpackError::Refused(refusal)) => Err(refusal.into()),
            Err(UnpackError::Source(source)) | Err(UnpackError::Disk { source, .. }) => {
                Err(FetchError::disk(&staging, source))
            }
        }
    }
}

/// Syncs the tree to the disk, then moves the tree to its place.
fn place(staging: &Path, src: &Path) -> Result<(), FetchError> {
    let version = src.parent().unwrap_or(src);
    durable::create_dir_all(version).map_err(|source| FetchError::disk(version, source))?;
    durable::sync_file_system(staging).map_err(|source| FetchError::disk(staging, source))?;
    durable::rename(staging, src).map_err(|source| FetchError::disk(src, source))
}

/// All bytes of the blob in order: first the `.part`, then the new bytes.
struct Bytestream {
    intake: Intake,
    file: File,
    replayed: u64,
    done: u64,
    current: Bytes,
    hasher: Sha256,
    /// Reason why the bytes ended early.
    failure: Option<FetchError>,
}

impl Bytestream {
    fn open(intake: Intake) -> Result<Self, FetchError> {
        let disk = |source| FetchError::disk(&intake.part, source);
        if let Some(parent) = intake.part.parent() {
            durable::create_dir_all(parent).map_err(disk)?;
        }
        let file = OpenOptions::new()
            .read(true)
            .append(true)
            .create(true)
            .open(&intake.part)
            .map_err(disk)?;
        Ok(Self {
            intake,
            file,
            replayed: 0,
            done: 0,
            current: Bytes::new(),
            hasher: Sha256::new(),
            failure: None,
        })
    }

    fn next(&mut self, buffer: &mut [u8]) -> Result<usize, FetchError> {
        if self.intake.stop.is_cancelled() {
            return Err(FetchError::Cancelled);
        }
        if self.replayed < self.intake.present {
            return self.replay(buffer);
        }
        while self.current.is_empty() {
            match self.intake.receiver.blocking_recv() {
                Some(chunk) => self.keep(chunk)?,
                None if self.done == self.intake.blob.size => return Ok(0),
                None => {
                    return Err(FetchError::Interrupted {
                        received: self.done,
                        size: self.intake.blob.size,
                    });
                }
            }
        }
        let count = buffer.len().min(self.current.len());
        buffer[..count].copy_from_slice(&self.current.split_to(count));
        Ok(count)
    }

    fn replay(&mut self, buffer: &mut [u8]) -> Result<usize, FetchError> {
        let left = self.intake.present - self.replayed;
        let wanted = left.min(buffer.len() as u64) as usize;
        let count = self
            .file
            .read(&mut buffer[..wanted])
            .map_err(|source| FetchError::disk(&self.intake.part, source))?;
        if count == 0 && wanted > 0 {
            return Err(FetchError::disk(&self.intake.part, io::ErrorKind::UnexpectedEof.into()));
        }
        self.replayed += count as u64;
        self.account(&buffer[..count]);
        Ok(count)
    }

    fn keep(&mut self, chunk: Bytes) -> Result<(), FetchError> {
        self.file
            .write_all(&chunk)
            .map_err(|source| FetchError::disk(&self.intake.part, source))?;
        self.account(&chunk);
        self.current = chunk;
        Ok(())
    }

    fn account(&mut self, bytes: &[u8]) {
        self.hasher.update(bytes);
        self.done += bytes.len() as u64;
        self.intake
            .progress
            .send_replace(Progress { done: self.done, total: self.intake.blob.size });
    }
}

impl Read for Bytestream {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.next(buffer).map_err(|failure| {
            let text = failure.to_string();
            self.failure = Some(failure);
            io::Error::other(text)
        })
    }
}
