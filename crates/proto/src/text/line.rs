//! Lines of a program's own log. Names and texts from others in an event can't break its line or
//! control the terminal. Wraps the log's writer; opens no files.

use std::io::{self, Write};

/// Replaces a character that is not allowed in a line.
const REPLACEMENT: char = '\u{fffd}';

/// Writes each event, which arrives in one piece, as one line.
pub struct SingleLineWriter<W> {
    to: W,
    has_colours: bool,
}

impl<W: Write> SingleLineWriter<W> {
    /// A writer to `to`. `has_colours`: the log's formatter puts escape sequences into events, and
    /// makes those in values harmless.
    pub fn new(to: W, has_colours: bool) -> Self {
        Self { to, has_colours }
    }
}

impl<W: Write> Write for SingleLineWriter<W> {
    fn write(&mut self, event: &[u8]) -> io::Result<usize> {
        self.to
            .write_all(one_line(&String::from_utf8_lossy(event), self.has_colours).as_bytes())?;
        Ok(event.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

fn one_line(event: &str, has_colours: bool) -> String {
    let harmless = |c: char| match c {
        '\x1b' if has_colours => c,
        '\t' => ' ',
        '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => REPLACEMENT,
        _ if c.is_control() => REPLACEMENT,
        _ => c,
    };
    let mut line: String =
        event.strip_suffix('\n').unwrap_or(event).chars().map(harmless).collect();
    line.push('\n');
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn event_is_one_line_with_any_content() {
        let written = |event: &[u8], has_colours| {
            let mut to = Vec::new();
            SingleLineWriter::new(&mut to, has_colours).write_all(event).expect("written");
            String::from_utf8(to).expect("text")
        };
        assert_eq!(written("WARN a robot: ärger\n".as_bytes(), false), "WARN a robot: ärger\n");
        let bad =
            "\u{1b}[31mname=a\nERROR forged\r\u{1b}[2J\u{9b}31m\u{7}\u{8}\0\t\u{202e}\u{2028}end";
        for (has_colours, escapes) in [(false, 0), (true, 2)] {
            let line = written(bad.as_bytes(), has_colours);
            assert!(
                line.ends_with(" \u{fffd}\u{fffd}end\n") && line.contains("ERROR forged"),
                "{line:?}"
            );
            assert_eq!(line.chars().filter(|c| c.is_control()).count(), escapes + 1, "{line:?}");
            assert_eq!(line.matches('\u{1b}').count(), escapes, "{line:?}");
        }
        assert_eq!(written(b"\xff\n\n", false), "\u{fffd}\u{fffd}\n");
    }
}
