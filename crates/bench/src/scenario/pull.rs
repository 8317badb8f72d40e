//! `taskbench pull`: one large package to several robots, from the order until all have verified
//! and unpacked the package, compared with a script: `curl`, then `openssl dgst`, then `tar`,
//! against nginx, with the same number in parallel.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use clap::Args;
use futures_util::future::try_join_all;
use task_proto::Digest;
use task_proto::api::DeliveryChoice;
use task_proto::desired::BlobRef;
use tempfile::TempDir;

use super::run_once::{DeliveryArgs, run_once};
use crate::programs::package::{PAYLOAD_FILE, Package};
use crate::programs::peer::Peer;
use crate::programs::taskd::{Taskd, TaskdArgs, TaskdFlags};
use crate::results::run::{Point, Run, RunFlags, Unit};
use crate::simulated::fleet::{Fleet, memory_directory};
use crate::system::process::{Program, ended_children_cpu_s};
use crate::system::progress::{RunProgress, print_line};

/// Our own series in the results.
const OWN: &str = "taskd";
/// Series name of the script's programs.
const PROGRAMS: &str = "curl, openssl, tar";
/// The ratios of taskd's figures to the programs' figures.
const RATIO: &str = "taskd / programs";
/// As the agent's own default.
const POLL: Duration = Duration::from_secs(300);
/// Time limit for the robots to connect.
const START_LIMIT: Duration = Duration::from_secs(60);
/// Time limit of one order.
const ORDER_LIMIT: Duration = Duration::from_secs(300);
/// The shell script for each robot: $1 is the address, $2 the directory.
const SCRIPT: &str = "set -e; curl -sS --fail -o \"$2/blob\" \"$1\"; \
                      openssl dgst -sha256 -r \"$2/blob\" | cut -d ' ' -f 1; tar --zstd -x -f \"$2/blob\" -C \"$2\"";

#[derive(Debug, Args)]
pub struct PullFlags {
    /// How often each is measured, in turns
    #[arg(long, value_name = "N", default_value_t = 7, value_parser = clap::value_parser!(u32).range(1..=100))]
    runs: u32,
    /// Size of the package in megabytes
    #[arg(long, value_name = "MB", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=2000))]
    megabytes: u64,
    /// How many robots, and scripts
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=100))]
    robots: u16,
    #[command(flatten)]
    taskd: TaskdFlags,
    #[command(flatten)]
    run: RunFlags,
}

pub async fn run(flags: PullFlags) -> anyhow::Result<Run> {
    let begun = Instant::now();
    let seed = flags.run.seed();
    let mut run = Run::begin("pull", seed).await;
    let bytes = flags.megabytes * 1_000_000;
    let robots = usize::from(flags.robots);
    let taskd = Taskd::start(&flags.taskd, &TaskdArgs::default()).await?;
    run.versions.insert("taskd".to_owned(), taskd.version.clone());
    let nginx = Peer::nginx(taskd.dir(), &taskd.blobs(), None)
        .await?
        .context("nginx is needed, and not installed")?;
    run.versions.insert("nginx".to_owned(), nginx.version.clone());
    run.notes = vec![
        "Robots are the agent's own driver, link, fetch and verification; they and the scripts write to memory, the \
         server's disk is a disk whose files were read before. The robots' time is from the order to the last one's stored \
         answer; that of the scripts is from their start to the last one's end."
            .to_owned(),
    ];
    let mut fleet = Fleet::assemble(&taskd, robots, POLL, None).await?;
    let started = fleet.start(START_LIMIT).await?;
    ensure!(started.failures.is_empty(), "robots do not connect: {}", started.failures.join("; "));
    let scripts = Scripts::prepare(&taskd, nginx, bytes, robots, seed).await?;

    let mut own = Figures { point: Point::new(OWN, settings(&flags)), ..Figures::default() };
    let mut programs =
        Figures { point: Point::new(PROGRAMS, settings(&flags)), ..Figures::default() };
    let mut progress = RunProgress::new(flags.runs as usize);
    for turn in 0..flags.runs {
        progress.set_message(&format!("{} MB to {robots}", flags.megabytes));
        let order = DeliveryArgs {
            choice: DeliveryChoice::PushPull,
            payload_bytes: bytes,
            robots,
            seed: seed.wrapping_mul(1 << 11).wrapping_add(u64::from(turn) + 1),
            limit: ORDER_LIMIT,
        };
        // The order alternates, so that neither side always finds the machine as the other left it.
        for is_own in [turn % 2 == 0, turn % 2 == 1] {
            if is_own {
                let outcome = run_once(&taskd, &mut fleet, order).await?;
                outcome.arrivals.failures.iter().for_each(|why| own.point.fail(why));
                own.add(outcome.arrivals.last_ms(), outcome.server_cpu_s + outcome.robots_cpu_s);
            } else {
                let (wall, cpu_s) = scripts.run().await?;
                programs.add(Some(wall.as_secs_f64() * 1000.0), cpu_s);
            }
        }
        progress.step();
    }
    fleet.end().await?;
    scripts.nginx.end().await;
    taskd.end().await?;
    run.points = vec![
        own.ratio(&programs, Point::new(RATIO, settings(&flags))),
        own.finish(),
        programs.finish(),
    ];
    for path in run.write(&flags.run.out, begun)? {
        print_line(&format!("wrote {}", path.display()));
    }
    Ok(run)
}

fn settings(flags: &PullFlags) -> [(&'static str, f64); 2] {
    [("payload_bytes", (flags.megabytes * 1_000_000) as f64), ("robots", f64::from(flags.robots))]
}

/// The scripts, and their source.
struct Scripts {
    nginx: Peer,
    blob: BlobRef,
    payload: Digest,
    count: usize,
}

impl Scripts {
    /// Pushes a package of its own; nginx serves its content from the server's directory.
    async fn prepare(
        taskd: &Taskd,
        nginx: Peer,
        bytes: u64,
        count: usize,
        seed: u64,
    ) -> anyhow::Result<Self> {
        let package = Package::random("scripts".parse()?, "1".parse()?, bytes, seed);
        let blob = package.content_blob();
        let payload = package.payload;
        taskd.server.push(package).await.context("the package can't be pushed")?;
        Ok(Self { nginx, blob, payload, count })
    }

    /// Runs all scripts in parallel; returns the time until the last has ended, and the processor
    /// seconds of them and of nginx.
    async fn run(&self) -> anyhow::Result<(Duration, f64)> {
        let dirs = (0..self.count)
            .map(|_| memory_directory("taskbench-script-"))
            .collect::<anyhow::Result<Vec<_>>>()?;
        let cpu_s = || anyhow::Ok(self.nginx.usage().cpu_s + ended_children_cpu_s()?);
        let begun = Instant::now();
        let before = cpu_s()?;
        let digests = try_join_all(dirs.iter().map(|dir| self.run_one(dir.path()))).await?;
        let wall = begun.elapsed();
        let after = cpu_s()?;
        for (digest, dir) in digests.iter().zip(&dirs) {
            ensure!(
                digest.trim() == self.blob.digest.hex(),
                "a script has hashed the blob to {:?}",
                digest.trim()
            );
            self.check(dir)?;
        }
        Ok((wall, after - before))
    }

    async fn run_one(&self, dir: &Path) -> anyhow::Result<String> {
        let address = format!("http://{}/{}", self.nginx.address, self.blob.digest.hex());
        let program = Program::named("sh").args(["-c", SCRIPT, "sh", &address]).args([dir]);
        program.output().await.context("curl, openssl, tar and zstd are needed")
    }

    fn check(&self, dir: &TempDir) -> anyhow::Result<()> {
        let bytes = std::fs::read(dir.path().join(PAYLOAD_FILE))
            .context("the payload that a script unpacked")?;
        ensure!(
            Digest::of(&bytes) == self.payload,
            "a script has unpacked other bytes than were pushed"
        );
        Ok(())
    }
}

/// Measurements of one side, run by run. A run with a failure has no time.
#[derive(Default)]
struct Figures {
    point: Point,
    runs: Vec<(Option<f64>, f64)>,
}

impl Figures {
    fn add(&mut self, wall_ms: Option<f64>, cpu_s: f64) {
        self.runs.push((wall_ms.filter(|_| self.point.failures.is_empty()), cpu_s));
    }

    fn finish(mut self) -> Point {
        self.point.measure(
            "wall",
            Unit::Milliseconds,
            self.runs.iter().filter_map(|(wall_ms, _)| *wall_ms),
        );
        self.point.measure("cpu", Unit::Seconds, self.runs.iter().map(|(_, cpu_s)| *cpu_s));
        self.point
    }

    fn ratio(&self, other: &Self, mut point: Point) -> Point {
        let turns = || self.runs.iter().zip(&other.runs);
        point.measure(
            "wall",
            Unit::Number,
            turns().filter_map(|(own, other)| Some(own.0? / other.0?)),
        );
        point.measure("cpu", Unit::Number, turns().map(|(own, other)| own.1 / other.1));
        point
    }
}
