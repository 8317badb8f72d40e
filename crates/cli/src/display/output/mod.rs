//! Output for people and programs: results on stdout as table or JSON, everything else on stderr. A
//! closed pipe is no error: the remaining output is dropped.

pub(crate) mod table;

use std::io::{self, IsTerminal as _, Write as _};

use serde::Serialize;
use task_proto::Digest;
use task_proto::error_chain::chain;

use self::table::{Columns, TableLayout, table};
use crate::CommandError;

/// How results are printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// A table that fits the terminal
    Table,
    /// A table with more columns, untruncated
    Wide,
    /// One JSON document
    Json,
    /// Names only, one per line
    Name,
}

/// Prints results in the requested format.
pub(crate) struct Output {
    format: Format,
    layout: TableLayout,
}

impl Output {
    pub(crate) fn new(format: Format) -> Self {
        let is_terminal = io::stdout().is_terminal();
        let colours =
            is_terminal && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
        let wide = format == Format::Wide;
        let width = (is_terminal && !wide).then(terminal_width).flatten();
        Self { format, layout: TableLayout { wide, width, colours } }
    }

    pub(crate) fn format(&self) -> Format {
        self.format
    }

    /// Whether colours may be used in addition to words.
    pub(crate) fn has_colours(&self) -> bool {
        self.layout.colours
    }

    /// A table in the layout of this output.
    pub(crate) fn table(&self, columns: &Columns, rows: &[Vec<String>]) -> String {
        table(columns, rows, self.layout)
    }

    /// Prints `value` as JSON, in every format.
    pub(crate) fn print_json<T: Serialize>(&self, value: &T) -> Result<(), CommandError> {
        print(&json(value)?).map(drop)
    }

    /// Prints a text whose parts contain no terminal control characters.
    pub(crate) fn print_text(&self, text: &str) -> Result<(), CommandError> {
        print(text).map(drop)
    }

    /// Prints names, one per line.
    pub(crate) fn print_names(
        &self,
        lines: impl Iterator<Item = impl AsRef<str>>,
    ) -> Result<(), CommandError> {
        print(&lines.map(|line| printable(line.as_ref())).collect::<Vec<_>>().join("\n")).map(drop)
    }

    /// Prints the list `value`: as JSON, or as the rows that `rows` makes of the list.
    pub(crate) fn print_list<T: Serialize>(
        &self,
        value: &T,
        columns: &Columns,
        rows: impl FnOnce(&T) -> Vec<Vec<String>>,
    ) -> Result<(), CommandError> {
        self.print_next_list(value, columns, rows).map(drop)
    }

    /// Prints one of many successive lists; false once the reader has closed the pipe.
    pub(crate) fn print_next_list<T: Serialize>(
        &self,
        value: &T,
        columns: &Columns,
        rows: impl FnOnce(&T) -> Vec<Vec<String>>,
    ) -> Result<bool, CommandError> {
        let text = match self.format {
            Format::Json => json(value)?,
            Format::Table | Format::Wide => self.table(columns, &rows(value)),
            Format::Name => columns.names(&rows(value)).join("\n"),
        };
        print(&text)
    }

    /// Prints the single `value`: as JSON, as its name, or as the text that `describe` makes of the
    /// value. The parts of that text contain no terminal control characters.
    pub(crate) fn print_object<T: Serialize>(
        &self,
        value: &T,
        name: impl FnOnce(&T) -> String,
        describe: impl FnOnce(&T) -> String,
    ) -> Result<(), CommandError> {
        let text = match self.format {
            Format::Json => json(value)?,
            Format::Table | Format::Wide => describe(value),
            Format::Name => name(value).lines().map(printable).collect::<Vec<_>>().join("\n"),
        };
        print(&text).map(drop)
    }
}

fn terminal_width() -> Option<usize> {
    let (terminal_size::Width(width), _) = terminal_size::terminal_size_of(io::stdout())?;
    (width > 0).then_some(usize::from(width))
}

/// Facts a line each, their names in a column.
pub(crate) fn facts<'a>(facts: impl IntoIterator<Item = (&'a str, String)>) -> String {
    facts.into_iter().map(|(key, value)| format!("{key:<12}{}\n", printable(&value))).collect()
}

fn json<T: Serialize>(value: &T) -> Result<String, CommandError> {
    serde_json::to_string_pretty(value).map(escaped).map_err(unprintable)
}

fn unprintable(error: serde_json::Error) -> CommandError {
    CommandError::Io { what: "can't print the result".to_owned(), source: error.into() }
}

/// Prints one of many values, on one line.
pub(crate) fn json_line<T: Serialize>(value: &T) -> Result<String, CommandError> {
    serde_json::to_string(value).map(escaped).map_err(unprintable)
}

/// JSON that is safe on a terminal: control characters that JSON allows, which occur only in
/// strings, are escaped.
fn escaped(json: String) -> String {
    if !json.contains(is_c1) {
        return json;
    }
    let escape =
        |c: char| if is_c1(c) { format!("\\u{:04x}", u32::from(c)) } else { c.to_string() };
    json.chars().map(escape).collect()
}

fn is_c1(c: char) -> bool {
    matches!(c, '\u{7f}'..='\u{9f}')
}

fn print(text: &str) -> Result<bool, CommandError> {
    match text.trim_end() {
        "" => Ok(true),
        text => stream_text(&format!("{text}\n")),
    }
}

/// Prints a part of a stream; false once the reader has closed the pipe.
pub(crate) fn stream_text(text: &str) -> Result<bool, CommandError> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => {
            Err(CommandError::Io { what: "can't write to stdout".to_owned(), source: error })
        }
    }
}

/// `text` on one line, without control characters and bidirectional controls, which a robot or a
/// package may have inserted.
pub(crate) fn printable(text: &str) -> String {
    let turns = |c: char| matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    text.chars().map(|c| if c.is_control() || turns(c) { ' ' } else { c }).collect()
}

/// The printable form of a text of several lines; line breaks stay.
fn shown(text: &str) -> String {
    text.split('\n').map(printable).collect::<Vec<_>>().join("\n")
}

/// Prints `text` on stderr; the text may contain words of a server or a robot. A closed stderr is
/// no reason to fail.
pub(crate) fn say(text: &str) {
    let _ = writeln!(io::stderr().lock(), "{}", shown(text));
}

/// Prints an error with its whole chain of causes.
pub(crate) fn print_error(error: &CommandError) {
    say(&format!("taskd: {}", chain(error)));
}

/// Whether stderr is a terminal, so that progress bars may be drawn.
pub(crate) fn stderr_is_terminal() -> bool {
    io::stderr().is_terminal()
}

/// Milliseconds since the Unix epoch as `2026-01-31 08:05:09Z`.
pub(crate) fn time(ms: u64) -> String {
    let text = task_proto::time::timestamp(ms);
    format!("{} {}Z", &text[..10], &text[11..19])
}

/// A number of robots in words.
pub(crate) fn robots(count: u64) -> String {
    if count == 1 { "1 robot".to_owned() } else { format!("{count} robots") }
}

/// A digest prefix long enough to tell versions apart.
pub(crate) fn short_digest(digest: &Digest) -> String {
    digest.hex()[..12].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_civil_dates() {
        assert_eq!(time(0), "1970-01-01 00:00:00Z");
        assert_eq!(time(951_782_400_000), "2000-02-29 00:00:00Z");
        assert_eq!(time(1_704_067_199_999), "2023-12-31 23:59:59Z");
    }

    #[test]
    fn terminal_control_characters_are_not_printed() {
        assert_eq!(printable("a\u{1b}[31m\u{9b}2Jb\u{202e}c\u{2066}d\n"), "a [31m 2Jb c d ");
        assert_eq!(shown("a\u{1b}[31m\nb\r\n"), "a [31m\nb \n");
        let text = "\u{1b}]0;x\u{7}\u{9b}2J\u{7f} é";
        let line = json_line(&text).unwrap();
        assert_eq!(line, r#""\u001b]0;x\u0007\u009b2J\u007f é""#);
        assert_eq!(
            serde_json::from_str::<String>(&line).unwrap(),
            text,
            "programs read the exact value"
        );
    }
}
