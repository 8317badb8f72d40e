//! `taskbench compare`: the differences between two results of the same scenario, quantity by
//! quantity. Points belong together when their series and settings are the same.

use std::path::PathBuf;

use anyhow::{Context as _, ensure};
use clap::Args;

use crate::results::run::{Figure, Point, Quantity, Run};

#[derive(Debug, Args)]
pub struct CompareFlags {
    /// JSON file of the earlier result
    old: PathBuf,
    /// JSON file of the later result
    new: PathBuf,
    /// Leave out differences of less than this many percent
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    least: f64,
}

/// Formats the comparison as a table.
pub fn compare(flags: &CompareFlags) -> anyhow::Result<String> {
    let read = |path: &PathBuf| Run::read(path).with_context(|| path.display().to_string());
    let (old, new) = (read(&flags.old)?, read(&flags.new)?);
    ensure!(
        old.scenario == new.scenario,
        "a run of {} can't be compared with one of {}",
        old.scenario,
        new.scenario
    );
    Ok(table(&old, &new, flags.least))
}

fn table(old: &Run, new: &Run, least: f64) -> String {
    let mut text = format!(
        "{}: {} ({}) → {} ({})\n",
        old.scenario, old.commit, old.began, new.commit, new.began
    );
    if old.machine != new.machine {
        text += "The machines differ: only ratios can be compared.\n";
    }
    for point in &new.points {
        match old
            .points
            .iter()
            .find(|other| other.series == point.series && other.settings == point.settings)
        {
            Some(before) => text += &rows(before, point, least),
            None => text += &format!("{}: only in the new run\n", title(point)),
        }
    }
    let is_gone = |point: &&Point| {
        !new.points
            .iter()
            .any(|other| other.series == point.series && other.settings == point.settings)
    };
    for point in old.points.iter().filter(is_gone) {
        text += &format!("{}: only in the old run\n", title(point));
    }
    text
}

fn rows(old: &Point, new: &Point, least: f64) -> String {
    let mut rows = String::new();
    for (name, after) in &new.quantities {
        let Some(before) = old.quantities.get(name) else { continue };
        for (figure, label) in [(Figure::Median, "median"), (Figure::P99, "p99")] {
            // With a single value both figures are equal.
            if figure == Figure::P99 && after.count == 1 && before.count == 1 {
                continue;
            }
            let change = percent(before, after, figure);
            if change.is_none_or(|change| change.abs() >= least) {
                let change = change.map_or(String::new(), |change| format!("  {change:+.1} %"));
                let (before, after, unit) =
                    (before.figure(figure), after.figure(figure), after.unit.symbol());
                rows += &format!(
                    "  {name} {label}: {} → {} {unit}{change}\n",
                    number(before),
                    number(after)
                );
            }
        }
    }
    if old.failed() != new.failed() {
        rows += &format!("  failed: {} → {}\n", old.failed(), new.failed());
    }
    if rows.is_empty() { rows } else { format!("{}\n{rows}", title(new)) }
}

fn percent(before: &Quantity, after: &Quantity, figure: Figure) -> Option<f64> {
    let (before, after) = (before.figure(figure), after.figure(figure));
    (before != 0.0).then(|| (after / before - 1.0) * 100.0)
}

fn title(point: &Point) -> String {
    let settings: Vec<String> =
        point.settings.iter().map(|(name, value)| format!("{name} {value}")).collect();
    format!("{}, {}", point.series, settings.join(", "))
}

/// Four digits that count.
fn number(value: f64) -> String {
    let digits =
        if value == 0.0 { 0 } else { (3 - value.abs().log10().floor() as i32).clamp(0, 9) };
    format!("{value:.*}", usize::try_from(digits).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::run::Unit;

    fn run(points: Vec<Point>) -> Run {
        let document = serde_json::json!({
            "scenario": "blob", "began": "now", "wall_s": 1.0, "commit": "c", "versions": {}, "command_line": [],
            "seed": 1, "points": points,
            "machine": { "cpu": "x", "cores": 2, "memory_bytes": 1, "kernel": "k", "system": "s" },
        });
        serde_json::from_value(document).expect("a run")
    }

    fn point(series: &str, clients: f64, delays: &[f64]) -> Point {
        let mut point = Point::new(series, [("clients", clients)]);
        point.measure("delay", Unit::Milliseconds, delays.iter().copied());
        point
    }

    #[test]
    fn small_changes_are_hidden() {
        let old = run(vec![
            point("a", 8.0, &[10.0]),
            point("a", 64.0, &[100.0, 200.0]),
            point("gone", 1.0, &[1.0]),
        ]);
        let mut failing = point("a", 64.0, &[101.0, 300.0]);
        failing.fail("lost");
        let new = run(vec![point("a", 8.0, &[20.0]), failing, point("fresh", 1.0, &[1.0])]);
        let text = table(&old, &new, 5.0);
        assert!(
            text.contains("a, clients 8\n  delay median: 10.00 → 20.00 ms  +100.0 %\n"),
            "{text}"
        );
        assert!(!text.contains("100.0 → 101.0"), "{text}");
        assert!(text.contains("delay p99: 200.0 → 300.0 ms  +50.0 %\n  failed: 0 → 1\n"), "{text}");
        assert!(
            text.contains(
                "fresh, clients 1: only in the new run\ngone, clients 1: only in the old run\n"
            ),
            "{text}"
        );
    }
}
