//! Output of a run on stdout: a table that grows with each phase, or one JSON document at the end.

use std::io::Write as _;

use clap::ValueEnum;
use serde::Serialize;
use serde_json::json;

use crate::measure::phase::Phase;

/// How the result is printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// A row for each phase, as it ends.
    Table,
    /// One document in the end.
    Json,
}

/// Facts needed to compare one run with another.
#[derive(Serialize)]
pub struct Facts {
    pub taskbench: &'static str,
    pub taskd: String,
    pub server: String,
    /// Number of requested robots.
    pub robots: usize,
    /// Seconds of steady reports.
    pub seconds: u64,
    /// Reports in each of them, of all robots together.
    pub reports_per_s: u32,
    /// Cores available to this program. The server may be on the same machine.
    pub cores: usize,
}

/// The result of a run up to now.
pub struct LoadReport {
    facts: Facts,
    format: Format,
    phases: Vec<Phase>,
}

impl LoadReport {
    pub fn begin(facts: Facts, format: Format) -> Self {
        let Facts { taskbench, taskd, server, robots, seconds, reports_per_s, cores } = &facts;
        if format == Format::Table {
            print(&format!(
                "taskbench {taskbench}, taskd {taskd} at {server}: {robots} robots, \
                 {reports_per_s} reports/s for {seconds} s, {cores} cores here\n\n\
                 {:<16} {:>7} {:>8} {:>9} {:>9} {:>9} {:>7}",
                "phase", "count", "wall s", "p50 ms", "p99 ms", "max ms", "failed"
            ));
        }
        Self { facts, format, phases: Vec::new() }
    }

    /// Adds a phase. A phase without any success is an error: the phases after it would measure
    /// nothing.
    pub fn add(&mut self, phase: Phase) -> anyhow::Result<()> {
        if self.format == Format::Table {
            print(&row(&phase));
        }
        let failure = phase.failures.keys().next().filter(|_| phase.failed() == phase.count());
        let outcome = failure.map_or(Ok(()), |text| {
            Err(anyhow::anyhow!("{}: every step failed: {text}", phase.name))
        });
        self.phases.push(phase);
        outcome
    }

    /// Prints the remaining output, and returns the number of failed steps.
    pub fn finish(&self) -> usize {
        if self.format == Format::Json {
            let phases: Vec<_> = self.phases.iter().map(document).collect();
            print(&format!("{:#}", json!({ "facts": self.facts, "phases": phases })));
        }
        self.phases.iter().map(Phase::failed).sum()
    }
}

fn row(phase: &Phase) -> String {
    let ms = |percent| phase.percentile_ms(percent).map_or("-".to_owned(), |ms| format!("{ms:.1}"));
    let wall = phase.wall.as_secs_f64();
    let p50 = ms(50);
    let p99 = ms(99);
    let max = ms(100);
    let mut row = format!(
        "{:<16} {:>7} {wall:>8.2} {p50:>9} {p99:>9} {max:>9} {:>7}",
        phase.name,
        phase.count(),
        phase.failed()
    );
    for (text, count) in &phase.failures {
        row.push_str(&format!("\n  {count} × {text}"));
    }
    row
}

fn document(phase: &Phase) -> serde_json::Value {
    json!({
        "phase": phase.name,
        "count": phase.count(),
        "failed": phase.failed(),
        "wall_s": phase.wall.as_millis() as f64 / 1000.0,
        "p50_ms": phase.percentile_ms(50),
        "p99_ms": phase.percentile_ms(99),
        "max_ms": phase.percentile_ms(100),
        "failures": phase.failures,
    })
}

/// The pipe may be closed; the run goes on, because its cleanup has to run.
fn print(text: &str) {
    let mut stdout = std::io::stdout();
    let _ = writeln!(stdout, "{text}").and_then(|()| stdout.flush());
}
