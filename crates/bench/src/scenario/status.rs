//! `taskbench status`: robots that report at a fixed rate over MQTT, and how long each report takes to be stored, which is
//! when it is acknowledged. Beside it, in the same run and directory, what one fsync takes. A report is measured from when
//! it was due, so that a server that falls behind shows.

use std::io::Write as _;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, bail};
use clap::Args;
use futures_util::{StreamExt as _, TryStreamExt as _};
use task_proto::api::{CreateDeployment, DeliveryChoice, EnrollResponse};
use task_proto::desired::{BlobRef, PackageRef, Wanted};
use task_proto::report::{HostFacts, Phase, Progress, Report, TaskReport};
use task_proto::topic::{RobotTopic, Topic};
use task_proto::{DeploymentId, Digest, Generation, InstanceId};
use tokio::io::AsyncWriteExt as _;

use crate::enrolment::enrol;
use crate::machine::allow_files;
use crate::mqtt::{Heard, Link, Login, message};
use crate::progress::{RunProgress, say};
use crate::run::{Point, Run, RunFlags, Unit};
use crate::taskd::{Taskd, TaskdFlags, TaskdOrder};

/// Connections opened at a time.
const CONNECTS_AT_ONCE: usize = 64;
/// Syncs before and after each measurement.
const SYNCS: usize = 200;
/// One in so many reports says that the task is in another phase; the others, that it has come further in its own.
const REPORTS_PER_PHASE: u64 = 10;
/// How long the last acknowledgements may take.
const PATIENCE: Duration = Duration::from_secs(60);
/// From ordering the reports until the first is due.
const LEAD: Duration = Duration::from_millis(500);

/// What to measure.
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

/// Runs it.
pub async fn run(flags: StatusFlags) -> anyhow::Result<Run> {
    let began = Instant::now();
    let mut run = Run::begin("status", flags.run.seed()).await;
    allow_files(u64::from(flags.robots) + 200)?;
    let mut databases = vec![("SQLite", TaskdOrder::default())];
    match &flags.postgres {
        Some(url) => {
            let settings = vec![("TASKD_DATABASE".to_owned(), url.clone())];
            databases.push(("Postgres", TaskdOrder { settings, ..TaskdOrder::default() }));
        }
        None => say("no --postgres: SQLite is measured alone"),
    }
    let mut progress = RunProgress::new(databases.len() * flags.rate.len());
    for (name, order) in databases {
        progress.says(&format!("{name}: connecting {} robots", flags.robots));
        let taskd = Taskd::start(&flags.taskd, &order).await?;
        run.versions.insert("taskd".to_owned(), taskd.version.clone());
        let mut robots = connect(&taskd, flags.robots.into()).await.context(name)?;
        for &rate in &flags.rate {
            progress.says(&format!("{name}: {rate} reports each second"));
            let mut point = Point::new(name, [("reports_per_s", f64::from(rate)), ("robots", f64::from(flags.robots))]);
            measure(&taskd, &mut robots, rate, flags.seconds, &mut point).await.context(name)?;
            run.points.push(point);
            progress.step();
        }
        drop(robots);
        taskd.end().await?;
    }
    for path in run.write(&flags.run.out, began)? {
        say(&format!("wrote {}", path.display()));
    }
    Ok(run)
}

/// A robot that is connected and has an order to report on.
struct Reporter {
    link: Link,
    topic: String,
    report: Report,
}

async fn connect(taskd: &Taskd, count: usize) -> anyhow::Result<Vec<Reporter>> {
    let robots = enrol(&taskd.server, count).await?;
    let (package, version) = ("status".parse()?, "1".parse()?);
    let manifest = taskd.server.push_package(&package, &version).await?;
    let order =
        CreateDeployment { delivery: DeliveryChoice::Poll, ..CreateDeployment::new(package, manifest, "*".parse()?) };
    let deployment = taskd.server.order(&order).await?.id;
    let connecting = robots.iter().enumerate().map(|(number, robot)| {
        let deployment = &deployment;
        async move {
            let credentials = Some((robot.robot_id.as_str(), robot.token.as_str()));
            let login = Login { client_id: robot.robot_id.as_str(), credentials };
            let link = Link::connect(taskd.mqtt, number, &login).await?;
            let topic = robot.mqtt.prefix.format(&Topic::Robot(robot.robot_id.clone(), RobotTopic::Report));
            Ok(Reporter { link, topic, report: report(robot, deployment)? })
        }
    });
    futures_util::stream::iter(connecting).buffered(CONNECTS_AT_ONCE).try_collect().await
}

/// What a robot says while it fetches.
fn report(robot: &EnrollResponse, deployment: &DeploymentId) -> anyhow::Result<Report> {
    let blob = BlobRef { digest: Digest::of(b""), size: 0 };
    let (name, version) = ("status".parse()?, "1".parse()?);
    let task = TaskReport {
        task: "status".parse()?,
        deployment: deployment.clone(),
        package: PackageRef { name, version, manifest: blob, config: blob, content: blob },
        wanted: Wanted::Running,
        run: 1,
        kind: None,
        phase: Phase::Fetching,
        phase_ms: 0,
        progress: Some(Progress { done: 0, total: 0 }),
        missing_parts: None,
        attempts: 1,
        restarts: 0,
        failure: None,
        degraded: None,
        active: None,
    };
    Ok(Report {
        robot_id: robot.robot_id.clone(),
        start: 1,
        instance: InstanceId::random(),
        boot_id: "00000000-0000-0000-0000-000000000000".to_owned(),
        seq: 0,
        observed_generation: Generation(1),
        uptime_ms: 0,
        host: HostFacts {
            agent_version: concat!("taskbench ", env!("CARGO_PKG_VERSION")).to_owned(),
            hostname: robot.name.to_string(),
            arch: std::env::consts::ARCH.to_owned(),
            ..HostFacts::default()
        },
        conditions: Vec::new(),
        link: None,
        tasks: vec![task],
    })
}

async fn measure(
    taskd: &Taskd,
    robots: &mut [Reporter],
    rate: u32,
    seconds: u64,
    point: &mut Point,
) -> anyhow::Result<()> {
    let mut syncs = sync_ms(taskd.dir())?;
    let (count, total) = (robots.len(), usize::try_from(u64::from(rate) * seconds)?);
    let before = taskd.usage();
    let begin = Instant::now() + LEAD;
    let due = |number: usize| begin + Duration::from_secs_f64(number as f64 / f64::from(rate));
    let reporting = robots.iter_mut().enumerate().map(|(first, robot)| {
        let due: Vec<Instant> = (first..total).step_by(count).map(due).collect();
        robot.keep_reporting(due)
    });
    let outcomes = futures_util::future::join_all(reporting).await;
    let cpu_s = taskd.usage().cpu_s - before.cpu_s;
    let wall = begin.elapsed();
    syncs.extend(sync_ms(taskd.dir())?);
    let mut stored = Vec::with_capacity(total);
    for outcome in outcomes {
        match outcome {
            Ok(samples) => stored.extend(samples),
            Err(error) => point.fail(format!("{error:#}")),
        }
    }
    point.measure("stored_per_s", Unit::PerSecond, [stored.len() as f64 / wall.as_secs_f64()]);
    point.measure("server_cpu_us_per_report", Unit::Number, [cpu_s * 1e6 / stored.len().max(1) as f64]);
    point.measure("anonymous_memory", Unit::Bytes, [taskd.usage().anonymous_bytes as f64]);
    point.measure("stored_after", Unit::Milliseconds, stored);
    point.measure("fsync", Unit::Milliseconds, syncs);
    Ok(())
}

impl Reporter {
    /// Reports whenever it is due, acknowledged or not; gives how long after that each report was stored, in milliseconds.
    async fn keep_reporting(&mut self, due: Vec<Instant>) -> anyhow::Result<Vec<f64>> {
        let mut stored = Vec::with_capacity(due.len());
        let mut sent = 0;
        while stored.len() < due.len() {
            let next = due.get(sent).copied();
            let until = next.unwrap_or_else(|| Instant::now() + PATIENCE);
            tokio::select! {
                heard = self.link.reader.next() => {
                    if let Heard::Acknowledged(_) = heard? {
                        stored.push(due[stored.len()].elapsed().as_secs_f64() * 1000.0);
                    }
                }
                () = tokio::time::sleep_until(until.into()) => {
                    if next.is_none() {
                        bail!("no acknowledgement within {PATIENCE:?}");
                    }
                    self.send().await?;
                    sent += 1;
                }
            }
        }
        Ok(stored)
    }

    async fn send(&mut self) -> anyhow::Result<()> {
        self.report.seq += 1;
        let seq = self.report.seq;
        self.report.uptime_ms = seq * 1000;
        for task in &mut self.report.tasks {
            let phases = [Phase::Fetching, Phase::Unpacking, Phase::Staged, Phase::Starting];
            task.phase = phases[usize::try_from(seq / REPORTS_PER_PHASE)? % phases.len()];
            task.progress = Some(Progress { done: seq, total: u64::MAX >> 11 });
        }
        let packet_id = u16::try_from(seq % 65_535)? + 1;
        let payload = serde_json::to_vec(&self.report)?;
        let packet = message(&self.topic, packet_id, &payload)?;
        self.link.writer.write_all(&packet).await.context("the connection broke")
    }
}

/// What appending a page and syncing it takes, again and again, in milliseconds.
fn sync_ms(dir: &Path) -> anyhow::Result<Vec<f64>> {
    let mut file = tempfile::tempfile_in(dir).context("a file to sync")?;
    let mut samples = Vec::with_capacity(SYNCS);
    for _ in 0..SYNCS {
        let begun = Instant::now();
        file.write_all(&[0; 4096]).and_then(|()| file.sync_data()).context("a file can't be synced")?;
        samples.push(begun.elapsed().as_secs_f64() * 1000.0);
    }
    Ok(samples)
}
