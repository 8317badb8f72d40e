//! `taskbench fleet`: the load of a fleet on one server: all robots connect at once, then one
//! deployment goes to all.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::{Args, ValueEnum};
use task_proto::api::DeliveryChoice;

use super::run_once::{DeliveryArgs, run_once};
use crate::programs::encryption::ENCRYPTION_NOTE;
use crate::programs::taskd::{Taskd, TaskdArgs, TaskdFlags};
use crate::results::run::{Figure, Plot, Point, Run, RunFlags, Unit};
use crate::simulated::fleet::{FILES_PER_ROBOT, Fleet, ROBOTS_PER_PROCESS};
use crate::system::machine::allow_files;
use crate::system::progress::{RunProgress, print_line};

/// As the agent's own default.
const POLL: Duration = Duration::from_secs(300);
/// Open files of a process apart from those of its robots.
const OTHER_FILES: usize = 500;
/// The most robots: limited by the addresses and ports of one machine.
const MAX_ROBOTS: u32 = 20_000;

#[derive(Debug, Args)]
pub struct FleetFlags {
    /// How many robots; several numbers, with a fresh server for each
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [10, 100, 1000],
          value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_ROBOTS)))]
    robots: Vec<u32>,
    /// The package's size in bytes
    #[arg(long, value_name = "BYTES", default_value_t = 20_000)]
    payload: u64,
    /// How the package travels
    #[arg(long, value_name = "HOW", value_enum, default_value_t = Choice::PushPull)]
    delivery: Choice,
    /// How long all robots may take to connect, and to verify the package
    #[arg(long, value_name = "S", default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..=3600))]
    limit_s: u64,
    /// Whether robots and server encrypt, each robot with a handshake of its own
    #[arg(long)]
    tls: bool,
    #[command(flatten)]
    taskd: TaskdFlags,
    #[command(flatten)]
    run: RunFlags,
}

/// As in an order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Choice {
    Adaptive,
    PushPull,
    DirectPush,
    Poll,
    Inline,
}

impl Choice {
    fn ordered(self) -> DeliveryChoice {
        match self {
            Self::Adaptive => DeliveryChoice::Adaptive,
            Self::PushPull => DeliveryChoice::PushPull,
            Self::DirectPush => DeliveryChoice::DirectPush,
            Self::Poll => DeliveryChoice::Poll,
            Self::Inline => DeliveryChoice::Inline,
        }
    }
}

/// Runs all sizes, one after the other.
pub async fn run(flags: FleetFlags) -> anyhow::Result<Run> {
    let begun = Instant::now();
    let most = flags.robots.iter().map(|robots| *robots as usize).max().unwrap_or(1);
    // The server holds all sessions, and fewer HTTP connections at a time if files are scarce.
    let needed = most.min(ROBOTS_PER_PROCESS) * FILES_PER_ROBOT;
    allow_files((needed.max(most + most / 2) + OTHER_FILES) as u64)?;
    let seed = flags.run.seed();
    let mut run = Run::begin("fleet", seed).await;
    run.plots = plots();
    run.notes = vec![
        "Server and robots share this machine's cores. Robots are the agent's own driver, link, fetch and verification \
         around a body that starts nothing; their disks are in memory, the server's is a disk. All start at the same \
         moment; connected means that the robot keeps to the server's state and the server has stored its report of it."
            .to_owned(),
    ];
    run.notes.extend(flags.tls.then(|| ENCRYPTION_NOTE.to_owned()));
    let mut progress = RunProgress::new(flags.robots.len());
    for (number, robots) in flags.robots.iter().enumerate() {
        progress.set_message(&format!("{robots} robots"));
        let (point, version) =
            measure(&flags, *robots as usize, seed.wrapping_mul(1 << 11) + number as u64)
                .await
                .with_context(|| format!("{robots} robots"))?;
        run.versions.insert("taskd".to_owned(), version);
        run.points.push(point);
        progress.step();
    }
    for file in run.write(&flags.run.out, begun).context("the results can't be written")? {
        print_line(&format!("{}", file.display()));
    }
    Ok(run)
}

async fn measure(flags: &FleetFlags, robots: usize, seed: u64) -> anyhow::Result<(Point, String)> {
    let mut order = if flags.tls { TaskdArgs::default().encrypted() } else { TaskdArgs::default() };
    // All robots' sessions come from one address, unlike in production.
    order.settings.push(("TASKD_MAX_SILENT_PER_ADDRESS".to_owned(), MAX_ROBOTS.to_string()));
    let taskd = Taskd::start(&flags.taskd, &order).await?;
    let mut fleet = Fleet::assemble(&taskd, robots, POLL, None).await?;
    let limit = Duration::from_secs(flags.limit_s);
    let settings = [("robots", robots as f64), ("payload_bytes", flags.payload as f64)];
    let mut point = Point::new(&flags.delivery.ordered().to_string(), settings);
    point.measure(
        "enrolled",
        Unit::Milliseconds,
        fleet.enrollments.iter().map(|took| took.as_secs_f64() * 1000.0),
    );

    let memory = taskd.watch_memory();
    let before = (taskd.usage(), fleet.usage());
    let connected = fleet.start(limit).await?;
    let middle = (taskd.usage(), fleet.usage());
    let memory = memory.peak().await;
    point.measure("connected", Unit::Milliseconds, connected.delays_ms());
    point.measure("connect_server_cpu", Unit::Seconds, [middle.0.cpu_s - before.0.cpu_s]);
    point.measure("connect_robots_cpu", Unit::Seconds, [middle.1.cpu_s - before.1.cpu_s]);
    point.measure("connect_server_anonymous", Unit::Bytes, [memory.anonymous_bytes as f64]);
    connected.failures.into_iter().for_each(|why| point.fail(why));

    let memory = taskd.watch_memory();
    let one = DeliveryArgs {
        choice: flags.delivery.ordered(),
        payload_bytes: flags.payload,
        robots,
        seed,
        limit,
    };
    let outcome = run_once(&taskd, &mut fleet, one).await?;
    let memory = memory.peak().await;
    point.measure("delay", Unit::Milliseconds, outcome.arrivals.delays_ms());
    point.measure(
        "arrival",
        Unit::Percent,
        [100.0 * outcome.arrivals.arrived.len() as f64 / robots as f64],
    );
    point.measure("server_cpu", Unit::Seconds, [outcome.server_cpu_s]);
    point.measure("robots_cpu", Unit::Seconds, [outcome.robots_cpu_s]);
    point.measure("server_anonymous", Unit::Bytes, [memory.anonymous_bytes as f64]);
    point.measure("load_mqtt", Unit::Bytes, [outcome.mqtt_bytes as f64]);
    point.measure("load_http", Unit::Bytes, [outcome.http_bytes as f64]);
    point.measure("fell_behind", Unit::Number, [outcome.fell_behind as f64]);
    outcome.arrivals.failures.into_iter().for_each(|why| point.fail(why));
    let version = taskd.version.clone();
    fleet.end().await?;
    taskd.end().await?;
    Ok((point, version))
}

fn plots() -> Vec<Plot> {
    let plot = |title: &str, y: &str, y_label: &str, figure| Plot {
        title: title.to_owned(),
        x: "robots".to_owned(),
        x_label: "robots".to_owned(),
        y: y.to_owned(),
        y_label: y_label.to_owned(),
        figure,
        x_log: true,
        y_log: true,
        ..Plot::default()
    };
    vec![
        plot(
            "Connect storm: time until the last robot is connected",
            "connected",
            "time to last",
            Figure::Max,
        ),
        plot(
            "One deployment to all: time until the last robot has verified it",
            "delay",
            "time to last",
            Figure::Max,
        ),
        plot(
            "The same, half of the robots; the line reaches to the 99th percentile",
            "delay",
            "delay",
            Figure::Median,
        ),
        plot(
            "The server's own memory during the deployment",
            "server_anonymous",
            "RssAnon",
            Figure::Max,
        ),
        plot("Processor time of the server for the deployment", "server_cpu", "CPU", Figure::Max),
    ]
}
