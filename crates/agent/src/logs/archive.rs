//! Reads stored lines back, the newest first, from any number of files at once. However large the
//! logs are, only a chunk of each file is in memory, and the bytes read for one query are limited.

use std::collections::VecDeque;
use std::fs::File;
use std::os::unix::fs::{FileExt as _, MetadataExt as _};
use std::time::UNIX_EPOCH;

use task_proto::TaskName;
use task_proto::telemetry::log::{LogLevel, LogLine, MAX_BATCH_BYTES, MAX_KEPT_LINES};
use task_proto::time::millis;

use super::line::{Deduplicator, Entry, LogFile};
use super::record::Record;
use super::rotated::aged;
use crate::system::clock;

const CHUNK_BYTES: usize = 64 * 1024;
/// Maximum length of a line that is examined as a whole; the shim writes shorter lines.
const MAX_LINE_BYTES: usize = 64 * 1024;
/// Maximum bytes read for one query. The query does not find lines further back.
const MAX_SCAN_BYTES: u64 = 256 * 1024 * 1024;
/// Maximum number of older files that are searched beside a log.
pub const MAX_AGED: u32 = 16;
/// Size of a batch without its lines.
const BATCH_OVERHEAD_BYTES: usize = 1024;

/// Selection of log lines.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogQuery {
    /// Only lines of this task.
    pub task: Option<TaskName>,
    /// Only lines of this level and more serious ones.
    pub level: LogLevel,
    /// Maximum age of the lines in milliseconds.
    pub since_ms: Option<u64>,
    /// Maximum number of lines.
    pub max_lines: u64,
}

/// The newest matching lines of `files` that fit into an answer, the oldest first.
pub fn newest(files: &[LogFile], query: &LogQuery, now_ms: u64) -> Vec<LogLine> {
    let cutoff_ms = query.since_ms.map_or(0, |since_ms| now_ms.saturating_sub(since_ms));
    let max_lines = usize::try_from(query.max_lines).unwrap_or(usize::MAX).min(MAX_KEPT_LINES);
    let files = files.iter().filter(|file| query.task.is_none() || file.task == query.task);
    let mut sources: Vec<Source> =
        files.map(|file| Source::new(file, query.level, cutoff_ms)).collect();
    let mut scan_budget = MAX_SCAN_BYTES;
    sources.iter_mut().for_each(|source| source.advance(&mut scan_budget));
    let mut deduplicator = Deduplicator::default();
    let mut lines = Vec::new();
    let mut bytes = BATCH_OVERHEAD_BYTES;
    while lines.len() < max_lines {
        let newest = sources.iter_mut().filter(|source| source.head.is_some());
        let newest = newest.max_by_key(|source| source.head.as_ref().map(|entry| entry.line.at_ms));
        let Some(source) = newest else { break };
        let Some(entry) = source.head.take() else { break };
        source.advance(&mut scan_budget);
        if deduplicator.is_duplicate(&entry) {
            continue;
        }
        bytes += serde_json::to_vec(&entry.line).map_or(0, |json| json.len() + 1);
        if bytes > MAX_BATCH_BYTES {
            break;
        }
        lines.push(entry.line);
    }
    lines.reverse();
    lines
}

/// One log with its older files, and its newest line that was not taken yet.
struct Source<'a> {
    file: &'a LogFile,
    level: LogLevel,
    cutoff_ms: u64,
    lines: ReverseLines,
    at_ms: u64,
    head: Option<Entry>,
}

impl<'a> Source<'a> {
    fn new(file: &'a LogFile, level: LogLevel, cutoff_ms: u64) -> Self {
        let mut files: Vec<File> = Vec::new();
        let mut seen = Vec::new();
        for age in 0..=MAX_AGED {
            let Ok(opened) = File::open(aged(&file.path, age)) else {
                // A log is without its newest file for a moment when it is rotated.
                if age == 0 { continue } else { break }
            };
            let Ok(metadata) = opened.metadata() else { break };
            let id = (metadata.dev(), metadata.ino());
            // The log was rotated while it was opened: this file is already in the list.
            if !seen.contains(&id) {
                seen.push(id);
                files.push(opened);
            }
        }
        // A line without a time is at most as new as its file.
        let written = files.first().and_then(|file| {
            file.metadata().ok()?.modified().ok()?.duration_since(UNIX_EPOCH).ok()
        });
        let at_ms = written.map_or(0, millis);
        Self { file, level, cutoff_ms, lines: ReverseLines::new(files.into()), at_ms, head: None }
    }

    /// Finds the next matching line.
    fn advance(&mut self, scan_budget: &mut u64) {
        self.head = None;
        while let Some(line) = self.lines.next_line(scan_budget) {
            let record = Record::parse(&line);
            self.at_ms = record.at_ms.unwrap_or(self.at_ms);
            if self.at_ms < self.cutoff_ms {
                // A robot that did not know the time when it started wrote lines of 1970 between
                // those of today.
                if self.at_ms >= clock::PROGRAM_EXISTS_SINCE_MS {
                    return;
                }
                continue;
            }
            if record.level(self.file.unmarked) >= self.level {
                self.head = Entry::of(&record, self.file, self.at_ms);
                if self.head.is_some() {
                    return;
                }
            }
        }
    }
}

/// The lines of files, the newest first.
struct ReverseLines {
    files: VecDeque<File>,
    /// The file that is read, and the length of its unread beginning.
    current: Option<(File, u64)>,
    /// Bytes that were read and not taken yet, without the end of the last line.
    buffer: Vec<u8>,
    is_newest: bool,
}

impl ReverseLines {
    fn new(files: VecDeque<File>) -> Self {
        Self { files, current: None, buffer: Vec::new(), is_newest: true }
    }

    fn next_line(&mut self, scan_budget: &mut u64) -> Option<Vec<u8>> {
        loop {
            if let Some(end) = self.buffer.iter().rposition(|byte| *byte == b'\n') {
                let line = self.buffer.split_off(end + 1);
                self.buffer.pop();
                return Some(line);
            }
            if self.buffer.len() > MAX_LINE_BYTES {
                return Some(std::mem::take(&mut self.buffer));
            }
            match &mut self.current {
                Some((_, 0)) => {
                    self.current = None;
                    if !self.buffer.is_empty() {
                        return Some(std::mem::take(&mut self.buffer));
                    }
                }
                Some((file, unread)) => {
                    let count = (*unread).min(CHUNK_BYTES as u64);
                    if *scan_budget < count {
                        return None;
                    }
                    *scan_budget -= count;
                    *unread -= count;
                    let mut chunk = vec![0; count as usize];
                    if file.read_exact_at(&mut chunk, *unread).is_err() {
                        // The file was rewritten meanwhile, or the disk fails.
                        self.current = None;
                        self.buffer.clear();
                        continue;
                    }
                    chunk.append(&mut self.buffer);
                    self.buffer = chunk;
                }
                None => {
                    self.open_next()?;
                }
            }
        }
    }

    /// Opens the next file; `None` after the last.
    fn open_next(&mut self) -> Option<()> {
        let file = self.files.pop_front()?;
        let size = file.metadata().map_or(0, |metadata| metadata.len());
        let end = if std::mem::take(&mut self.is_newest) { whole_lines(&file, size) } else { size };
        // The line end before the first line.
        let mut last = [0];
        let ends_with_line =
            end > 0 && file.read_exact_at(&mut last, end - 1).is_ok() && last == *b"\n";
        self.current = Some((file, if ends_with_line { end - 1 } else { end }));
        Some(())
    }
}

/// Length of the whole lines in a file that is being written; the whole length if the last part has
/// no line end.
fn whole_lines(file: &File, size: u64) -> u64 {
    let begin = size.saturating_sub(MAX_LINE_BYTES as u64);
    let mut tail = vec![0; (size - begin) as usize];
    if file.read_exact_at(&mut tail, begin).is_err() {
        return size;
    }
    tail.iter().rposition(|byte| *byte == b'\n').map_or(size, |end| begin + end as u64 + 1)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use task_proto::telemetry::log::LogSource;
    use task_proto::time::timestamp;

    use super::*;
    use crate::logs::LogSpec;
    use crate::logs::record;
    use crate::logs::rotated::RotatedLog;

    const DAY_MS: u64 = 86_400_000;
    const NOW_MS: u64 = clock::PROGRAM_EXISTS_SINCE_MS + 100 * DAY_MS;

    fn file(path: &Path, task: &str) -> LogFile {
        LogFile {
            path: path.to_owned(),
            task: Some(task.parse().unwrap()),
            unmarked: LogSource::Stdout,
        }
    }

    fn everything() -> LogQuery {
        LogQuery { task: None, level: LogLevel::Debug, since_ms: None, max_lines: 100 }
    }

    fn write(path: &Path, lines: &[(u64, LogSource, &str)]) {
        let mut log = Vec::new();
        for (at_ms, source, text) in lines {
            record::write(&mut log, &timestamp(*at_ms), *source, false, text.as_bytes());
        }
        RotatedLog::new(LogSpec::at(path.to_owned())).write(&log);
    }

    fn texts(files: &[LogFile], query: &LogQuery) -> Vec<String> {
        newest(files, query, NOW_MS).into_iter().map(|line| line.text).collect()
    }

    #[test]
    fn newest_lines_of_all_files_come_in_order_of_time() {
        let temp = tempfile::tempdir().unwrap();
        let [one, two] = ["one.log", "two.log"].map(|name| temp.path().join(name));
        use LogSource::{Stderr, Stdout};
        write(
            &one,
            &[(NOW_MS - 50, Stdout, "a"), (NOW_MS - 30, Stderr, "c"), (NOW_MS - 10, Stdout, "e")],
        );
        write(&two, &[(NOW_MS - 40, Stdout, "b"), (NOW_MS - 20, Stderr, "[FATAL] d")]);
        let files =
            [file(&one, "one"), file(&two, "two"), file(&temp.path().join("none.log"), "one")];
        assert_eq!(texts(&files, &everything()), ["a", "b", "c", "d", "e"]);
        assert_eq!(texts(&files, &LogQuery { max_lines: 2, ..everything() }), ["d", "e"]);
        assert_eq!(texts(&files, &LogQuery { level: LogLevel::Warn, ..everything() }), ["c", "d"]);
        assert_eq!(
            texts(&files, &LogQuery { task: Some("two".parse().unwrap()), ..everything() }),
            ["b", "d"]
        );
        assert_eq!(
            texts(&files, &LogQuery { since_ms: Some(30), ..everything() }),
            ["c", "d", "e"]
        );
    }

    #[test]
    fn rotated_log_is_read_through_all_its_files() {
        let temp = tempfile::tempdir().unwrap();
        let path = temp.path().join("task.log");
        let mut log = RotatedLog::new(LogSpec { path: path.clone(), max_bytes: 10_000, files: 4 });
        for number in 0..2000u64 {
            let mut line = Vec::new();
            let text = number.to_string();
            record::write(
                &mut line,
                &timestamp(NOW_MS - 2000 + number),
                LogSource::Stdout,
                false,
                text.as_bytes(),
            );
            log.write(&line);
        }
        let found = texts(&[file(&path, "t")], &LogQuery { max_lines: u64::MAX, ..everything() });
        let expected: Vec<String> =
            (2000 - found.len()..2000).map(|number| number.to_string()).collect();
        assert_eq!(found, expected);
        assert!(found.len() > 3 * 10_000 / 33, "lines of all four files: {}", found.len());
    }

    #[test]
    fn result_fits_into_one_message() {
        let temp = tempfile::tempdir().unwrap();
        let path = temp.path().join("task.log");
        let text = "\"".repeat(record::MAX_TEXT_BYTES);
        write(&path, &vec![(NOW_MS, LogSource::Stdout, text.as_str()); 300]);
        let lines =
            newest(&[file(&path, "t")], &LogQuery { max_lines: 300, ..everything() }, NOW_MS);
        let bytes = serde_json::to_vec(&lines).unwrap().len();
        assert!(bytes < MAX_BATCH_BYTES && bytes > MAX_BATCH_BYTES / 2, "{bytes}");
    }

    #[test]
    fn lines_without_a_clock_are_skipped_and_old_lines_end_the_search() {
        let temp = tempfile::tempdir().unwrap();
        let path = temp.path().join("task.log");
        let at = |ago_ms: u64| NOW_MS - ago_ms;
        write(
            &path,
            &[
                (at(100), LogSource::Stdout, "hidden behind an older one"),
                (at(DAY_MS), LogSource::Stdout, "old"),
                (at(90), LogSource::Stdout, "before"),
                (5, LogSource::Stdout, "without a clock"),
                (at(10), LogSource::Stdout, "after"),
            ],
        );
        assert_eq!(
            texts(&[file(&path, "t")], &LogQuery { since_ms: Some(1000), ..everything() }),
            ["before", "after"]
        );
    }

    #[test]
    fn logs_of_earlier_versions_and_damaged_ones_are_read() {
        let temp = tempfile::tempdir().unwrap();
        let path = temp.path().join("task.log");
        std::fs::write(&path, "[taskd: started]\nold\n").unwrap();
        write(&path, &[(NOW_MS, LogSource::Stdout, "new")]);
        let shown = texts(&[file(&path, "t")], &everything());
        assert_eq!(shown, ["[taskd: started]", "old", "new"]);
        std::fs::write(&path, vec![0; 3 * MAX_LINE_BYTES]).unwrap();
        let lines = newest(&[file(&path, "t")], &everything(), NOW_MS);
        assert!(
            lines.iter().all(|line| line.text.len() <= task_proto::telemetry::log::MAX_LINE_BYTES),
            "{}",
            lines.len()
        );
        std::fs::write(&path, "whole\nbeing writ").unwrap();
        assert_eq!(texts(&[file(&path, "t")], &everything()), ["whole"]);
    }
}
