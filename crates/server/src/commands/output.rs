//! What people and programs read: results on stdout as table or JSON, everything else on stderr. A reader that goes away
//! (a closed pipe) is no error: what it no longer wants is dropped.

use std::io::{self, IsTerminal as _, Write as _};

use comfy_table::{ContentArrangement, Table};
use serde::Serialize;

use super::CommandError;

/// How results are printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// For people.
    Table,
    /// For programs: one JSON document.
    Json,
}

/// The command's way to its reader.
pub(crate) struct Output {
    format: Format,
}

impl Output {
    pub(crate) fn new(format: Format) -> Self {
        Self { format }
    }

    /// How results are printed.
    pub(crate) fn format(&self) -> Format {
        self.format
    }

    /// Prints `value`: as JSON, or as the table that `rows` makes of it.
    pub(crate) fn result<T: Serialize>(
        &self,
        value: &T,
        header: &[&str],
        rows: impl FnOnce(&T) -> Vec<Vec<String>>,
    ) -> Result<(), CommandError> {
        let text = match self.format {
            Format::Json => json(value)?,
            Format::Table => table(header, rows(value)),
        };
        print(&text)
    }

    /// Prints `value`: as JSON, or as the text that `describe` makes of it.
    pub(crate) fn described<T: Serialize>(
        &self,
        value: &T,
        describe: impl FnOnce(&T) -> String,
    ) -> Result<(), CommandError> {
        let text = match self.format {
            Format::Json => json(value)?,
            Format::Table => shown(&describe(value)),
        };
        print(&text)
    }
}

fn json<T: Serialize>(value: &T) -> Result<String, CommandError> {
    serde_json::to_string_pretty(value).map(escaped).map_err(unprintable)
}

fn unprintable(error: serde_json::Error) -> CommandError {
    CommandError::Io { what: "can't print the result".to_owned(), source: error.into() }
}

/// One of many values, on one line.
pub(crate) fn json_line<T: Serialize>(value: &T) -> Result<String, CommandError> {
    serde_json::to_string(value).map(escaped).map_err(unprintable)
}

/// JSON as a terminal may see it: the control characters that JSON itself allows, which lie in texts only, are escaped.
fn escaped(json: String) -> String {
    if !json.contains(is_c1) {
        return json;
    }
    let escape = |c: char| if is_c1(c) { format!("\\u{:04x}", u32::from(c)) } else { c.to_string() };
    json.chars().map(escape).collect()
}

fn is_c1(c: char) -> bool {
    matches!(c, '\u{7f}'..='\u{9f}')
}

fn print(text: &str) -> Result<(), CommandError> {
    stream_text(&format!("{}\n", text.trim_end())).map(drop)
}

/// Prints a part of what goes on; false when nobody reads it any more.
pub(crate) fn stream_text(text: &str) -> Result<bool, CommandError> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(CommandError::Io { what: "can't write to stdout".to_owned(), source: error }),
    }
}

/// A table without lines, its columns two spaces apart.
pub(crate) fn table(header: &[&str], rows: Vec<Vec<String>>) -> String {
    let mut table = Table::new();
    table.load_style(comfy_table::presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(header.iter().map(|title| title.to_uppercase()));
    for row in rows {
        table.add_row(row.into_iter().map(|cell| printable(&cell)));
    }
    // Each cell has a space on both sides, which is wanted between columns only.
    let line = |line: String| line.trim_end().strip_prefix(' ').unwrap_or_default().to_owned();
    table.lines().map(line).collect::<Vec<_>>().join("\n")
}

/// `text` on one line and without control characters, nor those that turn a line's direction: a robot or a package may
/// have put them there.
pub(crate) fn printable(text: &str) -> String {
    let turns = |c: char| matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    text.chars().map(|c| if c.is_control() || turns(c) { ' ' } else { c }).collect()
}

/// The same for a text of several lines, which stay.
fn shown(text: &str) -> String {
    text.split('\n').map(printable).collect::<Vec<_>>().join("\n")
}

/// Says `text` on stderr: a server's or a robot's words may be in it. Nobody may be listening, which is no reason to fail.
pub(crate) fn say(text: &str) {
    let _ = writeln!(io::stderr().lock(), "{}", shown(text));
}

/// Says what went wrong and why, the whole chain.
pub(crate) fn complain(error: &CommandError) {
    let mut text = format!("taskd: {error}");
    let mut source = std::error::Error::source(error);
    while let Some(cause) = source {
        text.push_str(&format!(": {cause}"));
        source = cause.source();
    }
    say(&text);
}

/// Whether a person sees stderr, so that progress may move.
pub(crate) fn stderr_is_terminal() -> bool {
    io::stderr().is_terminal()
}

/// Milliseconds since the Unix epoch as `2026-01-31 08:05:09Z`.
pub(crate) fn time(ms: u64) -> String {
    let text = task_proto::time::timestamp(ms);
    format!("{} {}Z", &text[..10], &text[11..19])
}

/// So many robots, as people say it.
pub(crate) fn robots(count: u64) -> String {
    if count == 1 { "1 robot".to_owned() } else { format!("{count} robots") }
}

/// Bytes as people read them.
pub(crate) fn bytes(count: u64) -> String {
    indicatif::HumanBytes(count).to_string()
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
    fn what_a_terminal_would_obey_is_not_printed() {
        assert_eq!(printable("a\u{1b}[31m\u{9b}2Jb\u{202e}c\u{2066}d\n"), "a [31m 2Jb c d ");
        assert_eq!(shown("a\u{1b}[31m\nb\r\n"), "a [31m\nb \n");
        let text = "\u{1b}]0;x\u{7}\u{9b}2J\u{7f} é";
        let line = json_line(&text).unwrap();
        assert_eq!(line, r#""\u001b]0;x\u0007\u009b2J\u007f é""#);
        assert_eq!(serde_json::from_str::<String>(&line).unwrap(), text, "programs read what was meant");
    }

    #[test]
    fn a_table_has_a_header_and_no_lines() {
        let text = table(&["id", "name"], vec![vec!["r1".to_owned(), "a\u{1b}[31mb\nc".to_owned()]]);
        assert_eq!(text, "ID  NAME\nr1  a [31mb c");
    }
}
