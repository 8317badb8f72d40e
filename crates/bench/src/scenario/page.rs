//! `taskbench page`: the page in a real browser, in front of a fleet that reports all the time.
//! Measures how soon the first rows are shown, how long the browser's main thread is busy at a time
//! during scrolling, and whether the browser's memory grows.
//!
//! The browser is driven by `page/look.mjs`, which runs in node with the packages that
//! `scripts/need page` installs.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use clap::Args;
use serde::Deserialize;
use tokio::io::AsyncReadExt as _;

use super::reporters::{Reporter, connect, report_at};
use crate::programs::taskd::{Taskd, TaskdArgs, TaskdFlags};
use crate::results::run::{Point, Run, RunFlags, Unit};
use crate::system::machine::allow_files;
use crate::system::process::Program;
use crate::system::progress::print_line;

/// Time for the browser outside the watched period: its start, loading the page, and reading its
/// last output.
const MARGIN_S: u64 = 90;

#[derive(Debug, Args)]
pub struct PageFlags {
    /// How many robots there are
    #[arg(long, value_name = "N", default_value_t = 10_000, value_parser = clap::value_parser!(u16).range(1..=15_000))]
    robots: u16,
    /// Reports per second, of all robots together
    #[arg(long, value_name = "R", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    rate: u32,
    /// How long the page is watched
    #[arg(long, value_name = "S", default_value_t = 600, value_parser = clap::value_parser!(u64).range(30..=7200))]
    seconds: u64,
    /// The directory that `scripts/need page` prints
    #[arg(long, value_name = "DIR", env = "TASKD_TEST_PAGE")]
    browser: PathBuf,
    #[command(flatten)]
    taskd: TaskdFlags,
    #[command(flatten)]
    run: RunFlags,
}

/// Measurements from the browser.
#[derive(Debug, Deserialize)]
struct PageMeasurements {
    browser: String,
    /// From asking for the page, with a session, until rows were drawn.
    first_rows_ms: Vec<f64>,
    /// From the same request until all robots were shown.
    all_rows_ms: Vec<f64>,
    /// How long the main thread was busy for each frame drawn during scrolling.
    frame_ms: Vec<f64>,
    /// The processor time of each frame: delays by other programs on the same cores are excluded.
    frame_cpu_ms: Vec<f64>,
    /// All tasks of the main thread in that time, most of them small ones of the browser itself.
    task_ms: Vec<f64>,
    /// The JavaScript heap after a collection, again and again.
    heap_bytes: Vec<f64>,
    /// Events that the page took in.
    events: u64,
    /// The period of `events`, in seconds.
    events_s: f64,
}

pub async fn run(flags: PageFlags) -> anyhow::Result<Run> {
    let began = Instant::now();
    let mut run = Run::begin("page", flags.run.seed()).await;
    allow_files(u64::from(flags.robots) + 200)?;
    let taskd = Taskd::start(&flags.taskd, &TaskdArgs::default()).await?;
    run.versions.insert("taskd".to_owned(), taskd.version.clone());
    print_line(&format!("connecting {} robots", flags.robots));
    let mut robots = connect(&taskd, flags.robots.into()).await?;
    print_line(&format!(
        "{} reports each second, and a browser for {} s",
        flags.rate, flags.seconds
    ));
    let settings = [("robots", f64::from(flags.robots)), ("reports_per_s", f64::from(flags.rate))];
    let mut point = Point::new("Chromium", settings);
    let seen = watch(&taskd, &mut robots, &flags, &mut point).await?;
    run.versions.insert("chromium".to_owned(), seen.browser);
    point.measure("first_rows", Unit::Milliseconds, seen.first_rows_ms);
    point.measure("all_rows", Unit::Milliseconds, seen.all_rows_ms);
    point.measure("main_thread_per_frame", Unit::Milliseconds, seen.frame_ms);
    point.measure("main_thread_cpu_per_frame", Unit::Milliseconds, seen.frame_cpu_ms);
    point.measure("main_thread_task", Unit::Milliseconds, seen.task_ms);
    point.measure("heap", Unit::Bytes, seen.heap_bytes);
    let events_per_s = seen.events as f64 / seen.events_s;
    point.measure("events_taken_in", Unit::PerSecond, [events_per_s]);
    // Each report advances a robot, so with fewer events the robots or the server did not keep up.
    if events_per_s < f64::from(flags.rate) * 0.95 {
        point.fail(format!(
            "of {} reports each second the page took in {events_per_s:.0}",
            flags.rate
        ));
    }
    run.points.push(point);
    drop(robots);
    taskd.end().await?;
    for path in run.write(&flags.run.out, began)? {
        print_line(&format!("wrote {}", path.display()));
    }
    Ok(run)
}

/// Lets the robots report until the browser has finished its measurement.
async fn watch(
    taskd: &Taskd,
    robots: &mut [Reporter],
    flags: &PageFlags,
    point: &mut Point,
) -> anyhow::Result<PageMeasurements> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("page/look.mjs");
    let look = Program::named("node")
        .args([script.as_os_str(), flags.browser.as_os_str()])
        .args([taskd.url(), flags.robots.to_string(), flags.seconds.to_string()])
        .variable("TASKD_TOKEN", &taskd.token.reveal());
    let (process, input, mut output) = look.converse(&taskd.dir().join("browser.log"))?;
    let mut printed = String::new();
    {
        let reading = output.read_to_string(&mut printed);
        let reporting = report_at(robots, flags.rate, flags.seconds + MARGIN_S);
        tokio::pin!(reading, reporting);
        let read = tokio::select! {
            read = &mut reading => read,
            reported = &mut reporting => {
                for outcome in reported?.1 {
                    if let Err(error) = outcome {
                        point.fail(format!("{error:#}"));
                    }
                }
                reading.await
            }
        };
        read.context("the browser's words")?;
    }
    drop(input);
    process.end().await;
    let log = || std::fs::read_to_string(taskd.dir().join("browser.log")).unwrap_or_default();
    serde_json::from_str(&printed)
        .with_context(|| format!("the browser printed no result: {}", log()))
}
