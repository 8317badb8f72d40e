//! Pulls a package from the server in one pass: stream, hash, decompress, unpack. What has arrived
//! is kept in a `.part` file, so that a pull goes on where the last one ended, across restarts of
//! the agent: the `.part` is replayed, the rest is asked for by Range. Bytes that were pushed, as
//! parts or with the order itself, go the same way.
//!
//! Invariants: a tree gets its place only when all its bytes had the ordered digest and are on the
//! disk; the bytes of a pull that failed for good are gone. When a pull is dropped or cancelled
//! nothing is left but the `.part`. The compressed bytes are not kept once the tree is there: it is
//! what they were for, and a robot's disk is small.

mod download;
mod error;
mod intake;
mod offered;
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
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::manifest::TaskManifest;
use task_proto::report::Progress;
use task_proto::settings::RobotLimits;
use task_proto::{Digest, RepositoryName};
use tokio::sync::{OwnedMutexGuard, mpsc, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use self::download::Download;
pub(crate) use self::download::MAX_RETRY_AFTER;
pub use self::error::FetchError;
use self::intake::Intake;
use self::offered::Offered;
use self::pushed::Gathering;
pub use self::pushed::PartPatience;
use crate::system::disk::{self, Need};
use crate::system::durable;
use crate::system::layout::DataDir;
use crate::system::untrusted_file;
use crate::transfer::credential::Credential;
use crate::transfer::link_meter::LinkMeter;
use crate::transfer::parts::Asks;
use crate::transfer::parts::Listening;

/// The largest task manifest that is held in memory.
const MAX_MANIFEST_BYTES: u64 = 1 << 20;
/// Chunks between the connection and the disk. A chunk is what hyper reads at once, at most about
/// 400 KiB.
const QUEUED_CHUNKS: usize = 16;
/// How often one pull connects anew after a cut before it is given back to the caller's slower
/// retries.
const MAX_RECONNECTS: u32 = 5;
/// A connection that brought as much counts as good: the next cut is the first again.
const PROGRESS_BYTES: u64 = 1 << 20;
/// Contents that are remembered as not to be waited for.
const MAX_GIVEN_UP: usize = 64;

/// Where the bytes come from that are not there.
enum Source {
    Download(Box<Download>),
    /// They came with the order.
    Offered(Bytes),
    /// All are there.
    Nothing,
}

/// Limits of a pull.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FetchSettings {
    /// How large a package may get.
    pub limits: Limits,
    /// Bytes that stay free on the disk whatever is pulled.
    pub reserve_bytes: u64,
    /// How long the server may take for each further 16 KiB, and for its first answer.
    pub stall_timeout: Duration,
    /// The longest wait before the first new connection after a cut; it grows with each further
    /// one.
    pub reconnect_wait: Duration,
    /// How long parts are waited for that the server pushes.
    pub parts: PartPatience,
}

impl Default for FetchSettings {
    fn default() -> Self {
        Self {
            limits: Limits::default(),
            reserve_bytes: 256 << 20,
            stall_timeout: Duration::from_secs(30),
            reconnect_wait: Duration::from_secs(2),
            parts: PartPatience::default(),
        }
    }
}

/// Pulls packages into one data directory.
pub struct Fetcher {
    client: reqwest::Client,
    server: reqwest::Url,
    token: Credential,
    data: DataDir,
    /// As they were given, under the robot's limits.
    given: FetchSettings,
    settings: RwLock<FetchSettings>,
    turns: Turns,
    meter: LinkMeter,
    offered: Offered,
    /// Contents that were pushed and did not come: not waited for again.
    given_up: Mutex<HashSet<Digest>>,
}

impl Fetcher {
    /// Lets what is pulled from now on have no more than `limits` say.
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
            turns: Turns::default(),
            meter: LinkMeter::default(),
            offered: Offered::default(),
            given_up: Mutex::default(),
        }
    }

    /// The same, with what transfers show of the link told to `meter`.
    pub fn measured_by(self, meter: LinkMeter) -> Self {
        Self { meter, ..self }
    }

    /// Blobs that came with an order; only those count that are what they say.
    pub fn offer(&self, blobs: impl IntoIterator<Item = (BlobRef, Bytes)>) {
        let is_itself = |(blob, bytes): &(BlobRef, Bytes)| Digest::of(bytes) == blob.digest;
        self.offered.replace(blobs.into_iter().filter(is_itself));
    }

    /// The package's task manifest, from the disk if it is there whole. Its bytes are verified
    /// either way.
    pub async fn manifest(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<TaskManifest, FetchError> {
        if let Some(manifest) = stored_manifest(&self.data, package) {
            return Ok(manifest);
        }
        let bytes = match self.offered.get(&package.config) {
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
                .for_want_of_room(self.data.root(), Need::of_file(bytes.len() as u64))
        })?;
        self.offered.forget(&package.config.digest);
        Ok(manifest)
    }

    /// Pulls the package's content into its version's `src`; at once done if that is there.
    /// `progress` counts its compressed bytes, those of earlier tries included. Returns when
    /// nothing of the pull is going on any more.
    pub async fn content(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> Result<(), FetchError> {
        let turn = self.turn(package, cancel).await?;
        self.content_in_turn(package, manifest, progress, cancel, turn).await
    }

    /// The same for a content that the server pushes: gathers its parts from `listening` first, and
    /// pulls what does not come. `asks` is what a report says of the parts that are lacking.
    pub async fn pushed_content(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        listening: &Listening,
        (progress, asks): (&watch::Sender<Progress>, &watch::Sender<Asks>),
        cancel: &CancellationToken,
    ) -> Result<(), FetchError> {
        let turn = self.turn(package, cancel).await?;
        let content = package.content;
        let is_there = self.src(package).is_dir() || self.offered.get(&content).is_some();
        if !is_there
            && self.present(package)? < content.size
            && !self.given_up().contains(&content.digest)
        {
            let gathering = Gathering::open(self, package, progress, asks, turn.clone())?;
            let need =
                Need::of(package, manifest, gathering.bytes(), self.settings().reserve_bytes);
            let gathered = match self.check_room(need) {
                Ok(()) => {
                    gathering.run(listening.listen(content.digest, content.size), cancel).await
                }
                Err(error) => Err(error),
            };
            match gathered.map_err(|error| error.for_want_of_room(self.data.root(), need)) {
                Ok(Ok(())) => {}
                Ok(Err(why)) => {
                    tracing::info!(package = %package.name, "what is pushed is pulled: {why}");
                    self.meter.lost_transfer(Instant::now());
                    self.give_up(content.digest);
                }
                Err(error) => {
                    if error.spoils_gathered() {
                        self.discard(package)?;
                    }
                    return Err(error);
                }
            }
        }
        self.content_in_turn(package, manifest, progress, cancel, turn).await
    }

    async fn content_in_turn(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
        turn: Arc<OwnedMutexGuard<()>>,
    ) -> Result<(), FetchError> {
        let content = package.content;
        pushed::hand_over(&self.data, content)
            .map_err(|source| FetchError::disk(&self.data.blob_parts(&content.digest), source))?;
        let result = self.pull_until_verified(package, manifest, progress, cancel, turn).await;
        match &result {
            Ok(()) => {
                self.offered.forget(&content.digest);
                self.given_up().remove(&content.digest);
            }
            // Nobody comes back for these bytes, or the disk is full and the ledger needs their
            // room.
            Err(error) if error.spoils_gathered() => self.discard(package)?,
            Err(_) => {}
        }
        result
    }

    /// Two tasks may share a content, and a pull that was dropped takes a moment to end.
    async fn turn(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<Arc<OwnedMutexGuard<()>>, FetchError> {
        let turn = cancel.run_until_cancelled(self.turns.take(package.content.digest)).await;
        turn.map(Arc::new).ok_or(FetchError::Cancelled)
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

    /// A blob that is held in memory, of at most `most` bytes: one that came with the order, or
    /// pulled.
    pub async fn small(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        most: u64,
        cancel: &CancellationToken,
    ) -> Result<Vec<u8>, FetchError> {
        if blob.size > most {
            return Err(FetchError::TooLarge { digest: blob.digest, size: blob.size, most });
        }
        if let Some(bytes) = self.offered.get(&blob) {
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
        turn: Arc<OwnedMutexGuard<()>>,
    ) -> Result<(), FetchError> {
        let src = self.src(package);
        if src.is_dir() {
            return self.discard(package);
        }
        let offset = self.present(package)?;
        progress.send_replace(Progress { done: offset, total: package.content.size });
        let need = Need::of(package, manifest, offset, self.settings().reserve_bytes);
        self.check_room(need)?;
        // Ask first: a replay for nothing each time the server is away would wear the disk out.
        let source = if offset == package.content.size {
            Source::Nothing
        } else if let Some(bytes) = self.offered.get(&package.content) {
            Source::Offered(bytes.slice(offset as usize..))
        } else {
            let answer = cancel.run_until_cancelled(self.download_content(package, offset)).await;
            Source::Download(Box::new(answer.ok_or(FetchError::Cancelled)??))
        };
        // Ends the blocking half even if this future is dropped while it replays.
        let stop = cancel.child_token();
        let _stop_on_drop = stop.clone().drop_guard();
        let (sender, receiver) = mpsc::channel(QUEUED_CHUNKS);
        let intake = Intake::new(self, package, offset, receiver, progress.clone(), stop, turn);
        let facts = manifest.content;
        let unpacking = tokio::task::spawn_blocking(move || intake.run(&facts, &src, need));
        let feeding = async {
            match source {
                Source::Download(download) => return self.feed(package, *download, sender).await,
                // Nobody takes them if the disk fails, which the blocking half knows better.
                Source::Offered(bytes) => drop(sender.send(bytes).await),
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

    /// Passes the content's bytes on, connecting anew after a cut. Ends early, and well, if nobody
    /// takes them.
    async fn feed(
        &self,
        package: &PackageRef,
        mut download: Download,
        sender: mpsc::Sender<Bytes>,
    ) -> Result<(), FetchError> {
        let mut cut = match self.pass_on(&mut download, &sender).await {
            Err(error) if error.is_cut() => error,
            ended => return ended,
        };
        let mut position = download.position();
        let mut reconnects = 0;
        while reconnects < MAX_RECONNECTS {
            reconnects += 1;
            tracing::info!(package = %package.name, position, %cut, "connecting anew");
            // A server that restarts cuts a whole fleet off at once.
            let longest = self.settings().reconnect_wait * reconnects;
            tokio::time::sleep(longest.mul_f64(rand::random())).await;
            let ended = match self.download_content(package, position).await {
                Ok(mut download) => {
                    let ended = self.pass_on(&mut download, &sender).await;
                    // On a network that cuts all the time it does get on.
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

    /// Passes on what one answer has, and measures it.
    async fn pass_on(
        &self,
        download: &mut Download,
        sender: &mpsc::Sender<Bytes>,
    ) -> Result<(), FetchError> {
        let from = download.position();
        let ended = download.pass_on(sender).await;
        self.meter.transferred(download.position() - from, download.asked_at().elapsed());
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

    /// Asks for a range of a blob, over a connection of its own.
    async fn download_range(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        range: Range<u64>,
    ) -> Result<Download, FetchError> {
        // Nothing is asked for after it.
        let request = || Ok(self.request(repository, blob)?.header(CONNECTION, "close"));
        self.start(request, repository, blob, range).await
    }

    /// Sends a request. That a blob is not to be had ends an order, and is believed once it was
    /// said twice: a byte that flips on its way to the server makes the digest another one.
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
        Ok(need.check(disk::room(root).map_err(|source| FetchError::disk(root, source))?)?)
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

    /// How many bytes of the content are there from earlier tries.
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

/// The package's task manifest if it was pulled before and is still there whole.
pub fn stored_manifest(data: &DataDir, package: &PackageRef) -> Option<TaskManifest> {
    // It lies among the task's own files, which the task may have exchanged.
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
