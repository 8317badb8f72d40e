//! Robots that are connected over MQTT, have one order, and report on that order at fixed times:
//! their reports are measured, or only keep a fleet busy.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use anyhow::{Context as _, bail};
use futures_util::{StreamExt as _, TryStreamExt as _};
use task_proto::api::{CreateDeployment, DeliveryChoice, EnrollResponse};
use task_proto::desired::{BlobRef, Delivery, DesiredTask, PackageRef, TargetState};
use task_proto::messages::report::{HostFacts, Phase, Progress, Report, TaskReport};
use task_proto::messages::topic::{RobotTopic, Topic};
use task_proto::{DeploymentId, Digest, Generation, InstanceId};
use tokio::io::AsyncWriteExt as _;

use crate::measure::mqtt::{Link, Login, Packet, message};
use crate::programs::enrollment::enroll_robots;
use crate::programs::server::Server;
use crate::programs::taskd::Taskd;
use crate::results::run::Point;

/// Connections opened at a time.
const CONCURRENT_CONNECTS: usize = 64;
/// One in this many reports shows the next phase of the task; the others show progress within a
/// phase.
const REPORTS_PER_PHASE: u64 = 10;
/// Time limit for the last acknowledgements.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);
/// From ordering the reports until the first is due.
const LEAD: Duration = Duration::from_millis(500);

/// A robot that is connected and has an order to report on.
pub struct Reporter {
    link: Link,
    topic: String,
    report: Report,
}

/// Registers `count` robots, orders a package for them and connects them.
pub async fn connect(taskd: &Taskd, count: usize) -> anyhow::Result<Vec<Reporter>> {
    connect_to(&taskd.server, &[taskd.mqtt], count).await
}

/// The same at several servers, which get equal shares of the robots.
pub async fn connect_to(
    server: &Server,
    addresses: &[SocketAddr],
    count: usize,
) -> anyhow::Result<Vec<Reporter>> {
    let robots = enroll_robots(server, count).await?;
    let package = "status".parse()?;
    let version = "1".parse()?;
    let manifest = server.push_package(&package, &version).await?;
    let order = CreateDeployment {
        delivery: DeliveryChoice::Poll,
        ..CreateDeployment::new(package, manifest, "*".parse()?)
    };
    let deployment = server.order(&order).await?.id;
    let connecting = robots.iter().enumerate().map(|(number, robot)| {
        let deployment = &deployment;
        let address = addresses.get(number % addresses.len().max(1));
        async move {
            let address = *address.context("no address of a server")?;
            let credentials = Some((robot.robot_id.as_str(), robot.token.as_str()));
            let login = Login { client_id: robot.robot_id.as_str(), credentials };
            let link = Link::connect(address, number, &login).await?;
            let topic =
                robot.mqtt.prefix.format(&Topic::Robot(robot.robot_id.clone(), RobotTopic::Report));
            Ok(Reporter { link, topic, report: report(robot, deployment)? })
        }
    });
    futures_util::stream::iter(connecting).buffered(CONCURRENT_CONNECTS).try_collect().await
}

/// A robot's report during a fetch.
fn report(robot: &EnrollResponse, deployment: &DeploymentId) -> anyhow::Result<Report> {
    let blob = BlobRef { digest: Digest::of(b""), size: 0 };
    let name = "status".parse()?;
    let version = "1".parse()?;
    let task = DesiredTask {
        task: "status".parse()?,
        deployment: deployment.clone(),
        package: PackageRef { name, version, manifest: blob, config: blob, content: blob },
        wanted: TargetState::Running,
        run: 1,
        delivery: Delivery::Poll,
        priority: 0,
    };
    Ok(Report {
        robot_id: robot.robot_id.clone(),
        start: 1,
        instance: InstanceId::random(),
        place: None,
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
        tasks: vec![TaskReport {
            progress: Some(Progress { done: 0, total: 0 }),
            ..TaskReport::of(&task, Phase::Fetching)
        }],
    })
}

/// Lets all robots report `rate` times a second together, for the given number of seconds, each in
/// its turn. Returns the start time, and for each robot how long after its due time each report was
/// stored, in milliseconds.
pub async fn report_at(
    robots: &mut [Reporter],
    rate: u32,
    seconds: u64,
) -> anyhow::Result<(Instant, Vec<anyhow::Result<Vec<f64>>>)> {
    let count = robots.len();
    let total = usize::try_from(u64::from(rate) * seconds)?;
    let begin = Instant::now() + LEAD;
    let due = |number: usize| begin + Duration::from_secs_f64(number as f64 / f64::from(rate));
    let reporting = robots.iter_mut().enumerate().map(|(first, robot)| {
        let due: Vec<Instant> = (first..total).step_by(count).map(due).collect();
        robot.keep_reporting(due)
    });
    Ok((begin, futures_util::future::join_all(reporting).await))
}

/// The times of all robots' reports, in milliseconds. A robot that failed is a failure of `point`.
pub fn stored_times(outcomes: Vec<anyhow::Result<Vec<f64>>>, point: &mut Point) -> Vec<f64> {
    let mut stored = Vec::new();
    for outcome in outcomes {
        match outcome {
            Ok(times) => stored.extend(times),
            Err(error) => point.fail(format!("{error:#}")),
        }
    }
    stored
}

impl Reporter {
    /// Reports at the due times, acknowledged or not; returns how long after that each report was
    /// stored, in milliseconds.
    async fn keep_reporting(&mut self, due: Vec<Instant>) -> anyhow::Result<Vec<f64>> {
        let mut stored = Vec::with_capacity(due.len());
        let mut sent = 0;
        while stored.len() < due.len() {
            let next = due.get(sent).copied();
            let until = next.unwrap_or_else(|| Instant::now() + ANSWER_TIMEOUT);
            tokio::select! {
                heard = self.link.reader.next() => {
                    if let Packet::Acknowledged(_) = heard? {
                        stored.push(due[stored.len()].elapsed().as_secs_f64() * 1000.0);
                    }
                }
                () = tokio::time::sleep_until(until.into()) => {
                    if next.is_none() {
                        bail!("no acknowledgement within {ANSWER_TIMEOUT:?}");
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
