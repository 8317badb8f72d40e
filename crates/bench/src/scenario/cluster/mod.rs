//! `taskbench cluster`: several servers on one Postgres behind HAProxy, robots with logs of their
//! own, a load of all kinds, and faults. Invariants are checked after each run; a broken one is a
//! failure.

mod cost;
mod database;
mod engines;
mod faults;
mod figures;
mod invariants;
mod load;
mod one_run;
mod robot_logs;
mod sessions;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use clap::Args;

use self::cost::CostArgs;
use self::engines::EngineArgs;
use self::faults::Fault;
use self::load::LoadArgs;
use self::one_run::{RunArgs, run_once};
use crate::programs::taskd::TaskdFlags;
use crate::results::run::{Figure, Plot, Point, Run, RunFlags};
use crate::simulated::fleet::{FILES_PER_ROBOT, ROBOTS_PER_PROCESS};
use crate::system::machine::allow_files;
use crate::system::progress::{RunProgress, print_line};

/// Open files of a process apart from those of its robots.
const OTHER_FILES: usize = 500;

#[derive(Debug, Args)]
pub struct ClusterFlags {
    /// How many servers
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u8).range(2..=9))]
    nodes: u8,
    /// How many robots
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u32).range(2..=20_000))]
    robots: u32,
    /// The faults, each in runs of its own
    #[arg(long, value_name = "F", value_enum, value_delimiter = ',', default_values_t = [Fault::Nothing, Fault::KillNode])]
    faults: Vec<Fault>,
    /// Runs for each fault
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=100))]
    repetitions: u16,
    /// Seconds of load in each run; the fault begins after a quarter and lasts for three tenths of
    /// them, 60 at most
    #[arg(long, value_name = "S", default_value_t = 20, value_parser = clap::value_parser!(u64).range(5..=3600))]
    seconds: u64,
    /// Robots of each order; one is given every two seconds
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=20_000))]
    order_robots: u32,
    /// Bytes of the package that is rolled out to all robots
    #[arg(long, value_name = "BYTES", default_value_t = 100_000)]
    payload: u64,
    /// Robots connect to the servers themselves, even if HAProxy is installed
    #[arg(long)]
    direct: bool,
    /// Packages are kept by two versitygw; without it, in a shared directory
    #[arg(long, value_name = "PATH")]
    versitygw: Option<PathBuf>,
    /// Also measure the cost of a report and a connection with one server, two, and so on
    #[arg(long)]
    cost: bool,
    /// Reports per second for --cost
    #[arg(long, value_name = "R", default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    rate: u32,
    #[command(flatten)]
    taskd: TaskdFlags,
    #[command(flatten)]
    run: RunFlags,
}

impl ClusterFlags {
    fn engines(&self, fault: Fault) -> EngineArgs<'_> {
        EngineArgs {
            taskd: &self.taskd,
            nodes: self.nodes.into(),
            balanced: !self.direct,
            standby: fault == Fault::KillPrimary,
            relayed: fault == Fault::CutDatabase,
            bus: fault != Fault::BusOff,
            versitygw: self.versitygw.as_deref(),
        }
    }

    /// Contradictions between the flags.
    fn checked(&self) -> anyhow::Result<()> {
        let has = |fault| self.faults.contains(&fault);
        ensure!(
            self.versitygw.is_some() || !has(Fault::KillGateway),
            "--faults: F5 needs --versitygw"
        );
        ensure!(!self.direct || !has(Fault::KillBalancer), "--faults: F6 excludes --direct");
        Ok(())
    }
}

/// Runs all faults, one run after the other.
pub async fn run(flags: ClusterFlags) -> anyhow::Result<Run> {
    let begun = Instant::now();
    flags.checked()?;
    let robots = flags.robots as usize;
    let needed = robots.min(ROBOTS_PER_PROCESS) * FILES_PER_ROBOT;
    allow_files((needed.max(robots + robots / 2) + OTHER_FILES) as u64)?;
    let seed = flags.run.seed();
    let mut run = Run::begin("cluster", seed).await;
    run.plots = plots();
    run.notes = notes();
    let costs = if flags.cost { usize::from(flags.nodes) } else { 0 };
    let repetitions = usize::from(flags.repetitions);
    let mut progress = RunProgress::new(flags.faults.len() * repetitions + costs);
    // Rounds, so that changes on the machine meanwhile concern all faults.
    for round in 0..repetitions {
        for (number, fault) in flags.faults.iter().enumerate() {
            progress.set_message(fault.label());
            let seed = seed.wrapping_add((round * flags.faults.len() + number) as u64);
            let args = RunArgs {
                engines: flags.engines(*fault),
                fault: *fault,
                load: LoadArgs {
                    robots,
                    order_robots: flags.order_robots as usize,
                    payload_bytes: flags.payload,
                    seed,
                },
                length: Duration::from_secs(flags.seconds),
            };
            let point = match run_once(&args).await {
                Ok((point, version)) => {
                    run.versions.insert("taskd".to_owned(), version);
                    point
                }
                // A run that can't be completed costs the campaign no other run.
                Err(error) => {
                    let settings = [("nodes", f64::from(flags.nodes)), ("robots", robots as f64)];
                    let mut point = Point::new(fault.label(), settings);
                    point.fail(format!("the run ended early: {error:#}"));
                    point
                }
            };
            for (why, count) in &point.failures {
                print_line(&format!("{}, seed {seed}: {count} × {why}", fault.label()));
            }
            run.points.push(point);
            // A campaign that is cut short keeps its results.
            run.write(&flags.run.out, begun).context("the results can't be written")?;
            progress.step();
        }
    }
    for nodes in 1..=costs {
        progress.set_message(&format!("costs with {nodes} servers"));
        let mut engines = flags.engines(Fault::Nothing);
        (engines.nodes, engines.balanced) = (nodes, false);
        let args = CostArgs { engines, robots, rate: flags.rate, seconds: flags.seconds };
        run.points.push(cost::measure(&args).await.context("costs")?);
        progress.step();
    }
    for file in run.write(&flags.run.out, begun).context("the results can't be written")? {
        print_line(&format!("{}", file.display()));
    }
    Ok(run)
}

fn notes() -> Vec<String> {
    let notes = [
        "All engines share this machine's cores: read ratios. Robots are the agent's own driver, link, fetch and \
         verification around a body that starts nothing, and log every acknowledged report.",
        "push: from the order's first request to the robot's verified state; first_10s: orders in the ten seconds \
         after the fault began, during: later ones while it lasted. stored: from a robot's report to its \
         acknowledgement. back_after_fault: from the fault to the next session of a robot that lost its own.",
        "A failure that begins with I1 to I9 is a broken invariant; docs/measurements.md has the list.",
    ];
    notes.map(str::to_owned).to_vec()
}

fn plots() -> Vec<Plot> {
    let plot = |title: &str, y: &str, y_label: &str, figure| Plot {
        title: title.to_owned(),
        x: "nodes".to_owned(),
        x_label: "servers".to_owned(),
        y: y.to_owned(),
        y_label: y_label.to_owned(),
        figure,
        y_log: true,
        ..Plot::default()
    };
    vec![
        plot("Robots back after the fault", "back_after_fault", "time", Figure::Max),
        plot("Orders before the fault", "push_before", "push", Figure::Median),
        plot("Orders within 10 s after the fault began", "push_first_10s", "push", Figure::Median),
        plot("Orders after the fault", "push_after", "push", Figure::Median),
        plot(
            "Reports, the line reaches to the 99th percentile",
            "stored",
            "stored",
            Figure::Median,
        ),
    ]
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct CommandLine {
        #[command(flatten)]
        flags: ClusterFlags,
    }

    fn flags(arguments: &[&str]) -> Result<ClusterFlags, clap::Error> {
        let all = std::iter::once(&"cluster").chain(arguments);
        CommandLine::try_parse_from(all).map(|line| line.flags)
    }

    #[test]
    fn faults_have_their_numbers_and_requirements() {
        let parsed = flags(&["--faults", "F0,F3,F10", "--nodes", "2"]).expect("flags");
        assert_eq!(parsed.faults, [Fault::Nothing, Fault::PauseLockHolder, Fault::BusOff]);
        assert!(!parsed.engines(Fault::BusOff).bus && parsed.engines(Fault::Nothing).bus);
        assert!(parsed.engines(Fault::KillPrimary).standby && parsed.checked().is_ok());
        assert!(flags(&["--faults", "F11"]).is_err() && flags(&["--nodes", "1"]).is_err());
        for (arguments, words) in [
            (&["--faults", "F5"][..], "F5 needs --versitygw"),
            (&["--faults", "F0,F6", "--direct"][..], "F6 excludes --direct"),
        ] {
            let error = flags(arguments).expect("flags").checked().expect_err("contradiction");
            assert!(error.to_string().contains(words), "{error}");
        }
        assert!(flags(&["--faults", "F5", "--versitygw", "x"]).expect("flags").checked().is_ok());
    }
}
