//! Reads the lines that are added to a log, across its rotation. It holds no file open and stores
//! no lines: unread lines stay on the disk for as long as the log keeps them.

use std::fs::{File, Metadata};
use std::io;
use std::os::unix::fs::{FileExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::archive::MAX_AGED;
use super::rotated::aged;

const CHUNK_BYTES: usize = 64 * 1024;

/// Position in a log at which reading continues.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Tail {
    at: Option<Position>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Position {
    device: u64,
    inode: u64,
    /// The inode number of a deleted file is soon reused; most file systems also record a creation
    /// time.
    created: Option<SystemTime>,
    offset: u64,
}

impl Position {
    fn is_in(&self, file: &Metadata) -> bool {
        (self.device, self.inode, self.created) == (file.dev(), file.ino(), file.created().ok())
    }

    fn new(file: &Metadata, offset: u64) -> Self {
        Self { device: file.dev(), inode: file.ino(), created: file.created().ok(), offset }
    }
}

impl Tail {
    /// Moves the position to at most `bytes` before the current end of the log.
    pub fn skip(&mut self, log: &Path, bytes: u64) {
        let Ok(newest) = std::fs::metadata(log) else { return };
        let begin = newest.len().saturating_sub(bytes);
        let is_later = self.at.as_ref().is_none_or(|at| !at.is_in(&newest) || at.offset < begin);
        if is_later {
            self.at = Some(Position::new(&newest, begin));
        }
    }

    /// Passes the next whole lines, of at most about `room` bytes, to `each` until it returns
    /// false.
    pub fn read(
        &mut self,
        log: &Path,
        room: &mut usize,
        mut each: impl FnMut(&[u8]) -> bool,
    ) -> io::Result<()> {
        while *room > 0 {
            let Some((path, metadata)) = self.current(log)? else { return Ok(()) };
            let mut position = match &self.at {
                // A file that became shorter was rewritten.
                Some(at) if at.is_in(&metadata) && at.offset <= metadata.len() => at.clone(),
                _ => Position::new(&metadata, 0),
            };
            let is_newest = path == log;
            let wants_more =
                read_lines(&path, metadata.len(), is_newest, &mut position, room, &mut each);
            let is_read = position.offset >= metadata.len();
            self.at = Some(position);
            if !wants_more? || is_newest {
                return Ok(());
            }
            if is_read {
                // The newest file was deleted while it was being written: no more lines come until
                // the log is rotated.
                let Some(newer) = next_newer(log, &path)? else { return Ok(()) };
                self.at = Some(newer);
            }
        }
        Ok(())
    }

    /// The file that is being read, if there is one; when it has been rotated away, the oldest.
    fn current(&self, log: &Path) -> io::Result<Option<(PathBuf, Metadata)>> {
        let mut oldest = None;
        for age in 0..=MAX_AGED {
            let path = aged(log, age);
            let Some(metadata) = metadata(&path)? else { if age == 0 { continue } else { break } };
            match &self.at {
                Some(at) if at.is_in(&metadata) => return Ok(Some((path, metadata))),
                _ => oldest = Some((path, metadata)),
            }
        }
        Ok(oldest)
    }
}

/// The beginning of the file that came after `path`.
fn next_newer(log: &Path, path: &Path) -> io::Result<Option<Position>> {
    for age in (0..MAX_AGED).rev() {
        if aged(log, age + 1) == path {
            let newer = metadata(&aged(log, age))?;
            return Ok(newer.map(|metadata| Position::new(&metadata, 0)));
        }
    }
    Ok(None)
}

fn metadata(path: &Path) -> io::Result<Option<Metadata>> {
    match std::fs::metadata(path) {
        Ok(metadata) => Ok(Some(metadata)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

/// Reads the file at `path` from `position` to its end; false when `each` wants no more. The end of
/// a line that is still being written is left for later.
fn read_lines(
    path: &Path,
    size: u64,
    is_newest: bool,
    position: &mut Position,
    room: &mut usize,
    each: &mut impl FnMut(&[u8]) -> bool,
) -> io::Result<bool> {
    if position.offset >= size {
        return Ok(true);
    }
    let file = File::open(path)?;
    let mut buffer = vec![0; CHUNK_BYTES];
    while position.offset < size && *room > 0 {
        let count = file.read_at(&mut buffer, position.offset)?;
        if count == 0 {
            return Ok(true);
        }
        let mut begin = 0;
        while let Some(length) = buffer[begin..count].iter().position(|byte| *byte == b'\n') {
            let wants_more = each(&buffer[begin..begin + length]);
            begin += length + 1;
            if !wants_more {
                position.offset += begin as u64;
                return Ok(false);
            }
        }
        // A line that fills the buffer, or that is no longer being written, counts as whole.
        if begin == 0 && (count == buffer.len() || !is_newest) {
            each(&buffer[..count]);
            begin = count;
        } else if begin == 0 {
            return Ok(true);
        }
        position.offset += begin as u64;
        *room = room.saturating_sub(begin);
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use std::fs::OpenOptions;
    use std::io::Write as _;

    use super::*;
    use crate::logs::LogSpec;
    use crate::logs::rotated::RotatedLog;

    fn read(tail: &mut Tail, log: &Path) -> Vec<String> {
        let mut lines = Vec::new();
        let mut room = usize::MAX;
        let each = |line: &[u8]| {
            lines.push(String::from_utf8_lossy(line).into_owned());
            true
        };
        tail.read(log, &mut room, each).unwrap();
        lines
    }

    #[test]
    fn only_new_complete_lines_are_read() {
        let temp = tempfile::tempdir().unwrap();
        let log = temp.path().join("task.log");
        let mut tail = Tail::default();
        assert_eq!(read(&mut tail, &log), Vec::<String>::new());
        let mut file = OpenOptions::new().append(true).create(true).open(&log).unwrap();
        write!(file, "one\ntwo\nthr").unwrap();
        assert_eq!(read(&mut tail, &log), ["one", "two"]);
        assert_eq!(read(&mut tail, &log), Vec::<String>::new());
        writeln!(file, "ee").unwrap();
        assert_eq!(read(&mut tail, &log), ["three"]);
        std::fs::write(&log, "anew\n").unwrap();
        assert_eq!(read(&mut tail, &log), ["anew"], "a build's log is begun again");
    }

    #[test]
    fn rotation_loses_no_existing_line() {
        let temp = tempfile::tempdir().unwrap();
        let log = temp.path().join("task.log");
        let mut written = RotatedLog::new(LogSpec { path: log.clone(), max_bytes: 100, files: 5 });
        let mut tail = Tail::default();
        let mut seen = Vec::new();
        for number in 0..200 {
            written.write(format!("line {number}\n").as_bytes());
            // Sometimes a whole file and more is added between two reads.
            if number % 23 == 0 {
                seen.extend(read(&mut tail, &log));
            }
        }
        seen.extend(read(&mut tail, &log));
        let expected: Vec<String> = (0..200).map(|number| format!("line {number}")).collect();
        assert_eq!(seen, expected);
        for number in 0..200 {
            written.write(format!("flood {number}\n").as_bytes());
        }
        let rest = read(&mut tail, &log);
        assert!(rest.len() < 60 && rest.last().is_some_and(|line| line == "flood 199"), "{rest:?}");
        assert!(rest.iter().all(|line| line.starts_with("flood ")));
    }

    #[test]
    fn deleted_log_is_not_read_again() {
        let temp = tempfile::tempdir().unwrap();
        let log = temp.path().join("task.log");
        let mut written = RotatedLog::new(LogSpec { path: log.clone(), max_bytes: 100, files: 5 });
        (0..30).for_each(|number| written.write(format!("line {number}\n").as_bytes()));
        let mut tail = Tail::default();
        assert_eq!(read(&mut tail, &log).len(), 30);
        std::fs::remove_file(&log).unwrap();
        // The rest of the file is read once more, because the read position is lost. Then no more
        // lines come.
        read(&mut tail, &log);
        assert_eq!(read(&mut tail, &log), Vec::<String>::new());
        (0..30).for_each(|number| written.write(format!("later {number}\n").as_bytes()));
        assert!(read(&mut tail, &log).iter().all(|line| line.starts_with("later ")));
    }

    #[test]
    fn reading_stops_on_request_and_continues_there() {
        let temp = tempfile::tempdir().unwrap();
        let log = temp.path().join("task.log");
        std::fs::write(&log, "one\ntwo\nthree\n").unwrap();
        let mut tail = Tail::default();
        let mut first = Vec::new();
        let mut room = 100;
        tail.read(&log, &mut room, |line| {
            first.push(line.to_vec());
            false
        })
        .unwrap();
        assert_eq!(first, [b"one"]);
        assert_eq!(read(&mut tail, &log), ["two", "three"]);
        tail.skip(&log, 5);
        assert_eq!(read(&mut tail, &log), Vec::<String>::new(), "nothing is read twice");
        let mut fresh = Tail::default();
        fresh.skip(&log, 6);
        assert_eq!(read(&mut fresh, &log), ["three"]);
        assert_eq!(tail, fresh);
    }
}
