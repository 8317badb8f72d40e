//! `taskbench status`: robots that report at a fixed rate over MQTT, and how long each report takes
//! to be stored, which is when the report is acknowledged. The duration of one fsync is measured in
//! the same run and directory. A report is measured from its due time, so that a server that falls
//! behind shows.

use std::io::Write as _;
use std::path::Path;
use std::time::Instant;

use anyhow::Context as _;
use clap::Args;

use super::reporters::{Reporter, connect, report_at, stored_times};
use crate::programs::taskd::{Taskd, TaskdArgs, TaskdFlags};
use crate::results::run::{Point, Run, RunFlags, Unit};
use crate::system::machine::allow_files;
use crate::system::progress::{RunProgress, print_line};

/// Syncs before and after each measurement.
const SYNCS: usize = 200;

#[derive(Debug, Args)]
pub struct StatusFlags {
    /// How many robots report
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u16).range(1..=15_000))]
    robots: u16,
    /// Reports per second, of all robots together; may be given more than once
    #[arg(long, value_name = "R", default_values_t = [1000, 5000, 10_000],
          value_parser = clap::value_parser!(u32).range(1..=100_000))]
    rate: Vec<u32>,
    /// How long each rate is kept up
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=600))]
    seconds: u64,
    /// An empty Postgres database, which is measured as well [default: SQLite alone]
    #[arg(long, value_name = "URL")]
    postgres: Option<String>,
    #[command(flatten)]
    taskd: TaskdFlags,
    #[command(flatten)]
    run: RunFlags,
}

pub async fn run(flags: StatusFlags) -> anyhow::Result<Run> {
    let began = Instant::now();
    let mut run = Run::begin("status", flags.run.seed()).await;
    allow_files(u64::from(flags.robots) + 200)?;
    let mut databases = vec![("SQLite", TaskdArgs::default())];
    match &flags.postgres {
        Some(url) => {
            let mut order = TaskdArgs::default();
            order.settings.push(("TASKD_DATABASE".to_owned(), url.clone()));
            databases.push(("Postgres", order));
        }
        None => print_line("no --postgres: SQLite is measured alone"),
    }
    let mut progress = RunProgress::new(databases.len() * flags.rate.len());
    for (name, order) in databases {
        progress.set_message(&format!("{name}: connecting {} robots", flags.robots));
        let taskd = Taskd::start(&flags.taskd, &order).await?;
        run.versions.insert("taskd".to_owned(), taskd.version.clone());
        let mut robots = connect(&taskd, flags.robots.into()).await.context(name)?;
        for &rate in &flags.rate {
            progress.set_message(&format!("{name}: {rate} reports each second"));
            let mut point = Point::new(
                name,
                [("reports_per_s", f64::from(rate)), ("robots", f64::from(flags.robots))],
            );
            measure(&taskd, &mut robots, rate, flags.seconds, &mut point).await.context(name)?;
            run.points.push(point);
            progress.step();
        }
        drop(robots);
        taskd.end().await?;
    }
    for path in run.write(&flags.run.out, began)? {
        print_line(&format!("wrote {}", path.display()));
    }
    Ok(run)
}

async fn measure(
    taskd: &Taskd,
    robots: &mut [Reporter],
    rate: u32,
    seconds: u64,
    point: &mut Point,
) -> anyhow::Result<()> {
    let mut syncs = sync_ms(taskd.dir())?;
    let before = taskd.usage();
    let (begin, outcomes) = report_at(robots, rate, seconds).await?;
    let cpu_s = taskd.usage().cpu_s - before.cpu_s;
    let wall = begin.elapsed();
    syncs.extend(sync_ms(taskd.dir())?);
    let stored = stored_times(outcomes, point);
    point.measure("stored_per_s", Unit::PerSecond, [stored.len() as f64 / wall.as_secs_f64()]);
    point.measure(
        "server_cpu_us_per_report",
        Unit::Number,
        [cpu_s * 1e6 / stored.len().max(1) as f64],
    );
    point.measure("anonymous_memory", Unit::Bytes, [taskd.usage().anonymous_bytes as f64]);
    point.measure("stored_after", Unit::Milliseconds, stored);
    point.measure("fsync", Unit::Milliseconds, syncs);
    Ok(())
}

/// Durations of appending and syncing a page, repeatedly, in milliseconds.
fn sync_ms(dir: &Path) -> anyhow::Result<Vec<f64>> {
    let mut file = tempfile::tempfile_in(dir).context("a file to sync")?;
    let mut samples = Vec::with_capacity(SYNCS);
    for _ in 0..SYNCS {
        let begun = Instant::now();
        file.write_all(&[0; 4096])
            .and_then(|()| file.sync_data())
            .context("a file can't be synced")?;
        samples.push(begun.elapsed().as_secs_f64() * 1000.0);
    }
    Ok(samples)
}
