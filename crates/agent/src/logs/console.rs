//! Parses the lines that ROS nodes print, and turns arbitrary bytes into text that is safe to show.
//! ROS 2 prints `[INFO] [1700000000.123456789] [talker]: text`. ROS 1 pads the level, may add the
//! simulated time and colours, and names no node. `ros2 launch` puts `[talker-1] ` before the line.
//! The module keeps no state.

use task_proto::ids::GraphName;
use task_proto::telemetry::log::{LogLevel, MAX_LINE_BYTES};

/// Replaces a byte or character that must not reach a terminal.
const REPLACEMENT: char = char::REPLACEMENT_CHARACTER;
/// Marks the end of a text that was cut.
const ELLIPSIS: char = '…';

/// A parsed line in console format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConsoleLine<'a> {
    /// Severity of the line.
    pub level: LogLevel,
    /// Time of the line, as the node wrote it.
    pub stamp: Option<&'a str>,
    /// The logger, where the line names one.
    pub logger: Option<&'a str>,
    /// The rest of the line.
    pub text: &'a str,
}

/// Parses a line in console format; `None` for any other. `line` is the output of [`printable`].
pub fn parse(line: &str) -> Option<ConsoleLine<'_>> {
    let line = line.trim_start();
    let (first, rest) = bracket(line)?;
    let (level, rest) = match level_of(first) {
        Some(level) => (level, rest),
        // Lines of processes that a launch file started have the process's name and number first.
        None => {
            bracket(rest.trim_start()).and_then(|(second, rest)| Some((level_of(second)?, rest)))?
        }
    };
    let unstamped = ConsoleLine {
        level,
        stamp: None,
        logger: None,
        text: rest.trim_start_matches(':').trim_start(),
    };
    let Some((stamp, rest)) = bracket(rest.trim_start()).filter(|(stamp, _)| is_stamp(stamp))
    else {
        return Some(unstamped);
    };
    let (logger, rest) = match bracket(rest.trim_start()) {
        Some((logger, rest)) if rest.starts_with(':') => (Some(logger), rest),
        _ => (None, rest),
    };
    let text = rest.strip_prefix(':').unwrap_or(rest).trim_start();
    Some(ConsoleLine { level, stamp: Some(stamp), logger, text })
}

/// The node of a logger, by its name: `robot.talker` belongs to `/robot/talker`.
pub fn node_of(logger: &str) -> Option<GraphName> {
    format!("/{}", logger.replace('.', "/")).parse().ok()
}

/// `bytes` as one line of readable text: no colours, no control characters, no characters that
/// change the direction of writing, at most [`MAX_LINE_BYTES`].
pub fn printable(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes);
    let mut shown = String::with_capacity(text.len().min(MAX_LINE_BYTES));
    let mut characters = text.trim_end().chars().peekable();
    while let Some(character) = characters.next() {
        match character {
            '\x1b' => skip_escape(&mut characters),
            '\t' => shown.push(' '),
            '\n' => shown.push_str(" ⏎ "),
            '\r' if characters.peek() == Some(&'\n') => {}
            '\r' => shown.push(' '),
            _ if is_unsafe(character) => shown.push(REPLACEMENT),
            _ => shown.push(character),
        }
    }
    cut(shown)
}

/// Skips the sequence after ESC: a colour or another terminal command.
fn skip_escape(characters: &mut std::iter::Peekable<std::str::Chars<'_>>) {
    match characters.peek() {
        Some('[') => {
            characters.next();
            while characters.next_if(|next| matches!(next, '\x20'..='\x3f')).is_some() {}
            characters.next_if(|next| matches!(next, '\x40'..='\x7e'));
        }
        // A title or a link: up to BEL or ESC \, whose ESC is the next to be skipped.
        Some(']') => while characters.next_if(|next| !matches!(next, '\x07' | '\x1b')).is_some() {},
        Some('\x20'..='\x7e') => {
            characters.next();
        }
        _ => {}
    }
    characters.next_if_eq(&'\x07');
}

fn is_unsafe(character: char) -> bool {
    let turns_direction = matches!(character, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    character.is_control() || turns_direction || matches!(character, '\u{2028}' | '\u{2029}')
}

fn cut(mut text: String) -> String {
    if text.len() > MAX_LINE_BYTES {
        let mut end = MAX_LINE_BYTES - ELLIPSIS.len_utf8();
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        text.truncate(end);
        text.push(ELLIPSIS);
    }
    text
}

/// The contents of the bracket that `text` begins with, and the text after it.
fn bracket(text: &str) -> Option<(&str, &str)> {
    text.strip_prefix('[')?.split_once(']')
}

fn level_of(word: &str) -> Option<LogLevel> {
    Some(match word.trim() {
        "DEBUG" => LogLevel::Debug,
        "INFO" => LogLevel::Info,
        "WARN" | "WARNING" => LogLevel::Warn,
        "ERROR" => LogLevel::Error,
        "FATAL" => LogLevel::Fatal,
        _ => return None,
    })
}

/// Recognizes a time such as `1700000000.123456789`. ROS 1 adds the simulated time after it, and
/// its Python version once puts a word before it.
fn is_stamp(text: &str) -> bool {
    let text = text.strip_prefix("WallTime: ").unwrap_or(text);
    text.starts_with(|first: char| first.is_ascii_digit())
        && text.chars().all(|c| c.is_ascii_digit() || matches!(c, '.' | ',' | ' '))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(line: &str) -> Option<(LogLevel, Option<String>, Option<String>, String)> {
        let line = printable(line.as_bytes());
        let said = parse(&line)?;
        Some((
            said.level,
            said.stamp.map(str::to_owned),
            said.logger.map(str::to_owned),
            said.text.to_owned(),
        ))
    }

    fn expected(
        level: LogLevel,
        stamp: &str,
        logger: &str,
        text: &str,
    ) -> Option<(LogLevel, Option<String>, Option<String>, String)> {
        let some = |text: &str| (!text.is_empty()).then(|| text.to_owned());
        Some((level, some(stamp), some(logger), text.to_owned()))
    }

    #[test]
    fn console_formats_of_ros_1_and_2_are_parsed() {
        use LogLevel::{Debug, Error, Fatal, Info, Warn};
        for (line, meant) in [
            (
                "[INFO] [1700000000.123456789] [talker]: hello [you]: there",
                expected(Info, "1700000000.123456789", "talker", "hello [you]: there"),
            ),
            (
                "\x1b[33m[WARN] [1700000000.1] [a.b_c]: low\x1b[0m",
                expected(Warn, "1700000000.1", "a.b_c", "low"),
            ),
            (
                "[talker-1] [ERROR] [1700000000.1] [talker]: no",
                expected(Error, "1700000000.1", "talker", "no"),
            ),
            (
                "\x1b[0m[ INFO] [1700000000.123456]: up\x1b[0m",
                expected(Info, "1700000000.123456", "", "up"),
            ),
            (
                "[ WARN] [1700000000.1, 12.500]: late",
                expected(Warn, "1700000000.1, 12.500", "", "late"),
            ),
            (
                "[FATAL] [WallTime: 1700000000.1] gone",
                expected(Fatal, "WallTime: 1700000000.1", "", "gone"),
            ),
            ("[DEBUG] [1700000000.1]: [x] is y", expected(Debug, "1700000000.1", "", "[x] is y")),
            (
                "[ERROR] [launch]: process has died",
                expected(Error, "", "", "[launch]: process has died"),
            ),
            ("[WARNING] disk", expected(Warn, "", "", "disk")),
        ] {
            assert_eq!(said(line), meant, "{line}");
        }
    }

    #[test]
    fn other_lines_are_not_parsed() {
        for line in [
            "",
            "plain",
            "[",
            "[]",
            "[x] [y] [INFO] z",
            "INFO: x",
            "array[INFO]",
            "[info] x",
            "[1.2] [INFORMATION] x",
        ] {
            assert_eq!(said(line), None, "{line}");
        }
    }

    #[test]
    fn logger_names_its_node() {
        assert_eq!(node_of("robot.talker").expect("a name").as_str(), "/robot/talker");
        for other in ["", "talker-1", "a..b", "1st"] {
            assert_eq!(node_of(other), None, "{other}");
        }
    }

    #[test]
    fn control_characters_are_removed() {
        let shown = |bytes: &[u8]| printable(bytes);
        assert_eq!(
            shown(b"\x1b[1;31mred\x1b[0m \x1b]0;title\x07x \x1b]8;;u\x1b\\link"),
            "red x link"
        );
        assert_eq!(shown(b"a\tb\r\n"), "a b");
        assert_eq!(shown(b"a\nb"), "a ⏎ b");
        assert_eq!(shown(b"\x00\x07\x7f\xff"), "\u{fffd}\u{fffd}\u{fffd}\u{fffd}");
        assert_eq!(shown("\u{202e}\u{9b}31m\u{2028}x".as_bytes()), "\u{fffd}\u{fffd}31m\u{fffd}x");
        assert_eq!(shown(b"cut in an escape \x1b[3"), "cut in an escape ");
        let long = shown("é".repeat(MAX_LINE_BYTES).as_bytes());
        assert!(long.len() <= MAX_LINE_BYTES && long.ends_with("é…"));
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_become_one_bounded_line(bytes in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..6000)) {
            let shown = printable(&bytes);
            proptest::prop_assert!(shown.len() <= MAX_LINE_BYTES && !shown.contains(is_unsafe));
            let _ = parse(&shown);
        }
    }
}
