//! A table without lines, its columns two spaces apart: as wide as its contents, or as the
//! terminal. Text only; the words carry the meaning of a state, and colour only repeats them.

use unicode_width::{UnicodeWidthChar as _, UnicodeWidthStr as _};

use super::printable;

/// The gap between two columns, in spaces.
const GAP: usize = 2;
/// A column is never cut below this width, however narrow the terminal.
const MIN_WIDTH: usize = 8;
/// Columns that are typed or copied from the screen, and so are never cut.
const UNCUT_COLUMNS: [&str; 6] = ["id", "name", "robot", "deployment", "task", "version"];
/// Columns whose first word has a colour.
const COLOURED: [&str; 2] = ["state", "phase"];

/// The columns of a list.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Columns {
    /// The title of the column with the object's name: the only output of `-o name`.
    pub(crate) name: &'static str,
    /// Columns of every table.
    pub(crate) narrow: &'static [&'static str],
    /// Additional columns of a wide table.
    pub(crate) wide: &'static [&'static str],
}

impl Columns {
    /// The columns of every table; the first one is the object's name.
    pub(crate) const fn of(narrow: &'static [&'static str]) -> Self {
        Self { name: narrow[0], narrow, wide: &[] }
    }

    fn titles(&self) -> impl Iterator<Item = &'static str> {
        self.narrow.iter().chain(self.wide).copied()
    }

    /// The names in `rows`, each once.
    pub(crate) fn names(&self, rows: &[Vec<String>]) -> Vec<String> {
        let at = self.titles().position(|title| title == self.name).unwrap_or_default();
        let mut seen = std::collections::HashSet::new();
        let cells = rows.iter().filter_map(|row| row.get(at)).map(|cell| printable(cell));
        cells.filter(|name| seen.insert(name.clone())).collect()
    }
}

/// Layout of a table.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct TableLayout {
    /// Whether the wide columns are shown.
    pub(crate) wide: bool,
    /// Maximum characters per line; absent: unlimited.
    pub(crate) width: Option<usize>,
    /// Whether states have colours.
    pub(crate) colours: bool,
}

/// The table as lines.
pub(crate) fn table(columns: &Columns, rows: &[Vec<String>], layout: TableLayout) -> String {
    let count =
        if layout.wide { columns.narrow.len() + columns.wide.len() } else { columns.narrow.len() };
    let titles: Vec<&str> = columns.titles().take(count).collect();
    let cells = |row: &Vec<String>| row.iter().take(count).map(|cell| printable(cell)).collect();
    let mut lines: Vec<Vec<String>> =
        vec![titles.iter().map(|title| title.to_uppercase()).collect()];
    lines.extend(rows.iter().map(cells));
    let widths = fit_widths(&titles, widths(&lines, count), layout.width);
    let mut text = String::new();
    for (number, line) in lines.iter().enumerate() {
        for (at, cell) in line.iter().enumerate() {
            let cell = truncate(cell, widths[at]);
            let padding = if at + 1 == line.len() { 0 } else { widths[at] - cell.width() + GAP };
            let colour = (layout.colours && number > 0 && COLOURED.contains(&titles[at]))
                .then(|| colour(&cell))
                .flatten();
            match colour {
                Some(colour) => text.push_str(&format!("\x1b[{colour}m{cell}\x1b[0m")),
                None => text.push_str(&cell),
            }
            text.push_str(&" ".repeat(padding));
        }
        // The last cells of a row may be empty.
        text.truncate(text.trim_end_matches(' ').len());
        text.push('\n');
    }
    text
}

fn widths(lines: &[Vec<String>], count: usize) -> Vec<usize> {
    (0..count)
        .map(|at| {
            lines.iter().filter_map(|line| line.get(at)).map(|cell| cell.width()).max().unwrap_or(0)
        })
        .collect()
}

/// Column widths that fit a line of `limit` characters as far as columns may be cut, the widest cut
/// first.
fn fit_widths(titles: &[&str], mut widths: Vec<usize>, limit: Option<usize>) -> Vec<usize> {
    let Some(limit) = limit else { return widths };
    let room = limit.saturating_sub(GAP * widths.len().saturating_sub(1));
    let mut over = widths.iter().sum::<usize>().saturating_sub(room);
    while over > 0 {
        let can_be_cut = |at: &usize| {
            !UNCUT_COLUMNS.contains(&titles[*at]) && widths[*at] > MIN_WIDTH.max(titles[*at].len())
        };
        let Some(widest) = (0..widths.len()).filter(can_be_cut).max_by_key(|at| widths[*at]) else {
            break;
        };
        widths[widest] -= 1;
        over -= 1;
    }
    widths
}

/// `cell` in at most `width` characters; an ellipsis replaces the rest.
fn truncate(cell: &str, width: usize) -> String {
    if cell.width() <= width {
        return cell.to_owned();
    }
    let (mut text, mut room) = (String::new(), width.saturating_sub(1));
    for c in cell.chars() {
        let Some(left) = room.checked_sub(c.width().unwrap_or(0)) else { break };
        room = left;
        text.push(c);
    }
    text.push('…');
    text
}

fn colour(cell: &str) -> Option<&'static str> {
    match cell.split([' ', ',']).next().unwrap_or_default() {
        "online" | "running" | "succeeded" | "settled" | "ready" => Some("32"),
        "failed" | "rolled_back" | "unmet" | "expired" => Some("31"),
        "paused" | "deferred" | "pending" | "waiting" => Some("33"),
        "offline" | "stopped" | "cancelled" | "superseded" => Some("2"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COLUMNS: Columns =
        Columns { name: "name", narrow: &["id", "name", "problem"], wide: &["arch"] };

    fn rows() -> Vec<Vec<String>> {
        let row = |cells: [&str; 4]| cells.map(str::to_owned).to_vec();
        vec![
            row(["r1", "a\u{1b}[31mb\nc", "exit code 3: the lidar does not answer", "x86_64"]),
            row(["r22", "größe", "-", "aarch64"]),
        ]
    }

    #[test]
    fn table_has_a_header_and_no_borders() {
        let text = table(&COLUMNS, &rows(), TableLayout::default());
        assert_eq!(
            text,
            "ID   NAME       PROBLEM\n\
             r1   a [31mb c  exit code 3: the lidar does not answer\n\
             r22  größe      -\n"
        );
        let wide = table(&COLUMNS, &rows(), TableLayout { wide: true, ..TableLayout::default() });
        assert!(wide.lines().all(|line| line.ends_with("ARCH") || line.ends_with("64")), "{wide}");
        assert_eq!(COLUMNS.names(&rows()), ["a [31mb c", "größe"]);
    }

    #[test]
    fn lines_fit_the_terminal_and_names_are_not_truncated() {
        let fit = |width| {
            table(&COLUMNS, &rows(), TableLayout { width: Some(width), ..TableLayout::default() })
        };
        for width in [24, 30, 45] {
            let text = fit(width);
            assert!(text.lines().all(|line| line.width() <= width), "{text}");
            assert!(
                text.contains("…") && text.contains("a [31mb c") && text.contains("größe"),
                "{text}"
            );
        }
        assert!(!fit(80).contains('…'));
        // Narrower than the columns that must not be cut.
        assert!(fit(5).contains("a [31mb c"));
    }

    #[test]
    fn wide_characters_count_as_two_columns() {
        assert_eq!(truncate("機械機械", 8), "機械機械");
        assert_eq!(truncate("機械機械", 6), "機械…");
    }

    #[test]
    fn colours_only_repeat_a_word() {
        let columns = Columns::of(&["name", "state"]);
        let rows = [vec!["failed".to_owned(), "offline diverged".to_owned()]];
        let text = table(&columns, &rows, TableLayout { colours: true, ..TableLayout::default() });
        assert_eq!(text, "NAME    STATE\nfailed  \x1b[2moffline diverged\x1b[0m\n");
    }
}
