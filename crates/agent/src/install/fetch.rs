//! Pulls a package from the server in one pass: stream, hash, decompress, unpack. A `.part` file
//! keeps the received bytes, so a pull resumes after a cut or a restart of the agent: the `.part`
//! is replayed and a Range request fetches the rest. Bytes that the server pushes, as parts or with
//! the order itself, take the same path.
//!
//! Invariants: a tree moves to its place only after all its bytes matched the ordered digest and
//! are on the disk. The bytes of a pull that failed for good are deleted. A dropped or cancelled
//! pull leaves only the `.part`. The compressed bytes are deleted once the tree is in place: they
//! have served their purpose, and a robot's disk is small.

mod download;
mod error;
mod inline_blobs;
mod intake;
mod part_map;
mod pushed;
mod repair;
mod verified;

use std::collections::{HashMap, HashSet};
use std::fs;
use std::io;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, Weak};
use std::time::Duration;

use bytes::Bytes;
use http::header::CONNECTION;
use task_archive::Limits;
use task_proto::desired::settings::RobotLimits;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::messages::report::Progress;
use task_proto::packages::manifest::TaskManifest;
use task_proto::{Digest, RepositoryName};
use tokio::sync::{OwnedMutexGuard, mpsc, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use self::download::Download;
pub(crate) use self::download::MAX_RETRY_AFTER;
pub use self::error::FetchError;
use self::inline_blobs::InlineBlobs;
use self::intake::Intake;
use self::pushed::PartCollector;
pub use self::pushed::PartTimeouts;
use crate::system::disk::{self, Need};
use crate::system::durable;
use crate::system::layout::DataDir;
use crate::system::untrusted_file;
use crate::transfer::credential::Credential;
use crate::transfer::link_meter::LinkMeter;
use crate::transfer::parts::PartRequest;
use crate::transfer::parts::PartSubscriptions;

/// The largest task manifest that is held in memory.
const MAX_MANIFEST_BYTES: u64 = 1 << 20;
/// Capacity, in chunks, of the queue between the connection and the disk. A chunk is one read by
/// hyper, at most about 400 KiB.
const QUEUED_CHUNKS: usize = 16;
/// Number of reconnects of one pull before the error goes back to the caller's slower retries.
const MAX_RECONNECTS: u32 = 5;
/// A connection that delivered this many bytes counts as good and resets the reconnect counter.
const PROGRESS_BYTES: u64 = 1 << 20;
/// Most contents remembered as given up: we no longer wait for their parts.
const MAX_GIVEN_UP: usize = 64;

/// Source of the missing bytes.
enum Source {
    Download(Box<Download>),
    /// The bytes came with the order.
    Inline(Bytes),
    /// No bytes are missing.
    Nothing,
}

/// Limits of a pull.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FetchSettings {
    /// Size limits of a package.
    pub limits: Limits,
    /// Bytes that every pull leaves free on the disk.
    pub reserve_bytes: u64,
    /// Longest time for the server's first answer, and for each further 16 KiB.
    pub stall_timeout: Duration,
    /// Longest wait before the first reconnect after a cut. The wait grows with each further
    /// reconnect.
    pub reconnect_wait: Duration,
    /// Timeouts for parts that the server pushes.
    pub parts: PartTimeouts,
}

impl Default for FetchSettings {
    fn default() -> Self {
        Self {
            limits: Limits::default(),
            reserve_bytes: 256 << 20,
            stall_timeout: Duration::from_secs(30),
            reconnect_wait: Duration::from_secs(2),
            parts: PartTimeouts::default(),
        }
    }
}

/// Pulls packages into one data directory.
pub struct Fetcher {
    client: reqwest::Client,
    server: reqwest::Url,
    token: Credential,
    data: DataDir,
    /// The configured settings, before the robot's limits apply.
    given: FetchSettings,
    settings: RwLock<FetchSettings>,
    locks: ContentLocks,
    meter: LinkMeter,
    inline_blobs: InlineBlobs,
    /// Pushed contents that did not arrive completely. We no longer wait for their parts.
    given_up: Mutex<HashSet<Digest>>,
}

impl Fetcher {
    /// Applies `limits` to all later pulls.
    pub fn limit(&self, limits: &RobotLimits) {
        let mut settings = self.given;
        settings.limits.bytes = limits.archive_bytes.unwrap_or(settings.limits.bytes);
        settings.limits.entries = limits.archive_entries.unwrap_or(settings.limits.entries);
        settings.reserve_bytes = limits.disk_reserve_bytes.unwrap_or(settings.reserve_bytes);
        *self.settings.write().unwrap_or_else(PoisonError::into_inner) = settings;
    }

    fn settings(&self) -> FetchSettings {
        *self.settings.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Pulls from `server` with the robot's `token`.
    pub fn new(
        client: reqwest::Client,
        server: reqwest::Url,
        token: impl Into<Credential>,
        data: DataDir,
        settings: FetchSettings,
    ) -> Self {
        Self {
            client,
            server,
            token: token.into(),
            data,
            given: settings,
            settings: RwLock::new(settings),
            locks: ContentLocks::default(),
            meter: LinkMeter::default(),
            inline_blobs: InlineBlobs::default(),
            given_up: Mutex::default(),
        }
    }

    /// Reports the transfers' link measurements to `meter`.
    pub fn with_meter(self, meter: LinkMeter) -> Self {
        Self { meter, ..self }
    }

    /// Stores blobs that came with an order. Blobs that do not match their digest are ignored.
    pub fn add_inline_blobs(&self, blobs: impl IntoIterator<Item = (BlobRef, Bytes)>) {
        let matches_digest = |(blob, bytes): &(BlobRef, Bytes)| Digest::of(bytes) == blob.digest;
        self.inline_blobs.replace(blobs.into_iter().filter(matches_digest));
    }

    /// Returns the package's task manifest, from the disk if a complete copy is there. The bytes
    /// are verified either way.
    pub async fn manifest(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<TaskManifest, FetchError> {
        if let Some(manifest) = stored_manifest(&self.data, package) {
            return Ok(manifest);
        }
        let bytes = match self.inline_blobs.get(&package.config) {
            Some(bytes) => bytes.into(),
            None => {
                let pulled = cancel.run_until_cancelled(self.pull_manifest(package)).await;
                pulled.ok_or(FetchError::Cancelled)??
            }
        };
        let manifest = read_manifest(&bytes, package)?;
        let version = self.data.task(&package.name).version(&package.manifest.digest);
        let path = version.manifest();
        let kept = durable::create_dir_all(version.root())
            .and_then(|()| durable::write(&path, &bytes, 0o644));
        kept.map_err(|source| {
            FetchError::disk(&path, source)
                .or_disk_full(self.data.root(), Need::of_file(bytes.len() as u64))
        })?;
        self.inline_blobs.forget(&package.config.digest);
        Ok(manifest)
    }

    /// Pulls the package's content into its version's `src`, or returns at once if `src` exists.
    /// `progress` counts compressed bytes, including those of earlier attempts. On return, no work
    /// of the pull is still running.
    pub async fn content(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> Result<(), FetchError> {
        let lock = self.lock_content(package, cancel).await?;
        self.locked_content(package, manifest, progress, cancel, lock).await
    }

    /// Like [`Self::content`], for a content that the server pushes: collects parts from
    /// `part_subscriptions` first, then pulls the missing rest. `part_requests` carries the missing
    /// parts for the robot's report.
    pub async fn pushed_content(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        part_subscriptions: &PartSubscriptions,
        (progress, part_requests): (&watch::Sender<Progress>, &watch::Sender<PartRequest>),
        cancel: &CancellationToken,
    ) -> Result<(), FetchError> {
        let lock = self.lock_content(package, cancel).await?;
        let content = package.content;
        let is_there = self.src(package).is_dir() || self.inline_blobs.get(&content).is_some();
        if !is_there
            && self.present(package)? < content.size
            && !self.given_up().contains(&content.digest)
        {
            let collector =
                PartCollector::open(self, package, progress, part_requests, lock.clone())?;
            let need =
                Need::of(package, manifest, collector.bytes(), self.settings().reserve_bytes);
            let collected = match self.check_room(need) {
                Ok(()) => {
                    collector
                        .run(part_subscriptions.subscribe(content.digest, content.size), cancel)
                        .await
                }
                Err(error) => Err(error),
            };
            match collected.map_err(|error| error.or_disk_full(self.data.root(), need)) {
                Ok(Ok(())) => {}
                Ok(Err(why)) => {
                    tracing::info!(package = %package.name, "pulling content that the server pushes: {why}");
                    self.meter.lost_transfer(Instant::now());
                    self.give_up(content.digest);
                }
                Err(error) => {
                    if error.discards_content() {
                        self.discard(package)?;
                    }
                    return Err(error);
                }
            }
        }
        self.locked_content(package, manifest, progress, cancel, lock).await
    }

    async fn locked_content(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
        lock: Arc<OwnedMutexGuard<()>>,
    ) -> Result<(), FetchError> {
        let content = package.content;
        pushed::convert_to_part(&self.data, content)
            .map_err(|source| FetchError::disk(&self.data.blob_parts(&content.digest), source))?;
        let result = self.pull_until_verified(package, manifest, progress, cancel, lock).await;
        match &result {
            Ok(()) => {
                self.inline_blobs.forget(&content.digest);
                self.given_up().remove(&content.digest);
            }
            // No later attempt uses these bytes, or the disk is full and the ledger needs the
            // space.
            Err(error) if error.discards_content() => self.discard(package)?,
            Err(_) => {}
        }
        result
    }

    /// Locks the content: two tasks may share one, and a dropped pull takes a moment to end.
    async fn lock_content(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<Arc<OwnedMutexGuard<()>>, FetchError> {
        let lock = cancel.run_until_cancelled(self.locks.lock(package.content.digest)).await;
        lock.map(Arc::new).ok_or(FetchError::Cancelled)
    }

    async fn pull_manifest(&self, package: &PackageRef) -> Result<Vec<u8>, FetchError> {
        if package.config.size > MAX_MANIFEST_BYTES {
            let reason = format!(
                "it has {} bytes, at most {MAX_MANIFEST_BYTES} are allowed",
                package.config.size
            );
            return Err(FetchError::ManifestInvalid(reason));
        }
        self.pull_whole(&RepositoryName::of_package(&package.name), package.config).await
    }

    /// Returns a blob of at most `most` bytes in memory, from the order or by a pull.
    pub async fn small_blob(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        most: u64,
        cancel: &CancellationToken,
    ) -> Result<Vec<u8>, FetchError> {
        if blob.size > most {
            return Err(FetchError::TooLarge { digest: blob.digest, size: blob.size, most });
        }
        if let Some(bytes) = self.inline_blobs.get(&blob) {
            return Ok(bytes.into());
        }
        let pulled = cancel.run_until_cancelled(self.pull_whole(repository, blob)).await;
        pulled.ok_or(FetchError::Cancelled)?
    }

    async fn pull_content(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
        lock: Arc<OwnedMutexGuard<()>>,
    ) -> Result<(), FetchError> {
        let src = self.src(package);
        if src.is_dir() {
            return self.discard(package);
        }
        let offset = self.present(package)?;
        progress.send_replace(Progress { done: offset, total: package.content.size });
        let need = Need::of(package, manifest, offset, self.settings().reserve_bytes);
        self.check_room(need)?;
        // Send the request first. Replaying the `.part` on each attempt while the server is away
        // would wear the disk out.
        let source = if offset == package.content.size {
            Source::Nothing
        } else if let Some(bytes) = self.inline_blobs.get(&package.content) {
            Source::Inline(bytes.slice(offset as usize..))
        } else {
            let answer = cancel.run_until_cancelled(self.download_content(package, offset)).await;
            Source::Download(Box::new(answer.ok_or(FetchError::Cancelled)??))
        };
        // Stops the blocking half even if this future is dropped during the replay.
        let stop = cancel.child_token();
        let _stop_on_drop = stop.clone().drop_guard();
        let (sender, receiver) = mpsc::channel(QUEUED_CHUNKS);
        let intake = Intake::new(self, package, offset, receiver, progress.clone(), stop, lock);
        let facts = manifest.content;
        let unpacking = tokio::task::spawn_blocking(move || intake.run(&facts, &src, need));
        let feeding = async {
            match source {
                Source::Download(download) => return self.feed(package, *download, sender).await,
                // Sending fails only if the disk failed, and the blocking half reports that error.
                Source::Inline(bytes) => drop(sender.send(bytes).await),
                Source::Nothing => {}
            }
            drop(sender);
            Ok(())
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

    /// Forwards the content's bytes and reconnects after a cut. Ends early and without an error if
    /// the receiver is gone.
    async fn feed(
        &self,
        package: &PackageRef,
        mut download: Download,
        sender: mpsc::Sender<Bytes>,
    ) -> Result<(), FetchError> {
        let mut cut = match self.forward(&mut download, &sender).await {
            Err(error) if error.is_cut() => error,
            ended => return ended,
        };
        let mut position = download.position();
        let mut reconnects = 0;
        while reconnects < MAX_RECONNECTS {
            reconnects += 1;
            tracing::info!(package = %package.name, position, %cut, "reconnecting");
            // Random wait: a server restart cuts off the whole fleet at once.
            let longest = self.settings().reconnect_wait * reconnects;
            tokio::time::sleep(longest.mul_f64(rand::random())).await;
            let ended = match self.download_content(package, position).await {
                Ok(mut download) => {
                    let ended = self.forward(&mut download, &sender).await;
                    // Reset on progress: on a network with constant cuts the pull still advances.
                    if download.position() - position >= PROGRESS_BYTES {
                        reconnects = 0;
                    }
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

    /// Forwards the bytes of one answer and measures the transfer.
    async fn forward(
        &self,
        download: &mut Download,
        sender: &mpsc::Sender<Bytes>,
    ) -> Result<(), FetchError> {
        let from = download.position();
        let ended = download.forward(sender).await;
        self.meter.transferred(download.position() - from, download.requested_at().elapsed());
        if ended.as_ref().is_err_and(FetchError::is_cut) {
            self.meter.lost_transfer(Instant::now());
        }
        ended
    }

    async fn download_content(
        &self,
        package: &PackageRef,
        offset: u64,
    ) -> Result<Download, FetchError> {
        let range = offset..package.content.size;
        self.download_range(&RepositoryName::of_package(&package.name), package.content, range)
            .await
    }

    /// Requests a range of a blob over its own connection.
    async fn download_range(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        range: Range<u64>,
    ) -> Result<Download, FetchError> {
        // No further request uses this connection.
        let request = || Ok(self.request(repository, blob)?.header(CONNECTION, "close"));
        self.start(request, repository, blob, range).await
    }

    /// Sends a request. An unavailable blob ends an order, so we believe the answer only after a
    /// second one: a byte that flips on its way to the server changes the digest in the request.
    async fn start(
        &self,
        request: impl Fn() -> Result<reqwest::RequestBuilder, FetchError>,
        repository: &RepositoryName,
        blob: BlobRef,
        range: Range<u64>,
    ) -> Result<Download, FetchError> {
        let stall_timeout = self.settings().stall_timeout;
        match Download::start(request()?, repository, blob, range.clone(), stall_timeout).await {
            Err(FetchError::Unavailable { .. }) => {
                Download::start(request()?, repository, blob, range, stall_timeout).await
            }
            answer => answer,
        }
    }

    fn request(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
    ) -> Result<reqwest::RequestBuilder, FetchError> {
        let mut url = self.server.clone();
        match url.path_segments_mut() {
            Ok(mut path) => {
                path.pop_if_empty().push("v2").extend(repository.as_str().split('/'));
                path.extend(["blobs", &blob.digest.to_string()]);
            }
            Err(()) => {
                return Err(FetchError::NotTheServer(format!(
                    "{} is not an HTTP address",
                    self.server
                )));
            }
        }
        Ok(self.client.get(url).bearer_auth(self.token.current()))
    }

    fn src(&self, package: &PackageRef) -> PathBuf {
        self.data.task(&package.name).version(&package.manifest.digest).src()
    }

    fn check_room(&self, need: Need) -> Result<(), FetchError> {
        let root = self.data.root();
        Ok(need.check(disk::space(root).map_err(|source| FetchError::disk(root, source))?)?)
    }

    fn given_up(&self) -> MutexGuard<'_, HashSet<Digest>> {
        // Every change under the lock is complete in itself.
        self.given_up.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn give_up(&self, content: Digest) {
        let mut given_up = self.given_up();
        if given_up.len() >= MAX_GIVEN_UP {
            given_up.clear();
        }
        given_up.insert(content);
    }

    fn discard(&self, package: &PackageRef) -> Result<(), FetchError> {
        let part = self.data.blob_part(&package.content.digest);
        let gone = durable::remove_file(&part)
            .and_then(|()| pushed::discard(&self.data, &package.content.digest));
        gone.map_err(|source| FetchError::disk(&part, source))
    }

    /// Bytes of the content on the disk from earlier attempts.
    fn present(&self, package: &PackageRef) -> Result<u64, FetchError> {
        let part = self.data.blob_part(&package.content.digest);
        match fs::metadata(&part) {
            Ok(metadata) if metadata.len() <= package.content.size => Ok(metadata.len()),
            Ok(_) => durable::remove_file(&part)
                .map(|()| 0)
                .map_err(|source| FetchError::disk(&part, source)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(0),
            Err(source) => Err(FetchError::disk(&part, source)),
        }
    }
}

/// Returns the package's task manifest if an earlier pull stored it and the file is intact.
pub fn stored_manifest(data: &DataDir, package: &PackageRef) -> Option<TaskManifest> {
    // The file lies among the task's own files, and the task may have replaced it.
    let path = data.task(&package.name).version(&package.manifest.digest).manifest();
    let bytes = untrusted_file::read(&path, MAX_MANIFEST_BYTES).ok()?;
    if Digest::of(&bytes) != package.config.digest {
        return None;
    }
    read_manifest(&bytes, package).ok()
}

fn read_manifest(bytes: &[u8], package: &PackageRef) -> Result<TaskManifest, FetchError> {
    let manifest: TaskManifest = serde_json::from_slice(bytes)
        .map_err(|error| FetchError::ManifestInvalid(error.to_string()))?;
    if manifest.name != package.name || manifest.version != package.version {
        let reason = format!(
            "it is for {} {}, expected {} {}",
            manifest.name, manifest.version, package.name, package.version
        );
        return Err(FetchError::ManifestInvalid(reason));
    }
    match manifest.problems().first() {
        Some(problem) => Err(FetchError::ManifestInvalid(problem.to_string())),
        None => Ok(manifest),
    }
}

/// Locks per digest: a blob has at most one pull at a time.
#[derive(Default)]
struct ContentLocks(Mutex<HashMap<Digest, Weak<tokio::sync::Mutex<()>>>>);

impl ContentLocks {
    async fn lock(&self, digest: Digest) -> OwnedMutexGuard<()> {
        self.of(digest).lock_owned().await
    }

    fn of(&self, digest: Digest) -> Arc<tokio::sync::Mutex<()>> {
        let mut locks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        locks.retain(|_, lock| lock.strong_count() > 0);
        if let Some(lock) = locks.get(&digest).and_then(Weak::upgrade) {
            return lock;
        }
        let lock = Arc::default();
        locks.insert(digest, Arc::downgrade(&lock));
        lock
    }
}
