//! Keys of TOML files in messages for people: the line of a key, and the known key that a mistyped
//! one is closest to. Never judges a value.

use std::ops::Range;

use toml::de::{DeTable, DeValue};

/// An error in a file of settings, with its place.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileProblem {
    /// The line, from 1, if the error belongs to one.
    pub line: Option<usize>,
    /// The error, which begins with the key.
    pub text: String,
}

impl FileProblem {
    /// A problem with `key` of the file with this `content`.
    pub fn of_key(content: &str, key: &str, reason: &str) -> Self {
        Self { line: key_line(content, key), text: format!("{key}: {reason}") }
    }

    /// As compilers write it: `FILE:LINE: KEY: REASON`.
    pub fn at(&self, file: &str) -> String {
        let line = self.line.map(|line| format!("{line}:")).unwrap_or_default();
        format!("{file}:{line} {}", self.text)
    }
}

/// One key of a file of settings, as the reference of all keys shows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct KeyReference<'a> {
    /// The key with its table, like `limits.log_bytes`.
    pub key: &'a str,
    /// The environment variable with the same effect, if there is one.
    pub variable: Option<&'a str>,
    /// The default as it is written in the file, or in words; empty: the setting is off or absent.
    pub default: &'a str,
    /// The meaning of the key.
    pub meaning: &'a str,
}

/// A Markdown table of keys.
pub fn reference_table(keys: &[KeyReference<'_>]) -> String {
    let has_variables = keys.iter().any(|key| key.variable.is_some());
    let code = |text: &str| match text {
        "" => String::new(),
        text => format!("`{}`", text.replace('|', "\\|")),
    };
    let row = |key: String, default: String, variable: String, meaning: &str| {
        let variable = if has_variables { format!(" {variable} |") } else { String::new() };
        let row = format!("| {key} | {default} |{variable} {meaning} |\n");
        row.replace("|  |", "| |").replace("|  |", "| |")
    };
    let mut table = row("key".into(), "default".into(), "variable".into(), "meaning");
    table += &row("--".into(), "--".into(), "--".into(), "--");
    for key in keys {
        // A default in words is no text of the file.
        let is_words = key.default.contains(' ') || key.default == "none";
        let is_literal = !is_words || key.default.starts_with(['"', '[']);
        let default = if is_literal { code(key.default) } else { key.default.replace('|', "\\|") };
        let variable = code(key.variable.unwrap_or_default());
        table += &row(code(key.key), default, variable, &key.meaning.replace('|', "\\|"));
    }
    table
}

/// The line of `key`, from 1, in a TOML document: `limits.log_bytes` in a table, `rules[2].use` in
/// the second of several tables. If only the beginning of the key is in the document, its line.
pub fn key_line(content: &str, key: &str) -> Option<usize> {
    let document = DeTable::parse(content).ok()?;
    let span = find(document.get_ref(), key)?;
    Some(line_of(content, span.start))
}

/// The line of a byte's position, from 1.
pub fn line_of(content: &str, position: usize) -> usize {
    let before = content.as_bytes().get(..position).unwrap_or(content.as_bytes());
    before.iter().filter(|byte| **byte == b'\n').count() + 1
}

fn find(table: &DeTable<'_>, key: &str) -> Option<Range<usize>> {
    // The longest name first: a quoted name may contain dots.
    let mut ends: Vec<usize> = key.match_indices(['.', '[']).map(|(at, _)| at).collect();
    ends.push(key.len());
    let (name, value, rest) = ends.into_iter().rev().find_map(|end| {
        let found = table.iter().find(|(name, _)| name.get_ref() == &key[..end])?;
        Some((found.0, found.1, &key[end..]))
    })?;
    Some(below(value.get_ref(), rest).unwrap_or_else(|| name.span()))
}

/// The place of `rest`, which begins with `.` or `[`, in `value`.
fn below(value: &DeValue<'_>, rest: &str) -> Option<Range<usize>> {
    if let Some(key) = rest.strip_prefix('.') {
        return find(value.as_table()?, key);
    }
    let (number, rest) = rest.strip_prefix('[')?.split_once(']')?;
    let item = value.as_array()?.get(number.parse::<usize>().ok()?.checked_sub(1)?)?;
    Some(below(item.get_ref(), rest).unwrap_or_else(|| item.span()))
}

/// The known key closest to `key`: at most two letters away, and not all of them.
///
/// ```
/// use task_proto::toml_keys::closest_key;
/// assert_eq!(closest_key("htpt", ["data", "http"]), Some("http"));
/// assert_eq!(closest_key("colour", ["data", "http"]), None);
/// ```
pub fn closest_key<'k>(key: &str, known: impl IntoIterator<Item = &'k str>) -> Option<&'k str> {
    let distances = known.into_iter().map(|candidate| (edit_distance(key, candidate), candidate));
    let (distance, best) = distances.min()?;
    (distance <= 2 && distance < best.len()).then_some(best)
}

/// Number of insertions, deletions and substitutions (Levenshtein distance).
fn edit_distance(from: &str, to: &str) -> usize {
    let to: Vec<char> = to.chars().collect();
    let mut row: Vec<usize> = (0..=to.len()).collect();
    for (i, a) in from.chars().take(64).enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, b) in to.iter().enumerate() {
            let changed = diagonal + usize::from(a != *b);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[to.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_of_a_key_is_found_in_tables_and_lists() {
        let content =
            "a = 1\n\n[t]\nb = 2\n\"x.y\" = 3\n[[t.rules]]\nname = 'n'\n[[t.rules]]\nuse = 1\n";
        for (key, line) in [
            ("a", Some(1)),
            ("t.b", Some(4)),
            ("t.x.y", Some(5)),
            ("t.rules[1].name", Some(7)),
            ("t.rules[2].use", Some(9)),
            ("t.rules[2].name", Some(8)),
            ("t.missing", Some(3)),
            ("missing", None),
        ] {
            assert_eq!(key_line(content, key), line, "{key}");
        }
        assert_eq!(key_line("a =", "a"), None);
        let problem = FileProblem::of_key(content, "t.b", "is not a size");
        assert_eq!(problem.at("f.toml"), "f.toml:4: t.b: is not a size");
    }
}
