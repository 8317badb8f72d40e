//! Unfinished uploads. `uploads/<id>.<repository>` holds the received bytes; memory holds their
//! running SHA-256 hash. After a restart an upload resumes at the end of its file, and the server
//! hashes the file once all bytes are there. Bytes never become a blob before they hash to the
//! announced digest. Robots never take more than their share, and abandoned uploads never keep
//! others from pushing.

use std::collections::HashMap;
use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::{Stream, StreamExt as _};
use sha2::{Digest as _, Sha256, Sha512};
use task_proto::ids::digest::Algorithm;
use task_proto::packages::output::owner;
use task_proto::{Digest, RepositoryName, RobotId};
use tokio::sync::OwnedMutexGuard;

use super::{BlobError, BlobSettings, Blobs, modified_ms, on_disk};
use crate::system::data_directory::disk_space;

/// Bytes of a body that are gathered before one hash and one write.
const BATCH_BYTES: usize = 1024 * 1024;
/// Time limit for a silent sender in the middle of a body.
const IDLE_TIMEOUT: Duration = Duration::from_secs(60);
/// Uploads that one robot may leave unfinished. A robot sends one file after another and abandons
/// some on the way.
const MAX_OF_ROBOT: usize = 8;
const ID_DIGITS: usize = 32;
/// The first digits of an id, which tell the server of a cluster at which the upload began.
const MARK_DIGITS: usize = 8;
/// The longest file name that file systems accept, in bytes.
const MAX_NAME_BYTES: usize = 255;

/// The id of an upload.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct UploadId(String);

/// The text is not an upload id.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not a valid upload id")]
pub struct InvalidUploadId;

/// The mark of uploads that begin at the server with this name.
pub fn upload_mark(server: &str) -> u32 {
    let [a, b, c, d, ..] = Sha256::digest(server).0;
    u32::from_be_bytes([a, b, c, d])
}

impl UploadId {
    /// A random id with this mark; without one it is random too.
    fn random(mark: Option<u32>) -> Self {
        let id = Self(format!("{:0width$x}", rand::random::<u128>(), width = ID_DIGITS));
        match mark {
            Some(mark) => Self(format!("{mark:08x}{}", &id.0[MARK_DIGITS..])),
            None => id,
        }
    }

    /// The id's first digits: the mark of the server at which the upload began, if that was in a
    /// cluster.
    pub fn mark(&self) -> u32 {
        u32::from_str_radix(&self.0[..MARK_DIGITS], 16).unwrap_or_default()
    }

    /// The id as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for UploadId {
    type Err = InvalidUploadId;
    fn from_str(text: &str) -> Result<Self, InvalidUploadId> {
        let is_digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
        let valid = text.len() == ID_DIGITS && text.bytes().all(is_digit);
        if valid { Ok(Self(text.to_owned())) } else { Err(InvalidUploadId) }
    }
}

pub(super) struct Uploads {
    directory: PathBuf,
    settings: BlobSettings,
    active: Mutex<HashMap<UploadId, ActiveUpload>>,
}

/// An upload and its repository.
#[derive(Clone)]
struct ActiveUpload {
    repository: RepositoryName,
    upload: Arc<tokio::sync::Mutex<Upload>>,
    bytes: Arc<AtomicU64>,
}

impl ActiveUpload {
    fn new(repository: RepositoryName, upload: Upload) -> Self {
        let bytes = Arc::clone(&upload.bytes);
        Self { repository, upload: Arc::new(tokio::sync::Mutex::new(upload)), bytes }
    }
}

/// One upload. The holder of its lock is the only writer.
struct Upload {
    path: PathBuf,
    file: File,
    offset: u64,
    /// The offset again, readable without the lock.
    bytes: Arc<AtomicU64>,
    /// `None`: the upload began before the server started.
    hasher: Option<Sha256>,
    /// The time of the last write, or of the begin.
    written_at: Instant,
    /// Whether an earlier holder of the lock has finished or cancelled the upload.
    ended: bool,
}

impl Upload {
    fn create(path: PathBuf) -> io::Result<Self> {
        let file = File::create_new(&path)?;
        let (bytes, hasher, written_at) = (Arc::default(), Some(Sha256::new()), Instant::now());
        Ok(Self { path, file, offset: 0, bytes, hasher, written_at, ended: false })
    }

    /// Resumes an upload of an earlier process. The bytes were written in order, so all of them
    /// count. The final hash shows whether they are right.
    fn resume(path: PathBuf) -> io::Result<Self> {
        let file = File::options().write(true).open(&path)?;
        let offset = file.metadata()?.len();
        let (bytes, written_at) = (Arc::new(AtomicU64::new(offset)), Instant::now());
        Ok(Self { path, file, offset, bytes, hasher: None, written_at, ended: false })
    }

    /// Writes all of `chunks` or, on an error, none: the next try overwrites the bytes beyond the
    /// offset.
    fn write(&mut self, chunks: &[Bytes]) -> Result<(), BlobError> {
        let mut offset = self.offset;
        for chunk in chunks {
            self.file.write_all_at(chunk, offset).map_err(BlobError::disk("write", &self.path))?;
            offset += chunk.len() as u64;
        }
        if let Some(hasher) = &mut self.hasher {
            chunks.iter().for_each(|chunk| hasher.update(chunk));
        }
        self.offset = offset;
        self.written_at = Instant::now();
        self.bytes.store(offset, Ordering::Relaxed);
        Ok(())
    }

    /// The eviction order of uploads without an active writer: first those that were idle for
    /// [`IDLE_TIMEOUT`], empty ones before the rest, and then by the time of the last write, oldest
    /// first.
    fn eviction_order(&self) -> (bool, bool, Instant) {
        let is_idle = self.written_at.elapsed() >= IDLE_TIMEOUT;
        (!is_idle, is_idle && self.offset > 0, self.written_at)
    }

    fn cancel(&mut self) -> Result<(), BlobError> {
        self.ended = true;
        fs::remove_file(&self.path).map_err(BlobError::disk("delete", &self.path))
    }

    /// Checks that the bytes hash to `expected`, and syncs them.
    fn verify(&self, expected: Digest) -> Result<(), BlobError> {
        // A write that failed half way may have left bytes beyond the offset.
        self.file.set_len(self.offset).map_err(BlobError::disk("truncate", &self.path))?;
        let unreadable = BlobError::disk("read", &self.path);
        let actual = match (expected.algorithm(), &self.hasher) {
            (Algorithm::Sha256, Some(hasher)) => {
                Digest::from_sha256(hasher.clone().finalize().into())
            }
            (Algorithm::Sha256, None) => {
                Digest::from_sha256(hash::<Sha256>(&self.path).map_err(unreadable)?.into())
            }
            (Algorithm::Sha512, _) => {
                Digest::from_sha512(hash::<Sha512>(&self.path).map_err(unreadable)?.into())
            }
        };
        if actual != expected {
            return Err(BlobError::WrongDigest {
                expected: expected.into(),
                actual: actual.into(),
            });
        }
        self.file.sync_all().map_err(BlobError::disk("sync", &self.path))
    }
}

/// Hashes a file. This computes SHA-512 digests, which are rare, and the digest of a resumed
/// upload.
pub(super) fn hash<D: sha2::Digest>(path: &Path) -> io::Result<sha2::digest::Output<D>> {
    let (mut file, mut hasher, mut piece) = (File::open(path)?, D::new(), vec![0; BATCH_BYTES]);
    loop {
        match file.read(&mut piece)? {
            0 => return Ok(hasher.finalize()),
            count => hasher.update(&piece[..count]),
        }
    }
}

/// The name of an upload's file. If the repository's name leaves no room for the id, the file is
/// named by the id alone, and no restart resumes the upload.
fn file_name(id: &UploadId, repository: &RepositoryName) -> String {
    let name = format!("{}.{}", id.as_str(), repository.as_str().replace('/', "+"));
    if name.len() <= MAX_NAME_BYTES { name } else { id.as_str().to_owned() }
}

/// Parses the name of an upload's file.
fn parse_file_name(file_name: &OsStr) -> Option<(UploadId, RepositoryName)> {
    let (id, repository) = file_name.to_str()?.split_once('.')?;
    Some((id.parse().ok()?, repository.replace('+', "/").parse().ok()?))
}

impl Uploads {
    /// Opens the directory and resumes the unfinished uploads of an earlier process: the newest
    /// ones, up to the limit. Removes all other files in the directory.
    pub(super) fn open(directory: PathBuf, settings: BlobSettings) -> Result<Self, BlobError> {
        let resume = || {
            fs::create_dir_all(&directory)?;
            let mut left = Vec::new();
            for entry in fs::read_dir(&directory)? {
                let entry = entry?;
                match parse_file_name(&entry.file_name()) {
                    Some(upload) => {
                        left.push((entry.metadata()?.modified()?, entry.path(), upload))
                    }
                    None => fs::remove_file(entry.path())?,
                }
            }
            left.sort_by_key(|(modified, ..)| std::cmp::Reverse(*modified));
            for (_, path, _) in left.drain(settings.max_uploads.min(left.len())..) {
                fs::remove_file(path)?;
            }
            let resumed = left.into_iter().map(|(_, path, (id, repository))| {
                Ok((id, ActiveUpload::new(repository, Upload::resume(path)?)))
            });
            resumed.collect::<io::Result<HashMap<_, _>>>()
        };
        let active = resume().map_err(BlobError::disk("clean", &directory))?;
        Ok(Self { directory, settings, active: Mutex::new(active) })
    }

    /// A file name that is unused in the directory.
    pub(super) fn unused_path(&self) -> PathBuf {
        self.directory.join(UploadId::random(None).as_str())
    }

    fn active(&self) -> MutexGuard<'_, HashMap<UploadId, ActiveUpload>> {
        self.active.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds an upload. At the limit, the new upload replaces a person's upload without an active
    /// writer. That one is returned, and the caller cancels it.
    fn insert(
        &self,
        id: UploadId,
        active: ActiveUpload,
    ) -> Result<Option<OwnedMutexGuard<Upload>>, BlobError> {
        let max = self.settings.max_uploads;
        let mut all = self.active();
        if let Some((robot, _)) = owner(&active.repository) {
            // Independent of the number of robots, a quarter stays free for operators.
            let max_of_robots = max - max / 4;
            let robots: Vec<_> =
                all.values().filter_map(|other| owner(&other.repository)).collect();
            if robots.len() >= max_of_robots {
                return Err(BlobError::TooManyUploads { max: max_of_robots });
            }
            if robots.iter().filter(|(other, _)| *other == robot).count() >= MAX_OF_ROBOT {
                return Err(BlobError::TooManyUploads { max: MAX_OF_ROBOT });
            }
        }
        let mut left = None;
        if all.len() >= max {
            let (other, upload) =
                eviction_candidate(&all).ok_or(BlobError::TooManyUploads { max })?;
            all.remove(&other);
            left = Some(upload);
        }
        all.insert(id, active);
        Ok(left)
    }

    /// Checks that a robot may store `bytes` more; `stored_bytes` counts its stored bytes.
    fn check_robot_quota(
        &self,
        robot: &RobotId,
        bytes: u64,
        stored_bytes: u64,
    ) -> Result<(), BlobError> {
        let is_robots = |active: &&ActiveUpload| {
            owner(&active.repository).is_some_and(|(owner, _)| owner == *robot)
        };
        let unfinished: u64 =
            self.active().values().filter(is_robots).map(|a| a.bytes.load(Ordering::Relaxed)).sum();
        let (max, stored_bytes) = (
            self.settings.max_robot_bytes.saturating_mul(2),
            stored_bytes.saturating_add(unfinished),
        );
        if stored_bytes.saturating_add(bytes) > max {
            return Err(BlobError::RobotQuotaExceeded { max, stored_bytes });
        }
        self.check_reserve(bytes, self.settings.reserve_bytes.saturating_mul(2))
    }

    /// Checks that `bytes` more leave `reserve` bytes free on the disk.
    fn check_reserve(&self, bytes: u64, reserve: u64) -> Result<(), BlobError> {
        // If the free space is unknown, the disk is full when a write fails.
        match disk_space(&self.directory) {
            Some((free, _)) if bytes > 0 && free < reserve.saturating_add(bytes) => {
                Err(BlobError::DiskReserved { reserve })
            }
            _ => Ok(()),
        }
    }
}

/// The first upload in the eviction order among people's uploads without an active writer.
fn eviction_candidate(
    all: &HashMap<UploadId, ActiveUpload>,
) -> Option<(UploadId, OwnedMutexGuard<Upload>)> {
    let of_people = all.iter().filter(|(_, active)| owner(&active.repository).is_none());
    let left = of_people
        .filter_map(|(id, active)| Some((id, active.upload.clone().try_lock_owned().ok()?)));
    let (id, upload) = left.min_by_key(|(_, upload)| upload.eviction_order())?;
    Some((id.clone(), upload))
}

impl Blobs {
    /// Begins an upload. Only requests for the same repository can reach it.
    pub async fn begin_upload(&self, repository: &RepositoryName) -> Result<UploadId, BlobError> {
        let id = UploadId::random(self.shared.settings.upload_mark);
        let path = self.shared.uploads.directory.join(file_name(&id, repository));
        let created = Upload::create(path.clone()).map_err(BlobError::disk("create", &path))?;
        let active = ActiveUpload::new(repository.clone(), created);
        // Both removals are best effort: an upload that remains gets no more bytes, and the
        // collector drops it.
        match self.shared.uploads.insert(id.clone(), active) {
            Ok(None) => {}
            Ok(Some(mut left)) => drop(on_disk(move || left.cancel()).await),
            Err(refused) => {
                let _ = fs::remove_file(&path);
                return Err(refused);
            }
        }
        Ok(id)
    }

    /// The number of bytes that an upload has received.
    pub async fn upload_offset(
        &self,
        repository: &RepositoryName,
        id: &UploadId,
    ) -> Result<u64, BlobError> {
        Ok(self.lock_upload(repository, id)?.offset)
    }

    /// Checks that `bytes` more would be accepted. `stored_bytes` counts the stored bytes of the robot that
    /// owns the repository.
    pub fn check_space(
        &self,
        repository: &RepositoryName,
        bytes: u64,
        stored_bytes: u64,
    ) -> Result<(), BlobError> {
        let max = self.max_bytes_in(repository);
        if bytes > max {
            return Err(BlobError::TooLarge { max });
        }
        let uploads = &self.shared.uploads;
        match owner(repository) {
            Some((robot, _)) => uploads.check_robot_quota(&robot, bytes, stored_bytes),
            None => uploads.check_reserve(bytes, uploads.settings.reserve_bytes),
        }
    }

    /// Free disk space for people's uploads, in bytes.
    pub fn space_for_people(&self) -> u64 {
        let uploads = &self.shared.uploads;
        disk_space(&uploads.directory)
            .map_or(u64::MAX, |(free, _)| free.saturating_sub(uploads.settings.reserve_bytes))
    }

    /// The size limit of a blob in this repository.
    fn max_bytes_in(&self, repository: &RepositoryName) -> u64 {
        let BlobSettings { max_blob_bytes, max_robot_bytes, .. } = self.shared.settings;
        if owner(repository).is_some() {
            max_blob_bytes.min(max_robot_bytes)
        } else {
            max_blob_bytes
        }
    }

    /// Appends a body that begins at byte `start`, or at the upload's offset if that is absent.
    /// Bytes received before an error, or before the caller gave up, are kept, and the next chunk
    /// begins after them. The upload only ends if there is no room for the bytes. `stored_bytes` is as in
    /// [`Self::check_space`]. Returns the new offset.
    pub async fn append<S, E>(
        &self,
        repository: &RepositoryName,
        id: &UploadId,
        start: Option<u64>,
        body: S,
        stored_bytes: u64,
    ) -> Result<u64, BlobError>
    where
        S: Stream<Item = Result<Bytes, E>> + Send,
        E: Into<Box<dyn std::error::Error + Send + Sync>>,
    {
        let mut upload = self.lock_upload(repository, id)?;
        let offset = upload.offset;
        if let Some(given) = start.filter(|&given| given != offset) {
            return Err(BlobError::OutOfOrder { given, offset });
        }
        let max = self.max_bytes_in(repository);
        let mut body = std::pin::pin!(body);
        loop {
            let (chunks, ended) = read_batch(&mut body).await;
            let length: usize = chunks.iter().map(Bytes::len).sum();
            if length > 0 {
                let is_too_large = upload.offset + length as u64 > max;
                let space = if is_too_large {
                    Err(BlobError::TooLarge { max })
                } else {
                    self.check_space(repository, length as u64, stored_bytes)
                };
                // The lock travels with the work: if the caller is dropped here, the bytes still
                // count as one piece.
                let written = on_disk(move || {
                    let written = space.and_then(|()| upload.write(&chunks));
                    if written.as_ref().is_err_and(BlobError::is_out_of_space) {
                        // The partial upload would keep the disk full, for the database as well.
                        // Best effort.
                        let _ = upload.cancel();
                    }
                    written.map(|()| upload)
                });
                let written = written.await;
                if written.as_ref().is_err_and(BlobError::is_out_of_space) {
                    self.shared.uploads.active().remove(id);
                }
                upload = written?;
            }
            match ended {
                None => {}
                Some(Ok(())) => return Ok(upload.offset),
                Some(Err(error)) => return Err(error),
            }
        }
    }

    /// Makes the upload a blob if it hashes to `expected`, as of a pusher's request, and drops it
    /// otherwise. If the common store fails, the upload stays, so that the caller can try again.
    /// Returns the blob's size.
    pub async fn finish_upload(
        &self,
        repository: &RepositoryName,
        id: &UploadId,
        expected: Digest,
        now_ms: u64,
    ) -> Result<u64, BlobError> {
        let mut upload = self.lock_upload(repository, id)?;
        upload.ended = true;
        let verified = on_disk(move || {
            let verified = upload.verify(expected);
            Ok((upload, verified))
        });
        let (mut upload, verified) = verified.await?;
        let (path, bytes) = (upload.path.clone(), upload.offset);
        let stored = match verified {
            Ok(()) => self.store_file(expected, &path, bytes, now_ms).await,
            wrong => wrong,
        };
        if stored.as_ref().is_err_and(BlobError::is_store_unavailable) {
            upload.ended = false;
        } else {
            if stored.is_err() {
                // Best effort: the next start removes a file that remains.
                let _ = fs::remove_file(&path);
            }
            self.shared.uploads.active().remove(id);
        }
        stored.map(|()| bytes)
    }

    pub async fn cancel_upload(
        &self,
        repository: &RepositoryName,
        id: &UploadId,
    ) -> Result<(), BlobError> {
        let mut upload = self.lock_upload(repository, id)?;
        self.shared.uploads.active().remove(id);
        on_disk(move || upload.cancel()).await
    }

    /// Drops the uploads without a new byte since `before_ms`, and returns their number.
    pub async fn drop_idle_uploads(&self, before_ms: u64) -> Result<usize, BlobError> {
        let all: Vec<_> =
            self.shared.uploads.active().iter().map(|(id, a)| (id.clone(), a.clone())).collect();
        let mut dropped = 0;
        for (id, active) in all {
            // An active writer holds the lock: the upload is not idle, whatever the file's time
            // says.
            let Ok(mut upload) = active.upload.try_lock_owned() else { continue };
            let is_dropped = on_disk(move || {
                // The request that ended the upload was dropped before it could remove the entry.
                if upload.ended {
                    return Ok(true);
                }
                let metadata =
                    upload.file.metadata().map_err(BlobError::disk("inspect", &upload.path))?;
                let modified_ms =
                    modified_ms(&metadata).map_err(BlobError::disk("inspect", &upload.path))?;
                if modified_ms >= before_ms { Ok(false) } else { upload.cancel().map(|()| true) }
            });
            if is_dropped.await? {
                self.shared.uploads.active().remove(&id);
                dropped += 1;
            }
        }
        Ok(dropped)
    }

    /// Locks an upload for its only writer. A second writer is refused rather than queued: its
    /// chunk would be out of order anyway.
    fn lock_upload(
        &self,
        repository: &RepositoryName,
        id: &UploadId,
    ) -> Result<OwnedMutexGuard<Upload>, BlobError> {
        // Held until the end: the search for an upload to evict locks each one for a moment.
        let all = self.shared.uploads.active();
        let active = all
            .get(id)
            .filter(|active| active.repository == *repository)
            .ok_or(BlobError::UploadUnknown)?;
        let upload = active.upload.clone().try_lock_owned().map_err(|_| BlobError::UploadBusy)?;
        if upload.ended { Err(BlobError::UploadUnknown) } else { Ok(upload) }
    }
}

/// Takes chunks from a body until there are enough for one write. Reports the end of the body, and
/// its error.
async fn read_batch<S, E>(
    body: &mut std::pin::Pin<&mut S>,
) -> (Vec<Bytes>, Option<Result<(), BlobError>>)
where
    S: Stream<Item = Result<Bytes, E>> + Send,
    E: Into<Box<dyn std::error::Error + Send + Sync>>,
{
    let mut chunks = Vec::new();
    let mut length = 0;
    while length < BATCH_BYTES {
        match tokio::time::timeout(IDLE_TIMEOUT, body.next()).await {
            Ok(Some(Ok(chunk))) => {
                length += chunk.len();
                chunks.push(chunk);
            }
            Ok(Some(Err(error))) => {
                return (chunks, Some(Err(BlobError::Interrupted(error.into()))));
            }
            Ok(None) => return (chunks, Some(Ok(()))),
            Err(elapsed) => return (chunks, Some(Err(BlobError::Interrupted(elapsed.into())))),
        }
    }
    (chunks, None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::BlobRead;

    #[tokio::test]
    async fn full_disk_ends_the_upload_and_frees_its_space() {
        let directory = tempfile::tempdir().expect("a directory");
        let settings = BlobSettings { reading: BlobRead::Pread, ..BlobSettings::default() };
        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        let repository: RepositoryName = "talker".parse().expect("a name");
        let body = |bytes: &'static [u8]| {
            futures_util::stream::iter([Ok::<_, io::Error>(Bytes::from_static(bytes))])
        };
        let id = blobs.begin_upload(&repository).await.expect("begins");
        blobs.append(&repository, &id, None, body(b"some"), 0).await.expect("there is room");
        let full = File::options().write(true).open("/dev/full").expect("Linux has it");
        blobs.lock_upload(&repository, &id).expect("no writer").file = full;
        let refused = blobs.append(&repository, &id, None, body(b"more"), 0).await;
        assert!(matches!(refused, Err(BlobError::DiskFull)), "{refused:?}");
        let gone = blobs.upload_offset(&repository, &id).await;
        assert!(matches!(gone, Err(BlobError::UploadUnknown)), "{gone:?}");
        assert_eq!(fs::read_dir(&blobs.shared.uploads.directory).expect("there").count(), 0);
    }

    #[tokio::test]
    async fn unfinished_uploads_resume_after_a_restart_within_their_limits() {
        let directory = tempfile::tempdir().expect("a directory");
        let settings = BlobSettings { max_uploads: 3, ..BlobSettings::default() };
        let body = |bytes: &'static [u8]| {
            futures_util::stream::iter([Ok::<_, io::Error>(Bytes::from_static(bytes))])
        };
        let (repository, other): (RepositoryName, RepositoryName) =
            ("lab/talker".parse().expect("a name"), "lab/other".parse().expect("a name"));
        let long: RepositoryName = ["a"; 128].join("/").parse().expect("a name");
        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        let id = blobs.begin_upload(&repository).await.expect("begins");
        let forgotten = blobs.begin_upload(&long).await.expect("begins");
        blobs.append(&repository, &id, None, body(b"some"), 0).await.expect("there is room");
        let uploads = directory.path().join("uploads");
        fs::write(uploads.join("0123456789abcdef0123456789abcdef"), "left by a write")
            .expect("written");
        drop(blobs);

        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        assert_eq!(fs::read_dir(&uploads).expect("there").count(), 1);
        for (repository, id) in [(&other, &id), (&long, &forgotten)] {
            let unknown = blobs.upload_offset(repository, id).await;
            assert!(matches!(unknown, Err(BlobError::UploadUnknown)), "{unknown:?}");
        }
        assert_eq!(blobs.upload_offset(&repository, &id).await.expect("there"), 4);
        assert_eq!(
            blobs.append(&repository, &id, Some(4), body(b"more"), 0).await.expect("goes on"),
            8
        );
        let (right, wrong) = (Digest::of(b"somemore"), Digest::of(b"something"));
        assert_eq!(blobs.finish_upload(&repository, &id, right, 0).await.expect("it is whole"), 8);
        assert!(blobs.get(right).await.expect("read").is_some());

        // Bytes that a power cut left wrong never become a blob.
        let id = blobs.begin_upload(&repository).await.expect("begins");
        blobs.append(&repository, &id, None, body(b"somethinh"), 0).await.expect("there is room");
        for _ in 0..2 {
            blobs.begin_upload(&repository).await.expect("begins");
        }
        drop(blobs);
        let few = BlobSettings { max_uploads: 2, ..settings };
        assert_eq!(
            Blobs::open(directory.path(), few).expect("opens").shared.uploads.active().len(),
            2
        );
        assert_eq!(fs::read_dir(&uploads).expect("there").count(), 2);
        for entry in fs::read_dir(&uploads).expect("there") {
            fs::remove_file(entry.expect("an entry").path()).expect("removed");
        }
        fs::write(uploads.join(file_name(&id, &repository)), "somethinh").expect("written");
        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        let refused = blobs.finish_upload(&repository, &id, wrong, 0).await;
        assert!(matches!(refused, Err(BlobError::WrongDigest { .. })), "{refused:?}");
    }

    #[tokio::test]
    async fn robots_uploads_leave_twice_the_disk_reserve() {
        let directory = tempfile::tempdir().expect("a directory");
        let (free, _) = disk_space(directory.path()).expect("a disk");
        let settings = BlobSettings { reserve_bytes: free / 3 * 2, ..BlobSettings::default() };
        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        let push = async |repository: &str| {
            let repository: RepositoryName = repository.parse().expect("a name");
            let id = blobs.begin_upload(&repository).await.expect("begins");
            let body =
                futures_util::stream::iter([Ok::<_, io::Error>(Bytes::from_static(b"some"))]);
            blobs.append(&repository, &id, None, body, 0).await
        };
        let refused = push("outputs/r00000000000000a1/mapping").await;
        assert!(matches!(refused, Err(BlobError::DiskReserved { .. })), "{refused:?}");
        assert_eq!(push("talker").await.expect("there is room"), 4);
    }

    #[tokio::test]
    async fn peoples_uploads_leave_the_disk_reserve() {
        let directory = tempfile::tempdir().expect("a directory");
        let settings = BlobSettings { reserve_bytes: 1 << 60, ..BlobSettings::default() };
        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        let repository: RepositoryName = "talker".parse().expect("a name");
        let id = blobs.begin_upload(&repository).await.expect("begins");
        let body = futures_util::stream::iter([Ok::<_, io::Error>(Bytes::from_static(b"some"))]);
        let refused = blobs.append(&repository, &id, None, body, 0).await.expect_err("refused");
        assert!(refused.to_string().contains("(disk_reserve)"), "{refused}");
        assert_eq!(blobs.space_for_people(), 0);
        assert_eq!(
            fs::read_dir(&blobs.shared.uploads.directory).expect("there").count(),
            0,
            "the upload ends"
        );
    }

    #[tokio::test]
    async fn robots_uploads_are_limited_per_robot_and_in_total() {
        let directory = tempfile::tempdir().expect("a directory");
        let settings = BlobSettings { max_uploads: 2 * MAX_OF_ROBOT, ..BlobSettings::default() };
        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        let [first, second] =
            ["outputs/r00000000000000a1/mapping", "outputs/r00000000000000a2/mapping"];
        let begun = async |repository: &str, count: usize| {
            let repository: RepositoryName = repository.parse().expect("a name");
            let mut begun = 0;
            for _ in 0..count {
                begun += usize::from(blobs.begin_upload(&repository).await.is_ok());
            }
            begun
        };
        assert_eq!(begun(first, MAX_OF_ROBOT + 1).await, MAX_OF_ROBOT);
        assert_eq!(begun(second, MAX_OF_ROBOT).await, MAX_OF_ROBOT / 2, "a quarter stays free");
        assert_eq!(
            begun("talker", MAX_OF_ROBOT).await,
            MAX_OF_ROBOT,
            "people's give way to people's"
        );
        let is_peoples = |active: &&ActiveUpload| owner(&active.repository).is_none();
        assert_eq!(
            blobs.shared.uploads.active().values().filter(is_peoples).count(),
            MAX_OF_ROBOT / 2
        );
    }

    #[tokio::test]
    async fn idle_uploads_of_people_do_not_block_robots() {
        let directory = tempfile::tempdir().expect("a directory");
        let settings = BlobSettings { max_uploads: 4, ..BlobSettings::default() };
        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        let begin =
            async |repository: &str| blobs.begin_upload(&repository.parse().expect("a name")).await;
        for _ in 0..4 {
            begin("talker").await.expect("begins");
        }
        for _ in 0..3 {
            begin("outputs/r00000000000000a1/mapping").await.expect("begins");
        }
        let refused = begin("outputs/r00000000000000a1/mapping").await;
        assert!(matches!(refused, Err(BlobError::TooManyUploads { max: 3 })), "{refused:?}");
    }

    #[tokio::test]
    async fn idle_upload_is_evicted_and_an_active_one_is_not() {
        let directory = tempfile::tempdir().expect("a directory");
        let settings = BlobSettings { max_uploads: 3, ..BlobSettings::default() };
        let blobs = Blobs::open(directory.path(), settings).expect("opens");
        let repository: RepositoryName = "talker".parse().expect("a name");
        let begin = async || blobs.begin_upload(&repository).await;
        let mut ids = vec![begin().await.expect("begins")];
        let body = futures_util::stream::iter([Ok::<_, io::Error>(Bytes::from_static(b"some"))]);
        blobs.append(&repository, &ids[0], None, body, 0).await.expect("there is room");
        ids.push(begin().await.expect("begins"));
        for id in &ids {
            blobs.lock_upload(&repository, id).expect("there").written_at -= IDLE_TIMEOUT;
        }
        // The empty upload is evicted first, then the one with bytes, and only then the recent one.
        for gone in [None, Some(1), Some(0), Some(2)] {
            ids.push(begin().await.expect("begins"));
            let there: Vec<bool> =
                ids.iter().map(|id| blobs.lock_upload(&repository, id).is_ok()).collect();
            assert!(gone.is_none_or(|gone: usize| !there[gone]), "{there:?}");
            assert_eq!(there.iter().filter(|there| **there).count(), 3, "{there:?}");
        }
        let writing: Vec<_> =
            ids[3..].iter().map(|id| blobs.lock_upload(&repository, id).expect("there")).collect();
        let refused = begin().await;
        assert!(matches!(refused, Err(BlobError::TooManyUploads { max: 3 })), "{refused:?}");
        drop(writing);
        assert_eq!(fs::read_dir(&blobs.shared.uploads.directory).expect("there").count(), 3);
    }
}
