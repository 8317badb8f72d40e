//! Collects a content that the server pushes as parts over MQTT, until it is complete or a pull is
//! the better choice. Parts go into a sparse file. A note beside the file lists the parts on the
//! disk, so that a restarted agent resumes from there.
//!
//! Parts are untrusted. Each must fit the size that the signed state names, and the first part
//! determines the part size. The intake of a pull checks the complete content against its digest.
//! Parts that do not fit are counted and ignored; torn or wrong bytes fail the digest check and are
//! pulled.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use task_proto::Digest;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::messages::part::{HEADER_BYTES, Part, PartLayout, PartRange};
use task_proto::messages::report::Progress;
use tokio::sync::{OwnedMutexGuard, watch};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::part_map::PartMap;
use super::{FetchError, Fetcher};
use crate::system::durable;
use crate::system::layout::DataDir;
use crate::transfer::parts::PartRequest;
use crate::transfer::parts::{PartReceiver, ReceivedPart, SubscriptionState};

/// Largest note: its header and one bit per part, for the most parts that a blob may have.
const MAX_NOTE_BYTES: u64 = 256 * 1024;
/// Most parts written in one batch.
const BATCH_PARTS: usize = 4;
/// A note is written after this many new bytes, or after [`NOTE_INTERVAL`].
const NOTE_INTERVAL_BYTES: u64 = 16 << 20;
const NOTE_INTERVAL: Duration = Duration::from_secs(5);
/// Delay after which parts that have arrived are removed from the request for missing parts.
const TRIM_DELAY: Duration = Duration::from_millis(100);

/// Timeouts for pushed parts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PartTimeouts {
    /// After this long without a part, the missing parts are requested. The timeout then doubles.
    pub silence: Duration,
    /// After this long without a subscription, the content is pulled.
    pub no_subscription: Duration,
    /// After this long without a new part, the content is pulled.
    pub no_progress: Duration,
}

impl Default for PartTimeouts {
    fn default() -> Self {
        Self {
            silence: Duration::from_secs(2),
            no_subscription: Duration::from_secs(10),
            no_progress: Duration::from_secs(30),
        }
    }
}

/// Reasons to pull a content that the server pushes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum PullReason {
    #[error("there is no MQTT session")]
    NoSession,
    #[error("no subscription to its parts for {} s", .0.as_secs())]
    NoSubscription(Duration),
    #[error("no part arrived for {} s", .0.as_secs())]
    NoProgress(Duration),
    #[error("another pull subscribed to its parts")]
    Replaced,
}

/// The files in which parts are collected.
#[derive(Clone)]
struct PartFiles {
    part: PathBuf,
    parts: PathBuf,
    note: PathBuf,
}

pub(super) struct PartCollector<'a> {
    content: BlobRef,
    files: PartFiles,
    file: Arc<File>,
    /// `None` until a part has shown the part size.
    map: Option<PartMap>,
    /// Whether this agent process has received a part. An earlier process may have received others.
    is_cut: bool,
    timeouts: PartTimeouts,
    progress: &'a watch::Sender<Progress>,
    part_requests: &'a watch::Sender<PartRequest>,
    /// Lock on the content, held until all work has ended, including writes that outlive this
    /// struct.
    lock: Arc<OwnedMutexGuard<()>>,
    /// Counts messages that were not parts of this content, and duplicate parts.
    foreign: u64,
    duplicate: u64,
    noted_bytes: u64,
    noted_at: Instant,
    /// The note being written. Parts are accepted meanwhile: the server would judge a robot that
    /// does not acknowledge as too slow.
    note_write: Option<JoinHandle<io::Result<()>>>,
}

/// Times of the latest events.
struct Times {
    /// Time of the last part of this content, new or duplicate, of the subscription, or of the last
    /// request for missing parts, whichever is latest.
    quiet_since: Instant,
    /// Silence after which missing parts are requested next.
    silence: Duration,
    /// Time of the last new part, or of the subscription.
    last_progress_at: Instant,
    /// `Some` while the subscription is missing.
    unsubscribed_since: Option<Instant>,
    /// Whether this subscription has not delivered a part yet.
    is_fresh: bool,
    /// Time of the first part since the last update of the request for missing parts.
    first_arrival_at: Option<Instant>,
}

impl<'a> PartCollector<'a> {
    /// Opens the parts and the note that earlier attempts left.
    pub(super) fn open(
        fetcher: &Fetcher,
        package: &PackageRef,
        progress: &'a watch::Sender<Progress>,
        part_requests: &'a watch::Sender<PartRequest>,
        lock: Arc<OwnedMutexGuard<()>>,
    ) -> Result<Self, FetchError> {
        let content = package.content;
        let files = PartFiles::of(&fetcher.data, &content.digest);
        let failed = |source| FetchError::disk(&files.parts, source);
        let (file, map) = files.open(content.size).map_err(failed)?;
        Ok(Self {
            content,
            file: Arc::new(file),
            map,
            is_cut: false,
            files,
            timeouts: fetcher.settings().parts,
            progress,
            part_requests,
            lock,
            foreign: 0,
            duplicate: 0,
            noted_bytes: 0,
            noted_at: Instant::now(),
            note_write: None,
        })
    }

    /// Collects parts until the content is complete and in the file that a pull reads, or until a
    /// pull is the better choice.
    pub(super) async fn run(
        mut self,
        mut part_receiver: PartReceiver,
        cancel: &CancellationToken,
    ) -> Result<Result<(), PullReason>, FetchError> {
        self.noted_bytes = self.bytes();
        self.report_progress();
        let ended = tokio::select! {
            ended = self.collect(&mut part_receiver) => ended,
            () = cancel.cancelled() => Err(FetchError::Cancelled),
        };
        self.part_requests.send_modify(|part_requests| part_requests.missing = None);
        if self.foreign > 0 || self.duplicate > 0 {
            let foreign = self.foreign;
            let duplicate = self.duplicate;
            let digest = self.content.digest;
            tracing::info!(%digest, foreign, duplicate, "ignored messages on the topic of a content");
        }
        match ended {
            Ok(Ok(())) => {
                self.finish_note().await?;
                let files = self.files.clone();
                let lock = self.lock.clone();
                on_disk(&self.files.parts, move || files.whole().map(|()| drop(lock))).await?;
            }
            Ok(Err(_)) | Err(FetchError::Cancelled) => {
                self.finish_note().await?;
                self.begin_note();
                self.finish_note().await?;
            }
            Err(_) => {}
        }
        ended
    }

    async fn collect(
        &mut self,
        part_receiver: &mut PartReceiver,
    ) -> Result<Result<(), PullReason>, FetchError> {
        let now = Instant::now();
        let mut times = Times {
            quiet_since: now,
            silence: self.timeouts.silence,
            last_progress_at: now,
            unsubscribed_since: Some(now),
            is_fresh: true,
            first_arrival_at: None,
        };
        if self.map.as_ref().is_some_and(PartMap::is_whole) {
            return Ok(Ok(()));
        }
        if *part_receiver.subscription_state.borrow_and_update() == SubscriptionState::Disconnected
        {
            return Ok(Err(PullReason::NoSession));
        }
        self.update_subscription(*part_receiver.subscription_state.borrow(), &mut times);
        let mut batch = Vec::with_capacity(BATCH_PARTS);
        loop {
            tokio::select! {
                // Cancel-safe: a message stays in the channel until received.
                count = part_receiver.parts.recv_many(&mut batch, BATCH_PARTS) => {
                    if count == 0 {
                        return Ok(Err(PullReason::Replaced));
                    }
                    self.write_batch(std::mem::take(&mut batch), &mut times).await?;
                    if self.map.as_ref().is_some_and(PartMap::is_whole) {
                        return Ok(Ok(()));
                    }
                }
                // Cancel-safe: a watch remembers a change.
                Ok(()) = part_receiver.subscription_state.changed() => self.update_subscription(*part_receiver.subscription_state.borrow_and_update(), &mut times),
                // Cancel-safe: the timer is recreated on each iteration.
                () = tokio::time::sleep_until(self.next_deadline(&times)) => {
                    if let Some(reason) = self.check_deadlines(&mut times) {
                        return Ok(Err(reason));
                    }
                }
            }
        }
    }

    /// Takes messages from the session, writes the valid parts, and drops the messages, which
    /// acknowledges them.
    async fn write_batch(
        &mut self,
        batch: Vec<ReceivedPart>,
        times: &mut Times,
    ) -> Result<(), FetchError> {
        let now = Instant::now();
        let mut writes = Vec::with_capacity(batch.len());
        for part in batch {
            let Some((index, from)) = self.validate(&part.message) else { continue };
            times.quiet_since = now;
            times.silence = self.timeouts.silence;
            let Some(map) = &mut self.map else { continue };
            if std::mem::take(&mut times.is_fresh) && map.request_below(index) {
                // The subscription came late: parts published earlier are sent again only on
                // request.
                self.request_missing();
            }
            let is_present = self.map.as_ref().is_some_and(|map| map.has(index));
            if is_present { self.duplicate += 1 } else { writes.push((index, from, part)) }
        }
        if writes.is_empty() {
            return Ok(());
        }
        let file = self.file.clone();
        let lock = self.lock.clone();
        let written = on_disk(&self.files.parts, move || {
            for (_, from, part) in &writes {
                file.write_all_at(&part.message[HEADER_BYTES..], *from)?;
            }
            drop(lock);
            Ok(writes)
        })
        .await?;
        let Some(map) = &mut self.map else { return Ok(()) };
        for (index, ..) in &written {
            // A batch may hold the same part twice.
            self.duplicate += u64::from(!map.take(*index));
        }
        times.last_progress_at = now;
        self.report_progress();
        times.first_arrival_at.get_or_insert(now);
        let due = self.bytes() - self.noted_bytes >= NOTE_INTERVAL_BYTES
            || self.noted_at.elapsed() >= NOTE_INTERVAL;
        if due && self.note_write.as_ref().is_none_or(JoinHandle::is_finished) {
            self.finish_note().await?;
            self.begin_note();
        }
        Ok(())
    }

    /// Index and offset of a part. `None` if the message is not a part of this content with the
    /// known part size.
    fn validate(&mut self, message: &[u8]) -> Option<(u32, u64)> {
        let fits = Part::decode(message, self.content.size).and_then(|part| {
            let cut = PartLayout::new(self.content.size, part.part_bytes)?;
            Ok((part.index, cut))
        });
        let (index, cut) = match fits {
            Ok(fits) => fits,
            Err(error) => {
                if self.foreign == 0 {
                    tracing::warn!(digest = %self.content.digest, %error, "ignored a message that is not a part of the content");
                }
                self.foreign += 1;
                return None;
            }
        };
        match &self.map {
            Some(map) if map.cut() == cut => {}
            Some(_) if self.is_cut => {
                self.foreign += 1;
                return None;
            }
            // The part size may differ from the one that an earlier agent process saw.
            earlier => {
                self.map = Some(PartMap::new(cut, earlier.as_ref().map_or(0, PartMap::prefix)))
            }
        }
        self.is_cut = true;
        Some((index, cut.range(index).start))
    }

    fn update_subscription(&mut self, subscription_state: SubscriptionState, times: &mut Times) {
        let now = Instant::now();
        match subscription_state {
            SubscriptionState::Active => {
                (times.quiet_since, times.last_progress_at, times.unsubscribed_since) =
                    (now, now, None);
                (times.silence, times.is_fresh) = (self.timeouts.silence, true);
                if let Some(map) = &mut self.map {
                    map.clear_request();
                }
                self.part_requests.send_modify(|part_requests| {
                    *part_requests =
                        PartRequest { missing: Some(Vec::new()), times: part_requests.times + 1 }
                });
            }
            SubscriptionState::Pending
            | SubscriptionState::Refused
            | SubscriptionState::Disconnected => {
                times.unsubscribed_since.get_or_insert(now);
                self.part_requests
                    .send_if_modified(|part_requests| part_requests.missing.take().is_some());
            }
        }
    }

    fn next_deadline(&self, times: &Times) -> Instant {
        let next = match times.unsubscribed_since {
            Some(since) => since + self.timeouts.no_subscription,
            None => (times.quiet_since + times.silence)
                .min(times.last_progress_at + self.timeouts.no_progress),
        };
        times.first_arrival_at.map_or(next, |at| next.min(at + TRIM_DELAY))
    }

    /// Requests the missing parts, or gives up.
    fn check_deadlines(&mut self, times: &mut Times) -> Option<PullReason> {
        let now = Instant::now();
        if times.first_arrival_at.take_if(|at| now >= *at + TRIM_DELAY).is_some() {
            self.trim_request();
        }
        if let Some(since) = times.unsubscribed_since {
            return (now >= since + self.timeouts.no_subscription)
                .then_some(PullReason::NoSubscription(self.timeouts.no_subscription));
        }
        if now >= times.last_progress_at + self.timeouts.no_progress {
            return Some(PullReason::NoProgress(self.timeouts.no_progress));
        }
        if now >= times.quiet_since + times.silence {
            times.quiet_since = now;
            times.silence *= 2;
            if let Some(map) = &mut self.map {
                map.request_below(u32::MAX);
            }
            self.request_missing();
        }
        None
    }

    fn request_missing(&self) {
        let missing = match &self.map {
            Some(map) => map.requested(),
            // The number of parts is still unknown.
            None => vec![PartRange { from: 0, to: u32::MAX }],
        };
        self.part_requests.send_modify(|part_requests| {
            *part_requests = PartRequest { missing: Some(missing), times: part_requests.times + 1 }
        });
    }

    /// Removes the parts that have arrived from the request, so that a report sent for another
    /// reason does not request them again.
    fn trim_request(&self) {
        let requested = |part_requests: &PartRequest| {
            part_requests.missing.as_ref().is_some_and(|missing| !missing.is_empty())
        };
        if let Some(map) = self.map.as_ref().filter(|_| requested(&self.part_requests.borrow())) {
            self.part_requests
                .send_modify(|part_requests| part_requests.missing = Some(map.requested()));
        }
    }

    /// Number of bytes received.
    pub(super) fn bytes(&self) -> u64 {
        self.map.as_ref().map_or(0, PartMap::bytes)
    }

    fn report_progress(&self) {
        self.progress.send_replace(Progress { done: self.bytes(), total: self.content.size });
    }

    /// Starts to sync the received parts to the disk and then to write the note.
    fn begin_note(&mut self) {
        let Some(map) = &self.map else { return };
        let note = map.note();
        let file = self.file.clone();
        let path = self.files.note.clone();
        let lock = self.lock.clone();
        (self.noted_bytes, self.noted_at) = (map.bytes(), Instant::now());
        self.note_write = Some(tokio::task::spawn_blocking(move || {
            file.sync_data()?;
            durable::write(&path, &note, 0o600).map(|()| drop(lock))
        }));
    }

    /// Waits until the current note is written.
    async fn finish_note(&mut self) -> Result<(), FetchError> {
        match self.note_write.take() {
            Some(note_write) => finished(&self.files.note, note_write).await,
            None => Ok(()),
        }
    }
}

/// Runs blocking disk work on a blocking thread.
pub(super) async fn on_disk<T: Send + 'static>(
    path: &Path,
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> Result<T, FetchError> {
    finished(path, tokio::task::spawn_blocking(work)).await
}

async fn finished<T>(path: &Path, work: JoinHandle<io::Result<T>>) -> Result<T, FetchError> {
    let done = work.await.map_err(io::Error::other);
    done.flatten().map_err(|source| FetchError::disk(path, source))
}

/// Turns the parts up to the first gap into the `.part` that a pull resumes from, if they are more
/// than the `.part` already holds.
pub(super) fn convert_to_part(data: &DataDir, content: BlobRef) -> io::Result<()> {
    let files = PartFiles::of(data, &content.digest);
    let Some(map) = files.read_note(content.size) else { return files.discard() };
    let prefix = map.prefix();
    let pulled = fs::metadata(&files.part).map_or(0, |metadata| metadata.len());
    if prefix <= pulled {
        return files.discard();
    }
    // The file is ignored without its note. From here on no reader takes the holes for data.
    durable::remove_file(&files.note)?;
    OpenOptions::new().write(true).open(&files.parts)?.set_len(prefix)?;
    durable::rename(&files.parts, &files.part)
}

/// Deletes the collected parts of a content.
pub(super) fn discard(data: &DataDir, content: &Digest) -> io::Result<()> {
    PartFiles::of(data, content).discard()
}

impl PartFiles {
    fn of(data: &DataDir, digest: &Digest) -> Self {
        Self {
            part: data.blob_part(digest),
            parts: data.blob_parts(digest),
            note: data.blob_parts_note(digest),
        }
    }

    /// Returns the file and the map of parts in its note. Without a note the file is new and empty.
    fn open(&self, size: u64) -> io::Result<(File, Option<PartMap>)> {
        if let Some(map) = self.read_note(size) {
            return Ok((OpenOptions::new().write(true).open(&self.parts)?, Some(map)));
        }
        self.discard()?;
        if let Some(parent) = self.parts.parent() {
            durable::create_dir_all(parent)?;
        }
        let file = OpenOptions::new().write(true).create_new(true).open(&self.parts)?;
        file.set_len(size)?;
        Ok((file, None))
    }

    /// Reads the note if it fits the file.
    fn read_note(&self, size: u64) -> Option<PartMap> {
        let is_small =
            fs::metadata(&self.note).is_ok_and(|metadata| metadata.len() <= MAX_NOTE_BYTES);
        let is_of_file = fs::metadata(&self.parts).is_ok_and(|metadata| metadata.len() == size);
        if is_small && is_of_file {
            PartMap::of_note(&fs::read(&self.note).ok()?, size)
        } else {
            None
        }
    }

    /// Makes the complete file the `.part` that a pull reads.
    fn whole(&self) -> io::Result<()> {
        durable::remove_file(&self.note)?;
        durable::rename(&self.parts, &self.part)
    }

    fn discard(&self) -> io::Result<()> {
        durable::remove_file(&self.note)?;
        durable::remove_file(&self.parts)
    }
}
