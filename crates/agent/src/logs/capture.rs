//! Copies a task's two output streams into its log: each line whole, in its stream's order, with
//! the time at which it was read. The capture never blocks the task for long: where the disk can't
//! keep up, output is dropped and counted.

use std::io::{self, PipeReader, Read as _};
use std::os::fd::AsFd as _;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use task_proto::telemetry::log::LogSource;
use task_proto::time::timestamp;

use super::record::{self, MAX_TEXT_BYTES};
use super::rotated::RotatedLog;
use crate::logs::LogSpec;
use crate::system::clock;

/// Maximum time that the beginning of a line waits for the rest.
const PARTIAL_TIMEOUT: Duration = Duration::from_secs(1);
/// Maximum time that a full queue may block the task's output. After that, output is dropped until
/// there is room.
const QUEUE_TIMEOUT: Duration = Duration::from_secs(1);
/// Maximum number of bytes that wait for the disk.
const QUEUE_BYTES: usize = 1024 * 1024;
/// Size of one read. Even if each byte were an empty line, the queue would just hold the records.
const READ_BYTES: usize = 16 * 1024;

/// Copies one run's output into its log until both streams end.
pub fn copy(spec: LogSpec, stdout: PipeReader, stderr: PipeReader) {
    let queue = Queue::default();
    std::thread::scope(|scope| {
        scope.spawn(|| queue.write_to(&mut RotatedLog::new(spec)));
        let mut start = Vec::new();
        record::write_start(&mut start, clock::wall_ms());
        queue.add(&start);
        read(
            [Stream::new(stdout, LogSource::Stdout), Stream::new(stderr, LogSource::Stderr)],
            &queue,
        );
        queue.end();
    });
}

fn read(mut streams: [Stream; 2], queue: &Queue) {
    let mut buffer = vec![0; READ_BYTES];
    let mut lines = Vec::new();
    while streams.iter().any(|stream| stream.pipe.is_some()) {
        let ready = match ready(&streams) {
            Ok(ready) => ready,
            Err(Errno::EINTR) => continue,
            Err(_) => return,
        };
        let stamp = timestamp(clock::wall_ms());
        for (stream, ready) in streams.iter_mut().zip(ready) {
            if ready {
                stream.read(&mut buffer, &stamp, &mut lines);
            }
            if stream.deadline().is_some_and(|deadline| deadline <= Instant::now()) {
                stream.flush(&stamp, &mut lines);
            }
        }
        queue.add(&lines);
        lines.clear();
    }
}

/// Waits until a stream can be read or the beginning of a line has waited long enough; returns
/// which streams can be read.
fn ready(streams: &[Stream; 2]) -> Result<[bool; 2], Errno> {
    let deadline = streams.iter().filter_map(Stream::deadline).min();
    let wait = deadline.map(|deadline| {
        deadline.saturating_duration_since(Instant::now()) + Duration::from_millis(1)
    });
    let timeout =
        wait.map_or(PollTimeout::NONE, |wait| wait.try_into().unwrap_or(PollTimeout::MAX));
    let open = streams.iter().filter_map(|stream| stream.pipe.as_ref());
    let mut polled: Vec<PollFd> =
        open.map(|pipe| PollFd::new(pipe.as_fd(), PollFlags::POLLIN)).collect();
    poll(&mut polled, timeout)?;
    // An end or an error also counts as readable.
    let mut polled = polled.iter().map(|polled| polled.any().unwrap_or(true));
    Ok([0, 1].map(|index: usize| streams[index].pipe.is_some() && polled.next().unwrap_or(false)))
}

/// One of the two streams, and the beginning of its next line.
struct Stream {
    pipe: Option<PipeReader>,
    source: LogSource,
    partial: Vec<u8>,
    partial_since: Option<Instant>,
    /// Whether an earlier record holds the beginning of the line.
    continues: bool,
}

impl Stream {
    fn new(pipe: PipeReader, source: LogSource) -> Self {
        Self {
            pipe: Some(pipe),
            source,
            partial: Vec::new(),
            partial_since: None,
            continues: false,
        }
    }

    fn deadline(&self) -> Option<Instant> {
        Some(self.partial_since? + PARTIAL_TIMEOUT)
    }

    fn read(&mut self, buffer: &mut [u8], stamp: &str, lines: &mut Vec<u8>) {
        let Some(pipe) = &mut self.pipe else { return };
        match pipe.read(buffer) {
            Ok(0) => {
                self.flush(stamp, lines);
                self.pipe = None;
            }
            Ok(count) => self.take(&buffer[..count], stamp, lines),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(_) => self.pipe = None,
        }
    }

    /// Adds the lines to `lines` that `bytes` completes.
    fn take(&mut self, mut bytes: &[u8], stamp: &str, lines: &mut Vec<u8>) {
        while !bytes.is_empty() {
            let room = MAX_TEXT_BYTES - self.partial.len();
            let near = &bytes[..bytes.len().min(room + 1)];
            if let Some(end) = near.iter().position(|byte| *byte == b'\n') {
                self.partial.extend_from_slice(&bytes[..end]);
                bytes = &bytes[end + 1..];
                // The end of a line that was flushed as a whole adds no record.
                if !(self.continues && self.partial.is_empty()) {
                    self.put(self.partial.len(), stamp, lines);
                }
                self.continues = false;
            } else {
                let count = bytes.len().min(room);
                self.partial.extend_from_slice(&bytes[..count]);
                bytes = &bytes[count..];
                if self.partial.len() == MAX_TEXT_BYTES {
                    self.put(character_boundary(&self.partial), stamp, lines);
                    self.continues = true;
                }
            }
        }
        if self.partial.is_empty() {
            self.partial_since = None;
        } else {
            self.partial_since.get_or_insert_with(Instant::now);
        }
    }

    /// Adds the beginning of a line without waiting for the rest.
    fn flush(&mut self, stamp: &str, lines: &mut Vec<u8>) {
        if !self.partial.is_empty() {
            self.put(self.partial.len(), stamp, lines);
            self.continues = true;
        }
        self.partial_since = None;
    }

    fn put(&mut self, count: usize, stamp: &str, lines: &mut Vec<u8>) {
        record::write(lines, stamp, self.source, self.continues, &self.partial[..count]);
        self.partial.drain(..count);
    }
}

/// Position at which a long line may be cut: all of `bytes`, or before an incomplete last
/// character.
fn character_boundary(bytes: &[u8]) -> usize {
    let begins = |byte: &u8| !(0x80..0xc0).contains(byte);
    let tail = bytes.iter().rev().take(4).position(begins);
    match tail {
        Some(back) if bytes[bytes.len() - 1 - back] >= 0xc0 && bytes.len() > back + 1 => {
            bytes.len() - 1 - back
        }
        _ => bytes.len(),
    }
}

/// Output that was read and not yet written: whole lines, then perhaps a gap.
#[derive(Default)]
struct Queue {
    waiting: Mutex<QueuedLines>,
    changed: Condvar,
}

#[derive(Default)]
struct QueuedLines {
    lines: Vec<u8>,
    lost_bytes: u64,
    ended: bool,
}

impl Queue {
    /// Adds whole lines, or counts them as lost when there has been no room for too long.
    fn add(&self, lines: &[u8]) {
        if lines.is_empty() {
            return;
        }
        let waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        // After a gap no lines are added before the gap is recorded; otherwise the record of the
        // gap would be in the wrong place.
        let is_full = |waiting: &mut QueuedLines| {
            waiting.lost_bytes == 0
                && !waiting.lines.is_empty()
                && waiting.lines.len() + lines.len() > QUEUE_BYTES
        };
        let waited = self.changed.wait_timeout_while(waiting, QUEUE_TIMEOUT, is_full);
        let (mut waiting, _) = waited.unwrap_or_else(PoisonError::into_inner);
        if waiting.lost_bytes > 0 || is_full(&mut waiting) {
            waiting.lost_bytes += lines.len() as u64;
        } else {
            waiting.lines.extend_from_slice(lines);
        }
        self.changed.notify_all();
    }

    fn end(&self) {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner).ended = true;
        self.changed.notify_all();
    }

    /// Writes the waiting output, until the end.
    fn write_to(&self, log: &mut RotatedLog) {
        loop {
            let waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            let is_idle = |waiting: &mut QueuedLines| {
                waiting.lines.is_empty() && waiting.lost_bytes == 0 && !waiting.ended
            };
            let mut waiting =
                self.changed.wait_while(waiting, is_idle).unwrap_or_else(PoisonError::into_inner);
            let lines = std::mem::take(&mut waiting.lines);
            let lost_bytes = std::mem::take(&mut waiting.lost_bytes);
            let ended = waiting.ended;
            drop(waiting);
            self.changed.notify_all();
            if lines.is_empty() && lost_bytes == 0 && ended {
                return;
            }
            log.write(&lines);
            log.drop_bytes(lost_bytes);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    const STAMP: &str = "2026-11-21T10:00:00.123Z";

    fn stream() -> Stream {
        let (reader, _) = io::pipe().expect("pipe");
        Stream::new(reader, LogSource::Stdout)
    }

    /// The records without their times.
    fn shown(lines: &[u8]) -> Vec<String> {
        let text = String::from_utf8_lossy(lines);
        text.lines().map(|line| line[STAMP.len() + 1..].to_owned()).collect()
    }

    #[test]
    fn lines_are_assembled_from_pieces() {
        let mut stream = stream();
        let mut lines = Vec::new();
        for piece in ["on", "e\ntwo", "\n\nthr", "ee\n"] {
            stream.take(piece.as_bytes(), STAMP, &mut lines);
        }
        assert_eq!(shown(&lines), ["O one", "O two", "O ", "O three"]);
        assert_eq!(stream.deadline(), None);
    }

    #[test]
    fn partial_line_is_flushed_and_continued() {
        let mut stream = stream();
        let mut lines = Vec::new();
        stream.take(b"name? ", STAMP, &mut lines);
        assert!(stream.deadline().is_some() && lines.is_empty());
        stream.flush(STAMP, &mut lines);
        assert_eq!(stream.deadline(), None);
        stream.take(b"Ada\nnext? ", STAMP, &mut lines);
        stream.flush(STAMP, &mut lines);
        stream.take(b"\nend\n", STAMP, &mut lines);
        assert_eq!(shown(&lines), ["O name? ", "o Ada", "O next? ", "O end"]);
    }

    #[test]
    fn long_lines_are_cut_between_characters() {
        let mut stream = stream();
        let mut lines = Vec::new();
        let text = format!("x{}", "é".repeat(MAX_TEXT_BYTES / 2));
        stream.take(
            format!("{text}\n{}\nend\n", "y".repeat(MAX_TEXT_BYTES)).as_bytes(),
            STAMP,
            &mut lines,
        );
        let shown = shown(&lines);
        assert_eq!(shown.len(), 4);
        assert_eq!(format!("{}{}", &shown[0][2..], &shown[1][2..]), text);
        assert!(shown[1].starts_with("o é") && shown[2].starts_with("O yy"));
        assert_eq!((shown[2].len(), shown[3].as_str()), (MAX_TEXT_BYTES + 2, "O end"));
        // Bytes that are not valid text are cut at any position.
        assert_eq!(character_boundary(&[0x80; 10]), 10);
    }

    #[test]
    fn output_the_disk_does_not_accept_in_time_is_counted() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        let queue = Queue::default();
        let big = vec![b'x'; QUEUE_BYTES];
        queue.add(&big);
        for _ in 0..3 {
            queue.add(b"lost\n");
        }
        queue.end();
        let mut log =
            RotatedLog::new(LogSpec { path: path.clone(), max_bytes: u64::MAX, files: 1 });
        queue.write_to(&mut log);
        log.write(b"kept\n");
        let text = std::fs::read_to_string(path).expect("log");
        assert!(
            text[QUEUE_BYTES..].contains("15 bytes of output could not be written here\nkept\n"),
            "{}",
            &text[QUEUE_BYTES..]
        );
    }

    #[test]
    fn both_streams_are_read_to_their_ends_in_order() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        let (stdout, mut out) = io::pipe().expect("pipe");
        let (stderr, mut err) = io::pipe().expect("pipe");
        let spec = LogSpec { path: path.clone(), max_bytes: u64::MAX, files: 1 };
        std::thread::scope(|scope| {
            scope.spawn(|| copy(spec, stdout, stderr));
            scope.spawn(move || {
                (0..20_000).try_for_each(|number| writeln!(out, "{number}")).expect("written")
            });
            scope.spawn(move || {
                (0..20_000).try_for_each(|number| writeln!(err, "{number}")).expect("written");
                write!(err, "no end of line").expect("written");
            });
        });
        let log = std::fs::read(path).expect("log");
        let shown = shown(&log);
        let of = |letter: &str| {
            shown
                .iter()
                .filter_map(|line| line.strip_prefix(letter))
                .map(str::to_owned)
                .collect::<Vec<_>>()
        };
        let numbers: Vec<String> = (0..20_000).map(|number| number.to_string()).collect();
        assert_eq!(shown[0], "T started");
        assert_eq!(of("O "), numbers);
        assert_eq!(of("E "), [numbers, vec!["no end of line".to_owned()]].concat());
    }
}
