//! A log on disk: one current file and a limited number of older ones. A write never fails for the
//! task: when the disk is full the output is dropped and counted, because a task that blocks on its
//! own log is worse.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use task_proto::telemetry::log::LogSource;
use task_proto::time::timestamp;

use super::record;
use crate::logs::LogSpec;
use crate::system::clock;

/// A log file that is rotated by size.
#[derive(Debug)]
pub struct RotatedLog {
    spec: LogSpec,
    current: Option<Current>,
    dropped_bytes: u64,
}

#[derive(Debug)]
struct Current {
    file: File,
    size: u64,
}

impl RotatedLog {
    /// A log that continues after the output of an earlier one at the same path.
    pub fn new(spec: LogSpec) -> Self {
        Self { spec, current: None, dropped_bytes: 0 }
    }

    /// Adds `bytes`, rotating at a line's end where there is one.
    pub fn write(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            match self.write_some(bytes) {
                Ok(written) => bytes = &bytes[written..],
                Err(_) => {
                    self.current = None;
                    self.drop_bytes(bytes.len() as u64);
                    return;
                }
            }
        }
    }

    /// Counts output that was lost before it reached the log; the next write records the loss
    /// first.
    pub fn drop_bytes(&mut self, count: u64) {
        self.dropped_bytes += count;
    }

    fn write_some(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let max_bytes = self.spec.max_bytes.max(1);
        self.write_drop_note()?;
        let current = self.current()?;
        let room = usize::try_from(max_bytes.saturating_sub(current.size)).unwrap_or(usize::MAX);
        let count = if bytes.len() <= room {
            bytes.len()
        } else {
            bytes[..room].iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1)
        };
        // A line that fits no file is cut; a line that only does not fit the rest of this file goes
        // to the next.
        let count = if count == 0 && current.size == 0 { room.min(bytes.len()) } else { count };
        if count == 0 {
            self.rotate()?;
            return Ok(0);
        }
        current.file.write_all(&bytes[..count])?;
        current.size += count as u64;
        Ok(count)
    }

    /// Records the number of missing bytes, once writing works again.
    fn write_drop_note(&mut self) -> io::Result<()> {
        if self.dropped_bytes > 0 {
            let text =
                format!("[WARN] {} bytes of output could not be written here", self.dropped_bytes);
            // The last successful write may have ended in the middle of a line.
            let mut note = vec![b'\n'];
            record::write(
                &mut note,
                &timestamp(clock::wall_ms()),
                LogSource::Agent,
                false,
                text.as_bytes(),
            );
            let current = self.current()?;
            current.file.write_all(&note)?;
            current.size += note.len() as u64;
            self.dropped_bytes = 0;
        }
        Ok(())
    }

    fn current(&mut self) -> io::Result<&mut Current> {
        let current = match self.current.take() {
            Some(current) => current,
            None => {
                let file = OpenOptions::new()
                    .append(true)
                    .create(true)
                    .mode(0o640)
                    .open(&self.spec.path)?;
                let size = file.metadata()?.len();
                Current { file, size }
            }
        };
        Ok(self.current.insert(current))
    }

    fn rotate(&mut self) -> io::Result<()> {
        self.current = None;
        for age in (0..self.spec.files.saturating_sub(1)).rev() {
            match std::fs::rename(aged(&self.spec.path, age), aged(&self.spec.path, age + 1)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        if self.spec.files <= 1 { std::fs::remove_file(&self.spec.path) } else { Ok(()) }
    }
}

/// The file that a log at `path` was `age` rotations ago.
pub fn aged(path: &Path, age: u32) -> PathBuf {
    if age == 0 {
        return path.to_owned();
    }
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{age}"));
    PathBuf::from(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(path: PathBuf) -> String {
        std::fs::read_to_string(path).unwrap_or_default()
    }

    #[test]
    fn files_are_rotated_at_lines_and_the_oldest_goes() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        let mut log = RotatedLog::new(LogSpec { path: path.clone(), max_bytes: 10, files: 3 });
        log.write(b"one\ntwo\nthree\nfour\nfive\nsix\n");
        assert_eq!(read(path.clone()), "six\n");
        assert_eq!(read(aged(&path, 1)), "four\nfive\n");
        assert_eq!(read(aged(&path, 2)), "three\n");
        assert_eq!(std::fs::read_dir(temp.path()).expect("list").count(), 3);
    }

    #[test]
    fn line_longer_than_a_file_is_cut_and_one_file_is_enough() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        let mut log = RotatedLog::new(LogSpec { path: path.clone(), max_bytes: 4, files: 1 });
        log.write(b"abcdefghij");
        assert_eq!(read(path), "ij");
    }

    #[test]
    fn unwritable_output_is_counted_and_noted() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("later").join("task.log");
        let mut log = RotatedLog::new(LogSpec { path: path.clone(), max_bytes: 1000, files: 2 });
        log.write(b"lost");
        std::fs::create_dir(temp.path().join("later")).expect("create");
        log.write(b"kept");
        let text = read(path);
        assert!(
            text.starts_with('\n')
                && text.ends_with(" T [WARN] 4 bytes of output could not be written here\nkept"),
            "{text}"
        );
    }

    #[test]
    fn earlier_log_is_continued() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        for line in [b"one\n", b"two\n"] {
            RotatedLog::new(LogSpec { path: path.clone(), max_bytes: 100, files: 2 }).write(line);
        }
        assert_eq!(read(path), "one\ntwo\n");
    }
}
