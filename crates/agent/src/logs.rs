//! A task's output on disk: one current file and a few older ones, never more. Writing never fails towards the task:
//! when the disk is full the output is dropped and counted, because a task that blocks on its own log is worse.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use crate::run_dir::LogSpec;

const READ_BYTES: usize = 64 * 1024;

/// Stands before each run's output.
const RUN_MARK: &str = "[taskd: started]\n";

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

/// The last lines of the last run in the log at `path`, at most `max_bytes` of them; empty when there is no log.
pub fn last_lines(path: &Path, max_bytes: u64) -> String {
    let read = || {
        let mut file = File::open(path)?;
        let begin = file.metadata()?.len().saturating_sub(max_bytes);
        file.seek(SeekFrom::Start(begin))?;
        let mut bytes = Vec::new();
        file.take(max_bytes).read_to_end(&mut bytes)?;
        // What was cut in the middle of a line is not worth showing, unless there is nothing else.
        let cut = if begin == 0 { 0 } else { bytes.iter().position(|byte| *byte == b'\n').map_or(0, |at| at + 1) };
        let text = String::from_utf8_lossy(&bytes[cut..]);
        Ok::<_, io::Error>(text.rsplit_once(RUN_MARK).map_or(&*text, |(_, last_run)| last_run).to_owned())
    };
    read().unwrap_or_default()
}

impl RotatedLog {
    /// A log that goes on where an earlier one at the same path ended.
    pub fn new(spec: LogSpec) -> Self {
        Self { spec, current: None, dropped_bytes: 0 }
    }

    /// Copies one run's `output` into the log until it ends.
    pub fn copy_from(&mut self, mut output: impl Read) {
        self.write(RUN_MARK.as_bytes());
        let mut buffer = vec![0; READ_BYTES];
        loop {
            match output.read(&mut buffer) {
                Ok(0) => return,
                Ok(count) => self.write(&buffer[..count]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => return,
            }
        }
    }

    /// Adds `bytes`, rotating at a line's end where there is one.
    pub fn write(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            match self.write_some(bytes) {
                Ok(written) => bytes = &bytes[written..],
                Err(_) => {
                    self.current = None;
                    self.dropped_bytes += bytes.len() as u64;
                    return;
                }
            }
        }
    }

    fn write_some(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let max_bytes = self.spec.max_bytes.max(1);
        self.admit_dropped()?;
        let current = self.current()?;
        let room = usize::try_from(max_bytes.saturating_sub(current.size)).unwrap_or(usize::MAX);
        let count = if bytes.len() <= room {
            bytes.len()
        } else {
            bytes[..room].iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1)
        };
        // A line that fits no file is cut; one that only does not fit the rest of this file goes to the next.
        let count = if count == 0 && current.size == 0 { room.min(bytes.len()) } else { count };
        if count == 0 {
            self.rotate()?;
            return Ok(0);
        }
        current.file.write_all(&bytes[..count])?;
        current.size += count as u64;
        Ok(count)
    }

    /// Says, once writing works again, how much is missing.
    fn admit_dropped(&mut self) -> io::Result<()> {
        if self.dropped_bytes > 0 {
            let note = format!("\n[taskd: {} bytes of output could not be written here]\n", self.dropped_bytes);
            let current = self.current()?;
            current.file.write_all(note.as_bytes())?;
            current.size += note.len() as u64;
            self.dropped_bytes = 0;
        }
        Ok(())
    }

    fn current(&mut self) -> io::Result<&mut Current> {
        let current = match self.current.take() {
            Some(current) => current,
            None => {
                let file = OpenOptions::new().append(true).create(true).mode(0o640).open(&self.spec.path)?;
                let size = file.metadata()?.len();
                Current { file, size }
            }
        };
        Ok(self.current.insert(current))
    }

    fn rotate(&mut self) -> io::Result<()> {
        self.current = None;
        for age in (0..self.spec.files.saturating_sub(1)).rev() {
            match std::fs::rename(self.aged(age), self.aged(age + 1)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        if self.spec.files <= 1 { std::fs::remove_file(&self.spec.path) } else { Ok(()) }
    }

    fn aged(&self, age: u32) -> PathBuf {
        if age == 0 {
            return self.spec.path.clone();
        }
        let mut name = self.spec.path.as_os_str().to_owned();
        name.push(format!(".{age}"));
        PathBuf::from(name)
    }
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
        assert_eq!(read(log.aged(1)), "four\nfive\n");
        assert_eq!(read(log.aged(2)), "three\n");
        assert_eq!(std::fs::read_dir(temp.path()).expect("list").count(), 3);
    }

    #[test]
    fn a_line_longer_than_a_file_is_cut_and_one_file_is_enough() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        let mut log = RotatedLog::new(LogSpec { path: path.clone(), max_bytes: 4, files: 1 });
        log.write(b"abcdefghij");
        assert_eq!(read(path), "ij");
    }

    #[test]
    fn output_that_cannot_be_written_is_counted_and_admitted() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("later").join("task.log");
        let mut log = RotatedLog::new(LogSpec { path: path.clone(), max_bytes: 1000, files: 2 });
        log.write(b"lost");
        std::fs::create_dir(temp.path().join("later")).expect("create");
        log.write(b"kept");
        assert_eq!(read(path), "\n[taskd: 4 bytes of output could not be written here]\nkept");
    }

    #[test]
    fn the_last_lines_are_whole() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        assert_eq!(last_lines(&path, 10), "");
        std::fs::write(&path, "one\ntwo\nthree\n").expect("write");
        assert_eq!(last_lines(&path, 100), "one\ntwo\nthree\n");
        assert_eq!(last_lines(&path, 8), "three\n");
        assert_eq!(last_lines(&path, 3), "");
        std::fs::write(&path, "").unwrap();
        for run in ["first\nno end of line", "second\n"] {
            RotatedLog::new(LogSpec::at(path.clone())).copy_from(run.as_bytes());
        }
        assert_eq!(last_lines(&path, 100), "second\n", "an earlier run's lines say nothing about this one");
    }

    #[test]
    fn an_earlier_log_is_continued() {
        let temp = tempfile::tempdir().expect("temp dir");
        let path = temp.path().join("task.log");
        for line in [b"one\n", b"two\n"] {
            RotatedLog::new(LogSpec { path: path.clone(), max_bytes: 100, files: 2 }).write(line);
        }
        assert_eq!(read(path), "one\ntwo\n");
    }
}
