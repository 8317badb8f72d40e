//! Pulls a package from the server in one pass: stream, hash, decompress, unpack. What has arrived is kept in a `.part`
//! file, so that a pull goes on where the last one ended, across restarts of the agent: the `.part` is replayed, the
//! rest is asked for by Range.
//!
//! Invariants: a tree gets its place only when all its bytes had the ordered digest and are on the disk; the bytes of a
//! pull that failed for good are gone. When a pull is dropped or cancelled nothing is left but the `.part`.
//! The compressed bytes are not kept once the tree is there: it is what they were for, and a robot's disk is small.

mod download;
mod intake;

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use bytes::Bytes;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::manifest::TaskManifest;
use task_proto::report::{FailureCode, Progress};
use task_proto::{Digest, TaskName};
use tokio::sync::{OwnedMutexGuard, mpsc, watch};
use tokio_util::sync::CancellationToken;

use self::download::Download;
use self::intake::Intake;
use crate::credential::Credential;
use crate::disk::{self, DiskFull, Need};
use crate::durable;
use crate::foreign_file;
use crate::layout::DataDir;
use crate::unpack::{Limits, Refusal};

/// The largest task manifest that is held in memory.
const MAX_MANIFEST_BYTES: u64 = 1 << 20;
/// Chunks between the connection and the disk. A chunk is what hyper reads at once, at most about 400 KiB.
const QUEUED_CHUNKS: usize = 16;
/// How often one pull connects anew after a cut before it is given back to the caller's slower retries.
const MAX_RECONNECTS: u32 = 5;

/// Limits of a pull.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FetchSettings {
    /// How large a package may get.
    pub limits: Limits,
    /// Bytes that stay free on the disk whatever is pulled.
    pub reserve_bytes: u64,
    /// How long the server may take for each further 16 KiB, and for its first answer.
    pub stall_timeout: Duration,
    /// The longest wait before the first new connection after a cut; it grows with each further one.
    pub reconnect_wait: Duration,
}

impl Default for FetchSettings {
    fn default() -> Self {
        Self {
            limits: Limits::default(),
            reserve_bytes: 256 << 20,
            stall_timeout: Duration::from_secs(30),
            reconnect_wait: Duration::from_secs(2),
        }
    }
}

/// Why a pull did not end with the package in its place.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// The caller took it back.
    #[error("the pull was cancelled")]
    Cancelled,
    /// No connection, or it broke.
    #[error("the server can't be reached, or the connection broke")]
    Unreachable(#[source] reqwest::Error),
    /// The answer ended before the blob's last byte.
    #[error("the answer ended after {received} of {size} bytes")]
    Interrupted {
        /// Bytes there are now.
        received: u64,
        /// The blob's size.
        size: u64,
    },
    /// Too little came for too long.
    #[error("the server sent next to nothing for {} s", .0.as_secs())]
    Stalled(Duration),
    /// Something answered that is not a taskd server or a registry: a captive portal, a proxy.
    #[error("something else answers in the server's place: {0}")]
    NotTheServer(String),
    /// The server is overloaded, restarting or broken.
    #[error("the server answers {status}")]
    Busy {
        /// The HTTP status.
        status: u16,
        /// When it wants to be asked again.
        retry_after: Option<Duration>,
    },
    /// The token is not accepted.
    #[error("the server does not accept this robot's token")]
    Unauthorized,
    /// The server will not give this blob to this robot.
    #[error("the server answers {status} for blob {digest} of {package}")]
    Unavailable {
        /// The HTTP status.
        status: u16,
        /// What was asked for.
        digest: Digest,
        /// The package it belongs to.
        package: TaskName,
    },
    /// The bytes are not the ordered ones.
    #[error("the server's bytes for {digest} are others: {reason}")]
    DigestMismatch {
        /// The ordered digest.
        digest: Digest,
        /// What was found.
        reason: String,
    },
    /// The bytes are the ordered ones, but no task manifest for this package.
    #[error("the package's task manifest can't be used: {0}")]
    ManifestInvalid(String),
    /// The bytes are the ordered ones, but hold what a package must not.
    #[error(transparent)]
    ArchiveRefused(#[from] Refusal),
    /// There is not enough room.
    #[error(transparent)]
    DiskFull(#[from] DiskFull),
    /// The disk fails in another way.
    #[error("cannot use {}", path.display())]
    Disk {
        /// What was being read or written.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

impl FetchError {
    /// The code that a report gives; `None` for a pull that was cancelled, which is no failure.
    pub fn code(&self) -> Option<FailureCode> {
        match self {
            Self::Cancelled => None,
            Self::Unreachable(_)
            | Self::Interrupted { .. }
            | Self::Stalled(_)
            | Self::NotTheServer(_)
            | Self::Busy { .. } => Some(FailureCode::SERVER_UNREACHABLE),
            Self::Unauthorized => Some(FailureCode::UNAUTHORIZED),
            Self::Unavailable { .. } => Some(FailureCode::PACKAGE_UNAVAILABLE),
            Self::DigestMismatch { .. } => Some(FailureCode::DIGEST_MISMATCH),
            Self::ManifestInvalid(_) => Some(FailureCode::MANIFEST_INVALID),
            Self::ArchiveRefused(_) => Some(FailureCode::ARCHIVE_REFUSED),
            Self::DiskFull(_) => Some(FailureCode::DISK_FULL),
            Self::Disk { .. } => Some(FailureCode::IO_ERROR),
        }
    }

    /// Whether the same pull may succeed later without anyone's doing.
    pub fn is_retryable(&self) -> bool {
        self.is_cut()
            || matches!(self, Self::NotTheServer(_) | Self::Busy { .. } | Self::Unauthorized | Self::DiskFull(_))
    }

    /// Whether what was gathered is to go: it is of no use, or takes up the room that is missing.
    fn spoils_gathered(&self) -> bool {
        matches!(self, Self::DiskFull(_)) || !self.is_retryable() && !matches!(self, Self::Cancelled)
    }

    /// How long to wait at least before it is tried again.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Busy { retry_after, .. } => *retry_after,
            Self::DiskFull(_) => Some(disk::FULL_PAUSE),
            _ => None,
        }
    }

    /// Whether it is the connection that failed, and not an answer.
    fn is_cut(&self) -> bool {
        matches!(self, Self::Unreachable(_) | Self::Interrupted { .. } | Self::Stalled(_))
    }

    fn disk(path: &Path, source: io::Error) -> Self {
        Self::Disk { path: path.to_owned(), source }
    }
}

/// Pulls packages into one data directory.
pub struct Fetcher {
    client: reqwest::Client,
    server: reqwest::Url,
    token: Credential,
    data: DataDir,
    settings: FetchSettings,
    turns: Turns,
}

impl Fetcher {
    /// Pulls from `server` with the robot's `token`.
    pub fn new(
        client: reqwest::Client,
        server: reqwest::Url,
        token: impl Into<Credential>,
        data: DataDir,
        settings: FetchSettings,
    ) -> Self {
        Self { client, server, token: token.into(), data, settings, turns: Turns::default() }
    }

    /// The package's task manifest, from the disk if it is there whole. Its bytes are verified either way.
    pub async fn manifest(&self, package: &PackageRef, cancel: &CancellationToken) -> Result<TaskManifest, FetchError> {
        if let Some(manifest) = stored_manifest(&self.data, package) {
            return Ok(manifest);
        }
        let pulled = cancel.run_until_cancelled(self.pull_manifest(package)).await;
        let bytes = pulled.ok_or(FetchError::Cancelled)??;
        let manifest = read_manifest(&bytes, package)?;
        let version = self.data.task(&package.name).version(&package.manifest.digest);
        let path = version.manifest();
        durable::create_dir_all(version.root()).map_err(|source| FetchError::disk(version.root(), source))?;
        durable::write(&path, &bytes, 0o644).map_err(|source| FetchError::disk(&path, source))?;
        Ok(manifest)
    }

    /// Pulls the package's content into its version's `src`; at once done if that is there. `progress` counts its
    /// compressed bytes, those of earlier tries included. Returns when nothing of the pull is going on any more.
    pub async fn content(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> Result<(), FetchError> {
        // Two tasks may share a content, and a pull that was dropped takes a moment to end.
        let turn = cancel.run_until_cancelled(self.turns.take(package.content.digest)).await;
        let turn = Arc::new(turn.ok_or(FetchError::Cancelled)?);
        let resumed = self.present(package)? > 0;
        let result = self.pull_content(package, manifest, progress, cancel, turn.clone()).await;
        let result = match result {
            // Perhaps only what a power cut left of the `.part` was wrong.
            Err(FetchError::DigestMismatch { .. }) if resumed => {
                self.discard(package)?;
                self.pull_content(package, manifest, progress, cancel, turn).await
            }
            result => result,
        };
        if result.as_ref().is_err_and(FetchError::spoils_gathered) {
            // Nobody comes back for these bytes, or the disk is full and the ledger needs their room.
            self.discard(package)?;
        }
        result
    }

    async fn pull_manifest(&self, package: &PackageRef) -> Result<Vec<u8>, FetchError> {
        if package.config.size > MAX_MANIFEST_BYTES {
            let reason = format!("it has {} bytes, at most {MAX_MANIFEST_BYTES} are allowed", package.config.size);
            return Err(FetchError::ManifestInvalid(reason));
        }
        let mut download = self.download(package, package.config, 0).await?;
        let mut bytes = Vec::with_capacity(package.config.size as usize);
        while let Some(chunk) = download.next().await? {
            bytes.extend_from_slice(&chunk);
        }
        let found = Digest::of(&bytes);
        if found != package.config.digest {
            return Err(FetchError::DigestMismatch {
                digest: package.config.digest,
                reason: format!("they hash to {found}"),
            });
        }
        Ok(bytes)
    }

    async fn pull_content(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
        turn: Arc<OwnedMutexGuard<()>>,
    ) -> Result<(), FetchError> {
        let src = self.data.task(&package.name).version(&package.manifest.digest).src();
        if src.is_dir() {
            return self.discard(package);
        }
        let offset = self.present(package)?;
        let need = Need::of(package, manifest, offset, self.settings.reserve_bytes);
        let root = self.data.root();
        need.check(disk::room(root).map_err(|source| FetchError::disk(root, source))?)?;
        // Ask first: a replay for nothing each time the server is away would wear the disk out.
        let download = if offset < package.content.size {
            let answer = cancel.run_until_cancelled(self.download(package, package.content, offset)).await;
            Some(answer.ok_or(FetchError::Cancelled)??)
        } else {
            None
        };
        // Ends the blocking half even if this future is dropped while it replays.
        let stop = cancel.child_token();
        let _stop_on_drop = stop.clone().drop_guard();
        let (sender, receiver) = mpsc::channel(QUEUED_CHUNKS);
        let intake = Intake::new(self, package, offset, receiver, progress.clone(), stop, turn);
        let facts = manifest.content;
        let unpacking = tokio::task::spawn_blocking(move || intake.run(&facts, &src, need));
        let feeding = async {
            match download {
                Some(download) => self.feed(package, download, sender).await,
                None => {
                    drop(sender);
                    Ok(())
                }
            }
        };
        let fed = cancel.run_until_cancelled(feeding).await.unwrap_or(Err(FetchError::Cancelled));
        let unpacked = unpacking.await.unwrap_or_else(|error| match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            Err(_) => Err(FetchError::Cancelled),
        });
        match (fed, unpacked) {
            // The blocking half then only knows that no more bytes came.
            (Err(cut), Err(FetchError::Interrupted { .. })) => Err(cut),
            (_, unpacked) => unpacked,
        }
    }

    /// Passes the content's bytes on, connecting anew after a cut. Ends early, and well, if nobody takes them.
    async fn feed(
        &self,
        package: &PackageRef,
        mut download: Download,
        sender: mpsc::Sender<Bytes>,
    ) -> Result<(), FetchError> {
        let mut cut = match download.pass_on(&sender).await {
            Err(error) if error.is_cut() => error,
            ended => return ended,
        };
        let mut position = download.position();
        for reconnects in 1..=MAX_RECONNECTS {
            tracing::info!(package = %package.name, position, %cut, "connecting anew");
            // A server that restarts cuts a whole fleet off at once.
            let longest = self.settings.reconnect_wait * reconnects;
            tokio::time::sleep(longest.mul_f64(rand::random())).await;
            let ended = match self.download(package, package.content, position).await {
                Ok(mut download) => {
                    let ended = download.pass_on(&sender).await;
                    position = download.position();
                    ended
                }
                Err(error) => Err(error),
            };
            cut = match ended {
                Err(error) if error.is_cut() => error,
                ended => return ended,
            };
        }
        Err(cut)
    }

    async fn download(&self, package: &PackageRef, blob: BlobRef, offset: u64) -> Result<Download, FetchError> {
        let mut url = self.server.clone();
        match url.path_segments_mut() {
            Ok(mut path) => {
                path.pop_if_empty().extend(["v2", package.name.as_str(), "blobs", &blob.digest.to_string()]);
            }
            Err(()) => return Err(FetchError::NotTheServer(format!("{} is not an HTTP address", self.server))),
        }
        let request = self.client.get(url).bearer_auth(self.token.current());
        Download::start(request, package, blob, offset, self.settings.stall_timeout).await
    }

    fn discard(&self, package: &PackageRef) -> Result<(), FetchError> {
        let part = self.data.blob_part(&package.content.digest);
        durable::remove_file(&part).map_err(|source| FetchError::disk(&part, source))
    }

    /// How many bytes of the content are there from earlier tries.
    fn present(&self, package: &PackageRef) -> Result<u64, FetchError> {
        let part = self.data.blob_part(&package.content.digest);
        match fs::metadata(&part) {
            Ok(metadata) if metadata.len() <= package.content.size => Ok(metadata.len()),
            Ok(_) => durable::remove_file(&part).map(|()| 0).map_err(|source| FetchError::disk(&part, source)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(0),
            Err(source) => Err(FetchError::disk(&part, source)),
        }
    }
}

/// The package's task manifest if it was pulled before and is still there whole.
pub fn stored_manifest(data: &DataDir, package: &PackageRef) -> Option<TaskManifest> {
    // It lies among the task's own files, which the task may have exchanged.
    let path = data.task(&package.name).version(&package.manifest.digest).manifest();
    let bytes = foreign_file::read(&path, MAX_MANIFEST_BYTES).ok()?;
    if Digest::of(&bytes) != package.config.digest {
        return None;
    }
    read_manifest(&bytes, package).ok()
}

fn read_manifest(bytes: &[u8], package: &PackageRef) -> Result<TaskManifest, FetchError> {
    let manifest: TaskManifest =
        serde_json::from_slice(bytes).map_err(|error| FetchError::ManifestInvalid(error.to_string()))?;
    if manifest.name != package.name || manifest.version != package.version {
        let reason = format!(
            "it is for {} {}, ordered was {} {}",
            manifest.name, manifest.version, package.name, package.version
        );
        return Err(FetchError::ManifestInvalid(reason));
    }
    match manifest.problems().first() {
        Some(problem) => Err(FetchError::ManifestInvalid(problem.to_string())),
        None => Ok(manifest),
    }
}

/// One pull of a blob at a time.
#[derive(Default)]
struct Turns(Mutex<HashMap<Digest, Weak<tokio::sync::Mutex<()>>>>);

impl Turns {
    async fn take(&self, digest: Digest) -> OwnedMutexGuard<()> {
        self.of(digest).lock_owned().await
    }

    fn of(&self, digest: Digest) -> Arc<tokio::sync::Mutex<()>> {
        let mut turns = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        turns.retain(|_, turn| turn.strong_count() > 0);
        if let Some(turn) = turns.get(&digest).and_then(Weak::upgrade) {
            return turn;
        }
        let turn = Arc::default();
        turns.insert(digest, Arc::downgrade(&turn));
        turn
    }
}
