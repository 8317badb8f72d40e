//! The format of a stored line, easy to read with `tail`:
//!
//! ```text
//! 2026-11-21T10:00:00.123Z O hello
//! 2026-11-21T10:00:00.124Z E Traceback (most recent call last):
//! ```
//!
//! The letter is the source of the line: `O` standard output, `E` standard error, `R` `/rosout`,
//! `D` `/diagnostics`, `B` the build, `T` the agent. A small letter marks the continuation of the
//! line before, which was too long, or whose end came late. Lines of earlier versions have no time
//! and no letter. The module never changes a text.

use task_proto::telemetry::log::{LogLevel, LogSource};
use task_proto::time::{parse_timestamp, timestamp};

use super::console;

/// Maximum text length of a stored line; a longer line continues in the next record.
pub const MAX_TEXT_BYTES: usize = 4000;
/// Length of a time in bytes.
const STAMP_BYTES: usize = 24;
/// Bytes before the text: the time, the letter and a space after each.
pub const PREFIX_BYTES: usize = STAMP_BYTES + 3;
/// Marks the beginning of each run's output.
const START: &[u8] = b"started";
/// The same mark as written by earlier versions.
const OLD_START: &[u8] = b"[taskd: started]";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Record<'a> {
    /// Time of writing, by the robot's clock.
    pub at_ms: Option<u64>,
    /// Source of the line.
    pub source: Option<LogSource>,
    /// Whether the record continues the line before.
    pub continues: bool,
    /// The text as it arrived.
    pub text: &'a [u8],
}

impl<'a> Record<'a> {
    /// Parses a line without its end; a line without time and letter is all text.
    pub fn parse(line: &'a [u8]) -> Self {
        Self::stamped(line).unwrap_or(Self {
            at_ms: None,
            source: None,
            continues: false,
            text: line,
        })
    }

    fn stamped(line: &'a [u8]) -> Option<Self> {
        let (prefix, text) = line.split_at_checked(PREFIX_BYTES)?;
        let prefix = std::str::from_utf8(prefix).ok()?;
        let (stamp, letter) = prefix.split_at_checked(STAMP_BYTES)?;
        let letter = letter.strip_prefix(' ')?.strip_suffix(' ')?;
        let source = source_of(letter.bytes().next()?.to_ascii_uppercase())?;
        let continues = letter.bytes().all(|byte| byte.is_ascii_lowercase());
        Some(Self { at_ms: Some(parse_timestamp(stamp)?), source: Some(source), continues, text })
    }

    /// Whether a run begins at this record.
    pub fn is_start(&self) -> bool {
        match self.source {
            Some(source) => source == LogSource::Agent && self.text == START,
            None => self.text == OLD_START,
        }
    }

    /// Severity of the line: from its own text, else from its source. `unmarked` is the source of a
    /// line that names none.
    pub fn level(&self, unmarked: LogSource) -> LogLevel {
        // Most lines have no bracket near their beginning, and this check runs for each line.
        let may_say = self.text.iter().take(64).any(|byte| *byte == b'[');
        let said = may_say
            .then(|| console::parse(&console::printable(self.text)).map(|said| said.level))
            .flatten();
        said.unwrap_or_else(|| Self::level_of_source(self.source.unwrap_or(unmarked)))
    }

    /// Severity of a line whose text names none.
    pub fn level_of_source(source: LogSource) -> LogLevel {
        if source == LogSource::Stderr { LogLevel::Warn } else { LogLevel::Info }
    }
}

/// Adds one line to `log`.
pub fn write(log: &mut Vec<u8>, stamp: &str, source: LogSource, continues: bool, text: &[u8]) {
    let letter = letter_of(source);
    log.extend_from_slice(stamp.as_bytes());
    log.extend_from_slice(&[
        b' ',
        if continues { letter.to_ascii_lowercase() } else { letter },
        b' ',
    ]);
    log.extend_from_slice(text);
    log.push(b'\n');
}

/// Adds the line that a run begins with.
pub fn write_start(log: &mut Vec<u8>, now_ms: u64) {
    write(log, &timestamp(now_ms), LogSource::Agent, false, START);
}

fn letter_of(source: LogSource) -> u8 {
    match source {
        LogSource::Stdout => b'O',
        LogSource::Stderr => b'E',
        LogSource::Rosout => b'R',
        LogSource::Diagnostics => b'D',
        LogSource::Build => b'B',
        LogSource::Agent => b'T',
    }
}

fn source_of(letter: u8) -> Option<LogSource> {
    Some(match letter {
        b'O' => LogSource::Stdout,
        b'E' => LogSource::Stderr,
        b'R' => LogSource::Rosout,
        b'D' => LogSource::Diagnostics,
        b'B' => LogSource::Build,
        b'T' => LogSource::Agent,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const STAMP: &str = "2026-11-21T10:00:00.123Z";

    #[test]
    fn stored_line_reads_back_with_any_bytes() {
        for (source, continues) in [(LogSource::Stdout, false), (LogSource::Diagnostics, true)] {
            let mut log = Vec::new();
            write(&mut log, STAMP, source, continues, b"\xff O \x1b[0m");
            let record = Record::parse(log.strip_suffix(b"\n").expect("a line"));
            assert_eq!(record.at_ms, parse_timestamp(STAMP));
            assert_eq!(
                (record.source, record.continues, record.text),
                (Some(source), continues, &b"\xff O \x1b[0m"[..])
            );
        }
        let mut log = Vec::new();
        write_start(&mut log, 5);
        assert_eq!(log, b"1970-01-01T00:00:00.005Z T started\n");
        assert!(Record::parse(log.trim_ascii_end()).is_start());
    }

    #[test]
    fn lines_of_earlier_versions_and_damaged_ones_are_text() {
        for line in [
            "",
            "hello",
            "2026-11-21T10:00:00.123Z",
            "2026-11-21T10:00:00.123Z X text",
            "2026-11-21T10:00:00.123ZOOtext é",
        ] {
            let record = Record::parse(line.as_bytes());
            assert_eq!((record.at_ms, record.source, record.text), (None, None, line.as_bytes()));
        }
        assert!(Record::parse(b"[taskd: started]").is_start());
        assert!(!Record::parse(b"started").is_start());
    }

    #[test]
    fn level_comes_from_the_line_or_its_source() {
        let level = |line: &str| Record::parse(line.as_bytes()).level(LogSource::Stdout);
        assert_eq!(level("plain"), LogLevel::Info);
        assert_eq!(level(&format!("{STAMP} O plain")), LogLevel::Info);
        assert_eq!(level(&format!("{STAMP} E [plain]")), LogLevel::Warn);
        assert_eq!(level(&format!("{STAMP} E [INFO] [1.2] [node]: text")), LogLevel::Info);
        assert_eq!(level(&format!("{STAMP} O \x1b[31m[FATAL] [1.2]: text")), LogLevel::Fatal);
    }
}
