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
use task_proto::part::{Cut, HEADER_BYTES, Part, PartRange};
use task_proto::report::Progress;
use tokio::sync::{OwnedMutexGuard, watch};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::part_map::PartMap;
use super::{FetchError, Fetcher};
use crate::system::durable;
use crate::system::layout::DataDir;
use crate::transfer::parts::Asks;
use crate::transfer::parts::{Arrived, Ear, Hearing};

/// Largest note: its header and one bit per part, for the most parts that a blob may have.
const MAX_NOTE_BYTES: u64 = 256 * 1024;
/// Most parts written in one batch.
const WRITTEN_TOGETHER: usize = 4;
/// A note is written after this many new bytes, or after [`NOTED_AFTER`].
const NOTED_BYTES: u64 = 16 << 20;
const NOTED_AFTER: Duration = Duration::from_secs(5);
/// Delay after which parts that have arrived are removed from the request for missing parts.
const TAKEN_BACK_AFTER: Duration = Duration::from_millis(100);

/// Timeouts for pushed parts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PartPatience {
    /// After this long without a part, the missing parts are requested. The timeout then doubles.
    pub silence: Duration,
    /// After this long without a subscription, the content is pulled.
    pub deaf: Duration,
    /// After this long without a new part, the content is pulled.
    pub starved: Duration,
}

impl Default for PartPatience {
    fn default() -> Self {
        Self {
            silence: Duration::from_secs(2),
            deaf: Duration::from_secs(10),
            starved: Duration::from_secs(30),
        }
    }
}

/// Reasons to pull a content that the server pushes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum GaveUp {
    #[error("there is no MQTT session")]
    NoSession,
    #[error("for {} s there was no subscription to its parts", .0.as_secs())]
    Deaf(Duration),
    #[error("for {} s no part of it came", .0.as_secs())]
    Starved(Duration),
    #[error("another pull listens to its parts")]
    Replaced,
}

/// The files in which parts are collected.
#[derive(Clone)]
struct Files {
    part: PathBuf,
    parts: PathBuf,
    note: PathBuf,
}

pub(super) struct Gathering<'a> {
    content: BlobRef,
    files: Files,
    file: Arc<File>,
    /// `None` until a part has shown the part size.
    map: Option<PartMap>,
    /// Whether this agent process has received a part. An earlier process may have received others.
    is_cut: bool,
    patience: PartPatience,
    progress: &'a watch::Sender<Progress>,
    asks: &'a watch::Sender<Asks>,
    /// Lock on the content, held until all work has ended, including writes that outlive this
    /// struct.
    turn: Arc<OwnedMutexGuard<()>>,
    /// Counts messages that were not parts of this content, and duplicate parts.
    foreign: u64,
    double: u64,
    noted_bytes: u64,
    noted_at: Instant,
    /// The note being written. Parts are accepted meanwhile: the server would judge a robot that
    /// does not acknowledge as too slow.
    noting: Option<JoinHandle<io::Result<()>>>,
}

/// Times of the latest events.
struct Times {
    /// Time of the last part of this content, new or duplicate, of the subscription, or of the last
    /// request for missing parts, whichever is latest.
    quiet_since: Instant,
    /// Silence after which missing parts are requested next.
    silence: Duration,
    /// Time of the last new part, or of the subscription.
    starved_since: Instant,
    /// `Some` while the subscription is missing.
    deaf_since: Option<Instant>,
    /// Whether this subscription has not delivered a part yet.
    is_fresh: bool,
    /// Time of the first part since the last update of the request for missing parts.
    came_at: Option<Instant>,
}

impl<'a> Gathering<'a> {
    /// Opens the parts and the note that earlier attempts left.
    pub(super) fn open(
        fetcher: &Fetcher,
        package: &PackageRef,
        progress: &'a watch::Sender<Progress>,
        asks: &'a watch::Sender<Asks>,
        turn: Arc<OwnedMutexGuard<()>>,
    ) -> Result<Self, FetchError> {
        let content = package.content;
        let files = Files::of(&fetcher.data, &content.digest);
        let failed = |source| FetchError::disk(&files.parts, source);
        let (file, map) = files.open(content.size).map_err(failed)?;
        Ok(Self {
            content,
            file: Arc::new(file),
            map,
            is_cut: false,
            files,
            patience: fetcher.settings().parts,
            progress,
            asks,
            turn,
            foreign: 0,
            double: 0,
            noted_bytes: 0,
            noted_at: Instant::now(),
            noting: None,
        })
    }

    /// Collects parts until the content is complete and in the file that a pull reads, or until a
    /// pull is the better choice.
    pub(super) async fn run(
        mut self,
        mut ear: Ear,
        cancel: &CancellationToken,
    ) -> Result<Result<(), GaveUp>, FetchError> {
        self.noted_bytes = self.bytes();
        self.tell_progress();
        let ended = tokio::select! {
            ended = self.gather(&mut ear) => ended,
            () = cancel.cancelled() => Err(FetchError::Cancelled),
        };
        self.asks.send_modify(|asks| asks.missing = None);
        if self.foreign > 0 || self.double > 0 {
            let (foreign, double, digest) = (self.foreign, self.double, self.content.digest);
            tracing::info!(%digest, foreign, double, "messages on its topic that were of no use");
        }
        match ended {
            Ok(Ok(())) => {
                self.noted().await?;
                let (files, turn) = (self.files.clone(), self.turn.clone());
                on_disk(&self.files.parts, move || files.whole().map(|()| drop(turn))).await?;
            }
            Ok(Err(_)) | Err(FetchError::Cancelled) => {
                self.noted().await?;
                self.begin_note();
                self.noted().await?;
            }
            Err(_) => {}
        }
        ended
    }

    async fn gather(&mut self, ear: &mut Ear) -> Result<Result<(), GaveUp>, FetchError> {
        let now = Instant::now();
        let mut times = Times {
            quiet_since: now,
            silence: self.patience.silence,
            starved_since: now,
            deaf_since: Some(now),
            is_fresh: true,
            came_at: None,
        };
        if self.map.as_ref().is_some_and(PartMap::is_whole) {
            return Ok(Ok(()));
        }
        if *ear.hearing.borrow_and_update() == Hearing::Away {
            return Ok(Err(GaveUp::NoSession));
        }
        self.hear(*ear.hearing.borrow(), &mut times);
        let mut batch = Vec::with_capacity(WRITTEN_TOGETHER);
        loop {
            tokio::select! {
                // Cancel-safe: a message stays in the channel until received.
                count = ear.parts.recv_many(&mut batch, WRITTEN_TOGETHER) => {
                    if count == 0 {
                        return Ok(Err(GaveUp::Replaced));
                    }
                    self.take(std::mem::take(&mut batch), &mut times).await?;
                    if self.map.as_ref().is_some_and(PartMap::is_whole) {
                        return Ok(Ok(()));
                    }
                }
                // Cancel-safe: a watch remembers a change.
                Ok(()) = ear.hearing.changed() => self.hear(*ear.hearing.borrow_and_update(), &mut times),
                // Cancel-safe: the timer is recreated on each iteration.
                () = tokio::time::sleep_until(self.next_look(&times)) => {
                    if let Some(gave_up) = self.look(&mut times) {
                        return Ok(Err(gave_up));
                    }
                }
            }
        }
    }

    /// Takes messages from the session, writes the valid parts, and drops the messages, which
    /// acknowledges them.
    async fn take(&mut self, batch: Vec<Arrived>, times: &mut Times) -> Result<(), FetchError> {
        let now = Instant::now();
        let mut writes = Vec::with_capacity(batch.len());
        for arrived in batch {
            let Some((index, from)) = self.judge(&arrived.message) else { continue };
            times.quiet_since = now;
            times.silence = self.patience.silence;
            let Some(map) = &mut self.map else { continue };
            if std::mem::take(&mut times.is_fresh) && map.ask_below(index) {
                // The subscription came late: parts published earlier are sent again only on
                // request.
                self.say();
            }
            let is_there = self.map.as_ref().is_some_and(|map| map.has(index));
            if is_there { self.double += 1 } else { writes.push((index, from, arrived)) }
        }
        if writes.is_empty() {
            return Ok(());
        }
        let (file, turn) = (self.file.clone(), self.turn.clone());
        let written = on_disk(&self.files.parts, move || {
            for (_, from, arrived) in &writes {
                file.write_all_at(&arrived.message[HEADER_BYTES..], *from)?;
            }
            drop(turn);
            Ok(writes)
        })
        .await?;
        let Some(map) = &mut self.map else { return Ok(()) };
        for (index, ..) in &written {
            // A batch may hold the same part twice.
            self.double += u64::from(!map.take(*index));
        }
        times.starved_since = now;
        self.tell_progress();
        times.came_at.get_or_insert(now);
        let due = self.bytes() - self.noted_bytes >= NOTED_BYTES
            || self.noted_at.elapsed() >= NOTED_AFTER;
        if due && self.noting.as_ref().is_none_or(JoinHandle::is_finished) {
            self.noted().await?;
            self.begin_note();
        }
        Ok(())
    }

    /// Index and offset of a part. `None` if the message is not a part of this content with the
    /// known part size.
    fn judge(&mut self, message: &[u8]) -> Option<(u32, u64)> {
        let fits = Part::decode(message, self.content.size).and_then(|part| {
            let cut = Cut::new(self.content.size, part.part_bytes)?;
            Ok((part.index, cut))
        });
        let (index, cut) = match fits {
            Ok(fits) => fits,
            Err(error) => {
                if self.foreign == 0 {
                    tracing::warn!(digest = %self.content.digest, %error, "a message is no part of it");
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

    fn hear(&mut self, hearing: Hearing, times: &mut Times) {
        let now = Instant::now();
        match hearing {
            Hearing::Yes => {
                (times.quiet_since, times.starved_since, times.deaf_since) = (now, now, None);
                (times.silence, times.is_fresh) = (self.patience.silence, true);
                if let Some(map) = &mut self.map {
                    map.ask_nothing();
                }
                self.asks.send_modify(|asks| {
                    *asks = Asks { missing: Some(Vec::new()), times: asks.times + 1 }
                });
            }
            Hearing::Asked | Hearing::Refused | Hearing::Away => {
                times.deaf_since.get_or_insert(now);
                self.asks.send_if_modified(|asks| asks.missing.take().is_some());
            }
        }
    }

    fn next_look(&self, times: &Times) -> Instant {
        let next = match times.deaf_since {
            Some(since) => since + self.patience.deaf,
            None => {
                (times.quiet_since + times.silence).min(times.starved_since + self.patience.starved)
            }
        };
        times.came_at.map_or(next, |at| next.min(at + TAKEN_BACK_AFTER))
    }

    /// Requests the missing parts, or gives up.
    fn look(&mut self, times: &mut Times) -> Option<GaveUp> {
        let now = Instant::now();
        if times.came_at.take_if(|at| now >= *at + TAKEN_BACK_AFTER).is_some() {
            self.take_back();
        }
        if let Some(since) = times.deaf_since {
            return (now >= since + self.patience.deaf).then_some(GaveUp::Deaf(self.patience.deaf));
        }
        if now >= times.starved_since + self.patience.starved {
            return Some(GaveUp::Starved(self.patience.starved));
        }
        if now >= times.quiet_since + times.silence {
            times.quiet_since = now;
            times.silence *= 2;
            if let Some(map) = &mut self.map {
                map.ask_below(u32::MAX);
            }
            self.say();
        }
        None
    }

    fn say(&self) {
        let missing = match &self.map {
            Some(map) => map.asked(),
            // The number of parts is still unknown.
            None => vec![PartRange { from: 0, to: u32::MAX }],
        };
        self.asks
            .send_modify(|asks| *asks = Asks { missing: Some(missing), times: asks.times + 1 });
    }

    /// Removes the parts that have arrived from the request, so that a report sent for another
    /// reason does not request them again.
    fn take_back(&self) {
        let asked = |asks: &Asks| asks.missing.as_ref().is_some_and(|missing| !missing.is_empty());
        if let Some(map) = self.map.as_ref().filter(|_| asked(&self.asks.borrow())) {
            self.asks.send_modify(|asks| asks.missing = Some(map.asked()));
        }
    }

    /// Number of bytes received.
    pub(super) fn bytes(&self) -> u64 {
        self.map.as_ref().map_or(0, PartMap::bytes)
    }

    fn tell_progress(&self) {
        self.progress.send_replace(Progress { done: self.bytes(), total: self.content.size });
    }

    /// Starts to sync the received parts to the disk and then to write the note.
    fn begin_note(&mut self) {
        let Some(map) = &self.map else { return };
        let (note, file, path, turn) =
            (map.note(), self.file.clone(), self.files.note.clone(), self.turn.clone());
        (self.noted_bytes, self.noted_at) = (map.bytes(), Instant::now());
        self.noting = Some(tokio::task::spawn_blocking(move || {
            file.sync_data()?;
            durable::write(&path, &note, 0o600).map(|()| drop(turn))
        }));
    }

    /// Waits until the current note is written.
    async fn noted(&mut self) -> Result<(), FetchError> {
        match self.noting.take() {
            Some(noting) => finished(&self.files.note, noting).await,
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
pub(super) fn hand_over(data: &DataDir, content: BlobRef) -> io::Result<()> {
    let files = Files::of(data, &content.digest);
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
    Files::of(data, content).discard()
}

impl Files {
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
