//! The result of a run of any scenario: facts, points and the plots that show them. All
//! scenarios share one shape, so that runs can be compared and drawn again. A failure is part of a
//! point and never dropped.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Args;
use serde::{Deserialize, Serialize};
use task_proto::time::timestamp;

use crate::measure::phase::percentile;
use crate::system::clock;
use crate::system::machine::{Machine, commit};

/// Single values are kept up to this many of a quantity; beyond it only their figures are.
const MAX_SAMPLES: usize = 100;

/// The directory of a run's files, and its seed.
#[derive(Debug, Clone, Args)]
pub struct RunFlags {
    /// Directory for the results: NAME.json, NAME.csv and NAME.html
    #[arg(long, value_name = "DIR", default_value = "taskbench-results")]
    pub out: PathBuf,
    /// Seed of random bytes and of the order of the runs [default: a random number, which the
    /// results name]
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
}

impl RunFlags {
    /// The given seed, or a random one.
    pub fn seed(&self) -> u64 {
        // 53 bits, so that every reader of JSON reads the same number.
        self.seed.unwrap_or_else(|| rand::random::<u64>() >> 11)
    }
}

/// A run, with all data needed to read, compare and repeat the run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Run {
    /// The scenario: the subcommand.
    pub scenario: String,
    pub began: String,
    pub wall_s: f64,
    /// The commit of the repository in the working directory.
    pub commit: String,
    pub machine: Machine,
    /// Programs by name, with their versions.
    pub versions: BTreeMap<String, String>,
    /// The command line, this program's path left out.
    pub command_line: Vec<String>,
    /// The seed of random bytes and of the order of the runs.
    pub seed: u64,
    /// Remarks for the reader.
    #[serde(default)]
    pub notes: Vec<String>,
    /// Plots of the points.
    #[serde(default)]
    pub plots: Vec<Plot>,
    pub points: Vec<Point>,
}

/// One point: its settings and its results.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// The compared variant: a mechanism, a program.
    pub series: String,
    /// Settings by name with the unit last: `payload_bytes`, `robots`.
    pub settings: BTreeMap<String, f64>,
    /// Measured quantities by name.
    pub quantities: BTreeMap<String, Quantity>,
    /// Number of failures by reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub failures: BTreeMap<String, u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Unit {
    #[serde(rename = "ms")]
    Milliseconds,
    #[serde(rename = "s")]
    Seconds,
    #[serde(rename = "B")]
    Bytes,
    #[serde(rename = "B/s")]
    BytesPerSecond,
    /// A rate per second.
    #[serde(rename = "1/s")]
    PerSecond,
    /// Seconds for each gigabyte (10⁹ bytes).
    #[serde(rename = "s/GB")]
    SecondsPerGigabyte,
    #[serde(rename = "%")]
    Percent,
    /// A count or a ratio.
    #[serde(rename = "")]
    Number,
}

impl Unit {
    /// The unit's symbol behind a number.
    pub fn symbol(self) -> &'static str {
        match self {
            Self::Milliseconds => "ms",
            Self::Seconds => "s",
            Self::Bytes => "B",
            Self::BytesPerSecond => "B/s",
            Self::PerSecond => "1/s",
            Self::SecondsPerGigabyte => "s/GB",
            Self::Percent => "%",
            Self::Number => "",
        }
    }
}

/// A quantity, measured once or many times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Quantity {
    /// The unit of all samples.
    pub unit: Unit,
    pub count: usize,
    pub min: f64,
    /// Half of the values were no larger.
    pub median: f64,
    /// Of a hundred values ninety-five were no larger.
    pub p95: f64,
    /// Of a hundred values ninety-nine were no larger.
    pub p99: f64,
    pub max: f64,
    /// The values as they came, unless they are too many.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub samples: Vec<f64>,
}

/// A figure of a quantity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Figure {
    #[default]
    Median,
    P99,
    Max,
}

/// A plot of some points: one line for each series.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Plot {
    pub title: String,
    /// The setting along the horizontal axis.
    pub x: String,
    /// Label of the horizontal axis.
    pub x_label: String,
    /// The quantity along the vertical axis.
    pub y: String,
    /// Label of the vertical axis.
    pub y_label: String,
    /// The figure of the quantity to plot. Points of a series with the same `x` are drawn as the
    /// mean of their figures.
    #[serde(default)]
    pub figure: Figure,
    /// Whether the horizontal axis is logarithmic.
    pub x_log: bool,
    /// Whether the vertical axis is logarithmic.
    pub y_log: bool,
    /// Only points whose settings lie in these ranges, both ends included.
    #[serde(default)]
    pub only: BTreeMap<String, (f64, f64)>,
    /// Only these series; empty: all.
    #[serde(default)]
    pub series: Vec<String>,
}

impl Plot {
    /// The points in this plot.
    pub fn points<'a>(&'a self, points: &'a [Point]) -> impl Iterator<Item = &'a Point> {
        let in_range = |point: &Point, (name, (least, most)): (&String, &(f64, f64))| {
            point.settings.get(name).is_some_and(|value| value >= least && value <= most)
        };
        points.iter().filter(move |point| {
            (self.series.is_empty() || self.series.contains(&point.series))
                && point.settings.contains_key(&self.x)
                && self.only.iter().all(|range| in_range(point, range))
        })
    }
}

impl Quantity {
    /// The figures of `samples`; `None` without samples, or if one is not a number.
    pub fn of(unit: Unit, samples: impl IntoIterator<Item = f64>) -> Option<Self> {
        let samples: Vec<f64> = samples.into_iter().collect();
        let mut sorted = samples.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let at = |percent| percentile(&sorted, percent);
        let quantity = Self {
            unit,
            count: sorted.len(),
            min: sorted.first().copied()?,
            median: at(50)?,
            p95: at(95)?,
            p99: at(99)?,
            max: sorted.last().copied()?,
            samples: if samples.len() <= MAX_SAMPLES { samples } else { Vec::new() },
        };
        sorted.iter().all(|value| value.is_finite()).then_some(quantity)
    }

    /// The value of a figure.
    pub fn figure(&self, figure: Figure) -> f64 {
        match figure {
            Figure::Median => self.median,
            Figure::P99 => self.p99,
            Figure::Max => self.max,
        }
    }
}

impl Point {
    /// A point of `series` with these settings.
    pub fn new(series: &str, settings: impl IntoIterator<Item = (&'static str, f64)>) -> Self {
        let settings = settings.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        Self { series: series.to_owned(), settings, ..Self::default() }
    }

    /// Adds measured samples; does nothing if there are none.
    pub fn measure(&mut self, name: &str, unit: Unit, samples: impl IntoIterator<Item = f64>) {
        if let Some(quantity) = Quantity::of(unit, samples) {
            self.quantities.insert(name.to_owned(), quantity);
        }
    }

    pub fn fail(&mut self, text: impl Into<String>) {
        *self.failures.entry(text.into()).or_default() += 1;
    }

    pub fn failed(&self) -> u64 {
        self.failures.values().sum()
    }
}

impl Run {
    /// A run that starts now, without points.
    pub async fn begin(scenario: &str, seed: u64) -> Self {
        Self {
            scenario: scenario.to_owned(),
            began: timestamp(clock::wall_ms()),
            wall_s: 0.0,
            commit: commit().await,
            machine: Machine::here(),
            versions: [("taskbench".to_owned(), env!("CARGO_PKG_VERSION").to_owned())].into(),
            command_line: std::env::args().skip(1).collect(),
            seed,
            notes: Vec::new(),
            plots: Vec::new(),
            points: Vec::new(),
        }
    }

    /// Number of failed steps.
    pub fn failed(&self) -> u64 {
        self.points.iter().map(Point::failed).sum()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A run with two series, a failure among them.
    pub fn sample() -> Run {
        let point = |series: &str, robots: f64, ms: &[f64]| {
            let mut point =
                Point::new(series, [("robots", robots), ("payload_bytes", 1000.0 * robots)]);
            point.measure("delay", Unit::Milliseconds, ms.iter().copied());
            point
        };
        let mut lost = point("direct-push", 4.0, &[]);
        lost.fail("the client, \"r1\" <lost> it");
        let plot = Plot {
            title: "Delay & robots".to_owned(),
            x: "robots".to_owned(),
            x_label: "robots".to_owned(),
            y: "delay".to_owned(),
            y_label: "delay".to_owned(),
            y_log: true,
            ..Plot::default()
        };
        Run {
            scenario: "sample".to_owned(),
            began: "2026-01-01T00:00:00.000Z".to_owned(),
            wall_s: 1.5,
            commit: "abc".to_owned(),
            machine: Machine::here(),
            versions: BTreeMap::new(),
            command_line: vec!["sample".to_owned(), "--robots=1".to_owned()],
            seed: 7,
            notes: vec!["a <note>".to_owned()],
            plots: vec![plot],
            points: vec![
                point("push-pull", 1.0, &[10.0, 30.0, 20.0]),
                point("push-pull", 4.0, &[300.0]),
                point("direct-push", 1.0, &[5.0]),
                lost,
            ],
        }
    }

    #[test]
    fn percentiles_are_values_that_occurred() {
        let of = |n: u32| {
            Quantity::of(Unit::Milliseconds, (1..=n).rev().map(f64::from)).expect("figures")
        };
        let figures = |q: &Quantity| [q.min, q.median, q.p95, q.p99, q.max];
        assert_eq!(figures(&of(200)), [1.0, 100.0, 190.0, 198.0, 200.0]);
        assert_eq!(figures(&of(1)), [1.0; 5]);
        assert_eq!((of(3).samples, of(200).samples), (vec![3.0, 2.0, 1.0], vec![]));
        assert_eq!(Quantity::of(Unit::Number, []), None);
        assert_eq!(Quantity::of(Unit::Number, [f64::NAN]), None);
    }

    #[test]
    fn plot_shows_the_points_in_its_ranges() {
        let run = sample();
        let mut plot = run.plots[0].clone();
        assert_eq!(plot.points(&run.points).count(), 4);
        plot.only = [("payload_bytes".to_owned(), (0.0, 1000.0))].into();
        assert_eq!(plot.points(&run.points).count(), 2);
        plot.series = vec!["push-pull".to_owned()];
        assert_eq!(plot.points(&run.points).count(), 1);
    }
}
