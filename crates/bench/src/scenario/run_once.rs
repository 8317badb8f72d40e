//! One order, from its creation to its end: a package that no robot has cached, pushed beforehand;
//! the time from the order to each robot's verified answer; the bytes at the server's sockets
//! meanwhile; whether every robot has the pushed payload.

use std::time::Duration;

use anyhow::{Context as _, ensure};
use task_proto::api::{
    AssignmentView, CreateDeployment, DeliveryChoice, DeploymentView, ServerInfo,
};
use task_proto::{Digest, TaskName, Version};

use crate::programs::package::Package;
use crate::programs::taskd::Taskd;
use crate::simulated::fleet::{Arrivals, Fleet, first};
use crate::system::clock::monotonic_ns;

/// The name of every package.
const NAME: &str = "taskbench";
/// The rule in the decision for a robot that was told to pull because its pushed transfer was too
/// slow.
const FELL_BEHIND: &str = "fell behind";
/// Payloads above this size are hashed again in samples only: the agent has hashed each.
const CHECKED_BYTES: u64 = 20_000_000;

/// Parameters of one order.
#[derive(Debug, Clone, Copy)]
pub struct DeliveryArgs {
    /// The delivery mechanism to use.
    pub choice: DeliveryChoice,
    /// Size of the payload.
    pub payload_bytes: u64,
    /// Number of robots; the order goes to the first ones of the fleet.
    pub robots: usize,
    /// Seed of the payload's bytes; unique for each order of a run.
    pub seed: u64,
    pub limit: Duration,
}

/// The result of one order.
#[derive(Debug, Default)]
pub struct Outcome {
    /// Each robot's delay, and why others did not arrive.
    pub arrivals: Arrivals,
    /// Bytes at the sockets both ways, from the order to the last answer, the order itself
    /// included.
    pub mqtt_bytes: u64,
    /// Bytes at the HTTP sockets, both ways, over the same time.
    pub http_bytes: u64,
    /// Processor seconds of the server, from the order to the last answer.
    pub server_cpu_s: f64,
    /// Processor seconds of all robots together, over the same time.
    pub robots_cpu_s: f64,
    /// The decisions: mechanism and rule.
    pub decisions: Vec<String>,
    /// Robots that were told to pull because their transfers were too slow.
    pub fell_behind: usize,
}

/// Makes the order and waits for its end. An error means that the bench failed; failures of the
/// system under test are in the outcome.
pub async fn run_once(
    taskd: &Taskd,
    fleet: &mut Fleet,
    order: DeliveryArgs,
) -> anyhow::Result<Outcome> {
    let (name, version): (TaskName, Version) =
        (NAME.parse()?, format!("{:016x}", order.seed).parse()?);
    let of = name.clone();
    let bytes = order.payload_bytes;
    let seed = order.seed;
    let package =
        tokio::task::spawn_blocking(move || Package::random(of, version, bytes, seed)).await?;
    let payload = package.payload;
    let manifest = taskd.server.push(package).await.context("the package can't be pushed")?;
    let selector = first(order.robots, fleet.robots).parse()?;
    let create = CreateDeployment {
        delivery: order.choice,
        ..CreateDeployment::new(name.clone(), manifest, selector)
    };
    let (before, own) = own_bytes(taskd).await?;
    let server = taskd.usage();
    let robots = fleet.usage();
    let ordered_ns = monotonic_ns();
    let deployment = match taskd.server.order(&create).await {
        Ok(deployment) => deployment,
        Err(error) => {
            let refused = format!("the order is refused: {:#}", anyhow::Error::new(error));
            taskd
                .server
                .remove_package(&name, &manifest)
                .await
                .context("the package can't be removed")?;
            return Ok(Outcome::failed(refused, order.robots));
        }
    };
    let arrivals = fleet.verified(&deployment.id, order.robots, ordered_ns, order.limit).await?;
    let server_cpu_s = taskd.usage().cpu_s - server.cpu_s;
    let robots_cpu_s = fleet.usage().cpu_s - robots.cpu_s;
    let after = taskd.server.info().await?;
    let view = taskd.server.deployment(&deployment.id).await?;
    let mut outcome = Outcome {
        mqtt_bytes: mqtt_bytes(&after) - mqtt_bytes(&before),
        http_bytes: (http_bytes(&after) - http_bytes(&before)).saturating_sub(own),
        server_cpu_s,
        robots_cpu_s,
        arrivals,
        ..Outcome::default()
    };
    outcome.read_decisions(&view, order.choice);
    check_payloads(fleet, &mut outcome.arrivals, order.payload_bytes, &name, &manifest, payload)?;
    // Robots keep the package until the next order replaces it; its name is no longer needed.
    taskd.server.remove_package(&name, &manifest).await.context("the package can't be removed")?;
    Ok(outcome)
}

impl Outcome {
    /// The outcome of an order by which none of `robots` robots received the package.
    pub fn failed(why: String, robots: usize) -> Self {
        Self {
            arrivals: Arrivals { arrived: Vec::new(), failures: vec![why; robots] },
            ..Self::default()
        }
    }

    fn read_decisions(&mut self, view: &DeploymentView, choice: DeliveryChoice) {
        let mut other = Vec::new();
        let assignments =
            || view.assignments.iter().flatten().filter(|one: &&AssignmentView| one.released);
        for decision in assignments().filter_map(|one| one.delivery.as_ref()) {
            self.decisions.push(format!("{} ({})", decision.mechanism, decision.rule));
            if decision.rule == FELL_BEHIND {
                self.fell_behind += 1;
            } else if choice.mechanism().is_some_and(|ordered| ordered != decision.mechanism) {
                other.push(format!("the server delivers by {} instead", decision.mechanism));
            }
        }
        let is_plain = choice == DeliveryChoice::PushPull;
        let untold = assignments().filter(|one| one.delivery.is_none() && !is_plain);
        other
            .extend(untold.map(|_| "the server does not report its delivery mechanism".to_owned()));
        if !other.is_empty() {
            // The figures would be another mechanism's.
            self.arrivals = Arrivals { arrived: Vec::new(), failures: other };
        }
    }
}

/// Digests of the payloads on the robots; a failure for each robot with a different payload. The
/// agent has verified each payload: this checks the bench.
fn check_payloads(
    fleet: &Fleet,
    arrivals: &mut Arrivals,
    payload_bytes: u64,
    name: &TaskName,
    manifest: &Digest,
    payload: Digest,
) -> anyhow::Result<()> {
    let mut wrong = Vec::new();
    let checked = if payload_bytes > CHECKED_BYTES { 1 } else { arrivals.arrived.len() };
    for (robot, _) in arrivals.arrived.iter().take(checked) {
        if fleet.payload(*robot, name, manifest)? != payload {
            wrong.push(*robot);
        }
    }
    arrivals.arrived.retain(|(robot, _)| !wrong.contains(robot));
    arrivals.failures.extend(
        wrong.iter().map(|_| "a robot has verified other bytes than were pushed".to_owned()),
    );
    Ok(())
}

/// The current byte counters, and how many bytes the request itself costs.
async fn own_bytes(taskd: &Taskd) -> anyhow::Result<(ServerInfo, u64)> {
    let first = taskd.server.info().await?;
    let second = taskd.server.info().await?;
    ensure!(
        http_bytes(&second) > http_bytes(&first),
        "the server does not count the bytes over HTTP"
    );
    let own = http_bytes(&second) - http_bytes(&first);
    Ok((second, own))
}

fn mqtt_bytes(info: &ServerInfo) -> u64 {
    info.traffic.all.bytes_in + info.traffic.all.bytes_out
}

fn http_bytes(info: &ServerInfo) -> u64 {
    info.http.bytes_in + info.http.bytes_out
}
