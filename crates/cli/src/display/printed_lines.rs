//! Tracks printed log lines, so that the past and the stream, which overlap, show each line once.
//! Robots do not number lines: a line is identified by its time and text, and two identical lines
//! count as two.

use std::collections::hash_map::DefaultHasher;
use std::collections::{HashMap, VecDeque};
use std::hash::{Hash as _, Hasher as _};

use task_proto::telemetry::log::LogLine;

/// Printed lines that are remembered.
const MAX_REMEMBERED: usize = 20_000;

/// The lines printed lately.
#[derive(Default)]
pub(crate) struct PrintedLines {
    counts: HashMap<u64, Counts>,
    order: VecDeque<u64>,
    newest_ms: u64,
}

#[derive(Default)]
struct Counts {
    /// Number of such lines printed.
    printed: u32,
    /// Number of such lines received by the stream.
    streamed: u32,
}

impl PrintedLines {
    /// Whether to print a line from the stream: false if the past already contained the line.
    pub(crate) fn accept_streamed(&mut self, line: &LogLine) -> bool {
        let counts = self.counts(line);
        counts.streamed += 1;
        let is_new = counts.streamed > counts.printed;
        counts.printed = counts.printed.max(counts.streamed);
        if is_new {
            self.newest_ms = self.newest_ms.max(line.at_ms);
        }
        is_new
    }

    /// The past lines that were not printed and come after the printed ones.
    pub(crate) fn unprinted(&mut self, past: &[LogLine]) -> Vec<LogLine> {
        let is_known =
            |line: &LogLine| self.counts.get(&key(line)).is_some_and(|counts| counts.printed > 0);
        let newest_ms = self.newest_ms;
        // Lines before the first printed one were not requested.
        let begin = past.iter().position(is_known);
        let begin = begin
            .or_else(|| past.iter().position(|line| line.at_ms > newest_ms))
            .unwrap_or(past.len());
        let mut met: HashMap<u64, u32> = HashMap::new();
        let mut missing = Vec::new();
        for line in &past[begin..] {
            let nth = met.entry(key(line)).or_default();
            *nth += 1;
            let nth = *nth;
            let counts = self.counts(line);
            if nth > counts.printed {
                counts.printed = nth;
                self.newest_ms = self.newest_ms.max(line.at_ms);
                missing.push(line.clone());
            }
        }
        missing
    }

    fn counts(&mut self, line: &LogLine) -> &mut Counts {
        let key = key(line);
        if !self.counts.contains_key(&key) {
            self.order.push_back(key);
            if self.order.len() > MAX_REMEMBERED
                && let Some(oldest) = self.order.pop_front()
            {
                self.counts.remove(&oldest);
            }
        }
        self.counts.entry(key).or_default()
    }
}

/// A node's message that appears both on its topic and on its standard error counts as one line, in
/// either order.
fn key(line: &LogLine) -> u64 {
    let mut hasher = DefaultHasher::new();
    (line.at_ms, line.level, &line.task, &line.node, &line.text).hash(&mut hasher);
    hasher.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::telemetry::log::{LogLevel, LogSource};

    fn line(at_ms: u64, text: &str) -> LogLine {
        let (level, source) = (LogLevel::Info, LogSource::Stdout);
        LogLine { at_ms, level, source, task: None, node: None, text: text.to_owned() }
    }

    fn texts(lines: &[LogLine]) -> Vec<&str> {
        lines.iter().map(|line| line.text.as_str()).collect()
    }

    #[test]
    fn past_and_stream_join_without_gap_or_duplicate() {
        let mut printed = PrintedLines::default();
        assert_eq!(
            texts(&printed.unprinted(&[line(1, "a"), line(2, "b"), line(2, "b")])),
            ["a", "b", "b"]
        );
        let stream = [line(2, "b"), line(2, "b"), line(2, "b"), line(3, "c")]
            .map(|line| printed.accept_streamed(&line));
        assert_eq!(stream, [false, false, true, true], "three equal lines are three lines");
    }

    #[test]
    fn only_missed_lines_are_printed_after_a_break() {
        let mut printed = PrintedLines::default();
        printed.unprinted(&[line(10, "a"), line(11, "b")]);
        assert!(printed.accept_streamed(&line(12, "c")));
        let past = [
            line(8, "older"),
            line(10, "a"),
            line(11, "b"),
            line(12, "c"),
            line(13, "d"),
            line(14, "e"),
        ];
        assert_eq!(texts(&printed.unprinted(&past)), ["d", "e"]);
        assert!(!printed.accept_streamed(&line(14, "e")), "it came late");
        assert_eq!(
            texts(&printed.unprinted(&[line(9, "x"), line(30, "f")])),
            ["f"],
            "nothing of it is known any more"
        );
        assert_eq!(texts(&printed.unprinted(&[])), Vec::<&str>::new());
    }

    #[test]
    fn memory_is_bounded() {
        let mut printed = PrintedLines::default();
        for at_ms in 0..2 * MAX_REMEMBERED as u64 {
            assert!(printed.accept_streamed(&line(at_ms, "x")));
        }
        assert_eq!((printed.counts.len(), printed.order.len()), (MAX_REMEMBERED, MAX_REMEMBERED));
    }
}
