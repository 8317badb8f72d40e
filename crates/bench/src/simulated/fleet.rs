//! A run's view of its simulated robots: registers them, starts their processes, and receives each
//! robot's arrivals with their times.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use task_proto::api::{CreateEnrollmentToken, EnrollRequest};
use task_proto::ids::Labels;
use task_proto::trust::token::Token;
use task_proto::{CaPin, DeploymentId, Digest, MacAddress, TaskName};
use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::process::{ChildStdin, ChildStdout};
use tokio::sync::mpsc;
use tokio::time::Instant;

use crate::measure::phase::{PHASE_LIMIT, run_all};
use crate::programs::package::PAYLOAD_FILE;
use crate::programs::server::Server;
use crate::programs::taskd::Taskd;
use crate::simulated::robots::messages::{
    Entrance, GroupMember, RobotCommand, RobotEvent, RobotGroup,
};
use crate::system::clock::monotonic_ns;
use crate::system::link::Link;
use crate::system::process::{Process, Program, Usage};

/// Enrollments under way at a time.
const CONCURRENT_REQUESTS: usize = 16;
/// Robots per process: each takes about [`FILES_PER_ROBOT`] open files, of which systems grant
/// 20,000 and more.
pub const ROBOTS_PER_PROCESS: usize = 2500;
/// The most open files per robot: MQTT, which takes three with encryption, HTTP connections, files
/// being written.
pub const FILES_PER_ROBOT: usize = 7;
/// Events from the robots' processes that were not read yet.
const QUEUED_EVENTS: usize = 1024;
/// Directory of the robots' data, in memory: every real robot has its own disk, and here all would
/// share one.
const MEMORY: &str = "/dev/shm";
/// Other output of the robots' processes.
const LOG: &str = "robots.log";
/// Time limit for setting up all robots.
const ASSEMBLY_LIMIT: Duration = Duration::from_secs(300);

/// Running simulated robots. Dropping the fleet kills them.
pub struct Fleet {
    processes: Vec<(Process, ChildStdin)>,
    /// `None`: a process has ended.
    events: mpsc::Receiver<Option<RobotEvent>>,
    dir: TempDir,
    logs: Vec<PathBuf>,
    pub robots: usize,
    /// Duration of each robot's registration.
    pub enrollments: Vec<Duration>,
}

/// Where and how a fleet connects.
pub struct FleetArgs<'a> {
    /// The server that registers the robots.
    pub server: &'a Server,
    pub pin: Option<CaPin>,
    /// Each robot has the entrance at its number, counted round.
    pub entrances: Vec<Entrance>,
    pub robots: usize,
    /// Pause between two polls while a session is up.
    pub poll: Duration,
    /// Whether each robot connects over HTTP from a loopback address of its own.
    pub own_addresses: bool,
    /// The program that starts the robots' processes, if they need a namespace.
    pub outer: Option<Program>,
    /// Whether robots write a log, instead of sending events.
    pub logged: bool,
}

/// The result of an order, robot by robot.
#[derive(Debug, Default)]
pub struct Arrivals {
    /// Robots that arrived, and after how many milliseconds.
    pub arrived: Vec<(usize, f64)>,
    /// Why the others did not.
    pub failures: Vec<String>,
}

impl Arrivals {
    /// The delays in milliseconds.
    pub fn delays_ms(&self) -> impl Iterator<Item = f64> {
        self.arrived.iter().map(|(_, ms)| *ms)
    }

    /// The delay of the last robot.
    pub fn last_ms(&self) -> Option<f64> {
        self.delays_ms().max_by(f64::total_cmp)
    }
}

impl Fleet {
    /// Registers `robots` robots at `taskd` and puts them together; they do not run yet.
    pub async fn assemble(
        taskd: &Taskd,
        robots: usize,
        poll: Duration,
        link: Option<&Link>,
    ) -> anyhow::Result<Self> {
        let entrance = Entrance { url: taskd.url(), mqtt_host: taskd.mqtt.ip().to_string() };
        let args = FleetArgs {
            server: &taskd.server,
            pin: taskd.pin,
            entrances: vec![entrance],
            robots,
            poll,
            own_addresses: link.is_none(),
            outer: link.map(Link::inside),
            logged: false,
        };
        Self::assemble_with(args).await
    }

    /// Registers the robots and puts them together; they do not run yet.
    pub async fn assemble_with(args: FleetArgs<'_>) -> anyhow::Result<Self> {
        let robots = args.robots;
        let (members, enrollments, key) = enroll_robots(args.server, robots).await?;
        let dir = memory_directory("taskbench-robots-")?;
        let (sender, events) = mpsc::channel(QUEUED_EVENTS);
        let logs = Vec::new();
        let mut fleet = Self { processes: Vec::new(), events, dir, logs, robots, enrollments };
        let mut members = members.into_iter();
        for first in (0..robots).step_by(ROBOTS_PER_PROCESS) {
            let log = args.logged.then(|| fleet.dir.path().join(format!("from-{first}.log")));
            fleet.logs.extend(log.clone());
            let group = RobotGroup {
                entrances: args.entrances.clone(),
                pin: args.pin,
                key: key.clone(),
                data: fleet.dir.path().to_owned(),
                poll_ms: u64::try_from(args.poll.as_millis())?,
                own_addresses: args.own_addresses,
                log,
                first,
                members: members.by_ref().take(ROBOTS_PER_PROCESS).collect(),
            };
            fleet.add(&group, args.outer.clone(), sender.clone()).await?;
        }
        let ready = async {
            for _ in 0..fleet.processes.len() {
                match fleet.events.recv().await {
                    Some(Some(RobotEvent::Ready)) => {}
                    _ => return Err(fleet.lost("ended")),
                }
            }
            Ok(())
        };
        match tokio::time::timeout(ASSEMBLY_LIMIT, ready).await {
            Ok(ready) => ready?,
            Err(_) => return Err(fleet.lost(&format!("was not ready within {ASSEMBLY_LIMIT:?}"))),
        }
        Ok(fleet)
    }

    /// Starts a further process with these robots.
    async fn add(
        &mut self,
        group: &RobotGroup,
        outer: Option<Program>,
        sender: mpsc::Sender<Option<RobotEvent>>,
    ) -> anyhow::Result<()> {
        let mut program = Program::beside("taskbench", None)?.args(["robots"]);
        if let Some(outer) = outer {
            program = program.within(outer);
        }
        let (process, input, output) = program.converse(&self.dir.path().join(LOG))?;
        tokio::spawn(read_events(output, sender));
        self.processes.push((process, input));
        self.send_line(self.processes.len() - 1, &serde_json::to_vec(group)?).await
    }

    /// Starts all robots at once; returns for each one the time until the robot follows the
    /// server's state and the server knows.
    pub async fn start(&mut self, limit: Duration) -> anyhow::Result<Arrivals> {
        let begun_ns = monotonic_ns();
        let start = serde_json::to_vec(&RobotCommand::Start)?;
        for process in 0..self.processes.len() {
            self.send_line(process, &start).await?;
        }
        let outcome_of = |event: RobotEvent| match event {
            RobotEvent::Reconciled { robot, at_ns } => Some((robot, Ok(at_ns))),
            _ => None,
        };
        self.collect(self.robots, begun_ns, limit, "is not connected and reconciled", outcome_of)
            .await
    }

    /// Waits until the first `robots` robots have verified `deployment`, ordered at `ordered_ns`,
    /// or have failed.
    pub async fn verified(
        &mut self,
        deployment: &DeploymentId,
        robots: usize,
        ordered_ns: u64,
        limit: Duration,
    ) -> anyhow::Result<Arrivals> {
        let outcome_of = |event: RobotEvent| match event {
            RobotEvent::Verified { robot, deployment: by, at_ns } if by == *deployment => {
                Some((robot, Ok(at_ns)))
            }
            RobotEvent::Failed { robot, deployment: by, why } if by == *deployment => {
                Some((robot, Err(why)))
            }
            _ => None,
        };
        self.collect(robots, ordered_ns, limit, "has not verified it", outcome_of).await
    }

    async fn collect(
        &mut self,
        robots: usize,
        since_ns: u64,
        limit: Duration,
        missing: &str,
        outcome_of: impl Fn(RobotEvent) -> Option<(usize, Result<u64, String>)>,
    ) -> anyhow::Result<Arrivals> {
        let deadline = Instant::now() + limit;
        let mut arrivals = Arrivals::default();
        let mut seen = vec![false; robots];
        while seen.contains(&false) {
            let Ok(event) = tokio::time::timeout_at(deadline, self.events.recv()).await else {
                break;
            };
            let Some(event) = event.flatten() else { return Err(self.lost("ended")) };
            let Some((robot, outcome)) = outcome_of(event) else { continue };
            if seen.get(robot) != Some(&false) {
                continue;
            }
            seen[robot] = true;
            match outcome {
                Ok(at_ns) => {
                    arrivals.arrived.push((robot, at_ns.saturating_sub(since_ns) as f64 / 1e6))
                }
                Err(why) => arrivals.failures.push(why),
            }
        }
        let late = seen.iter().filter(|seen| !**seen).count();
        arrivals.failures.extend((0..late).map(|_| format!("a robot {missing} within {limit:?}")));
        Ok(arrivals)
    }

    /// Digest of the payload that robot `number` has unpacked.
    pub fn payload(
        &self,
        number: usize,
        package: &TaskName,
        manifest: &Digest,
    ) -> anyhow::Result<Digest> {
        let data =
            task_agent::system::layout::DataDir::new(&self.dir.path().join(number.to_string()))?;
        let path: PathBuf = data.task(package).version(manifest).src().join(PAYLOAD_FILE);
        let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
        Ok(Digest::of(&bytes))
    }

    /// The robots' logs, one of each process; empty unless the robots were to log.
    pub fn logs(&self) -> &[PathBuf] {
        &self.logs
    }

    /// Resource usage of all robots together until now.
    pub fn usage(&self) -> Usage {
        let each = self.processes.iter().map(|(process, _)| process.usage());
        each.fold(Usage::default(), Usage::plus)
    }

    pub async fn end(self) -> anyhow::Result<()> {
        for (process, input) in self.processes {
            // Its end is the sign to end.
            drop(input);
            process.end().await;
        }
        self.dir.close().context("the robots' directory can't be removed")
    }

    async fn send_line(&mut self, process: usize, line: &[u8]) -> anyhow::Result<()> {
        let (_, input) = self.processes.get_mut(process).context("no such process")?;
        let sent = async {
            input.write_all(line).await?;
            input.write_all(b"\n").await?;
            input.flush().await
        };
        let sent = sent.await;
        sent.map_err(|error| self.lost(&format!("can't be written to: {error}")))
    }

    fn lost(&self, what: &str) -> anyhow::Error {
        let log = std::fs::read_to_string(self.dir.path().join(LOG)).unwrap_or_default();
        anyhow!(
            "a process of robots {what}: {}",
            log.trim().lines().next_back().unwrap_or("no output")
        )
    }
}

/// A directory in memory, or a normal temporary one if the system has none in memory.
pub fn memory_directory(prefix: &str) -> anyhow::Result<TempDir> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(prefix);
    let memory = Path::new(MEMORY);
    let dir = if memory.is_dir() { builder.tempdir_in(memory) } else { builder.tempdir() };
    dir.context("cannot create the robots' directory")
}

async fn read_events(output: ChildStdout, sender: mpsc::Sender<Option<RobotEvent>>) {
    let mut lines = BufReader::new(output).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        let Ok(event) = serde_json::from_str(&line) else { break };
        if sender.send(Some(event)).await.is_err() {
            return;
        }
    }
    // Without a receiver the message is not needed.
    let _ = sender.send(None).await;
}

/// Registers robots named `r0000`, `r0001`, … with addresses that no hardware has.
async fn enroll_robots(
    server: &Server,
    robots: usize,
) -> anyhow::Result<(Vec<GroupMember>, Vec<Duration>, task_proto::trust::envelope::PublicKey)> {
    let order = CreateEnrollmentToken { uses: Some(robots as u64), ..Default::default() };
    let token = server.create_enrollment_token(&order).await?.token;
    let key =
        token.parse::<Token>()?.server_key().context("the enrollment token pins no key")?.clone();
    let steps = (0..robots).map(|number| {
        let token = &token;
        async move {
            let begun = std::time::Instant::now();
            let [.., a, b, c] = u64::try_from(number)?.to_be_bytes();
            let mac = MacAddress::from_octets([0x02, 0, 0, a, b, c]).context("no MAC")?;
            let name = Some(name(number).parse()?);
            let enrolled = server
                .enroll(
                    token,
                    &EnrollRequest { mac, name, labels: Labels::new(), client_key: None },
                )
                .await?;
            Ok((number, GroupMember { mac, enrolled }, begun.elapsed()))
        }
    });
    let mut all = Vec::with_capacity(robots);
    for step in run_all(CONCURRENT_REQUESTS, PHASE_LIMIT, steps).await {
        all.push(step.context("a robot can't be registered")?);
    }
    if all.len() != robots {
        bail!("{} of {robots} robots were registered", all.len());
    }
    all.sort_unstable_by_key(|(number, ..)| *number);
    let (members, took) = all.into_iter().map(|(_, member, took)| (member, took)).unzip();
    Ok((members, took, key))
}

pub fn name(number: usize) -> String {
    format!("r{number:05}")
}

/// The selector of the first `robots` of a fleet of `all`.
pub fn first(robots: usize, all: usize) -> String {
    if robots == all { "*".to_owned() } else { (0..robots).map(name).collect::<Vec<_>>().join(",") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_robots_are_named() {
        assert_eq!((first(2, 8), first(8, 8)), ("r00000,r00001".to_owned(), "*".to_owned()));
    }

    #[test]
    fn last_arrival_is_the_maximum_delay() {
        let arrivals =
            Arrivals { arrived: vec![(0, 3.0), (1, 9.0), (2, 5.0)], failures: Vec::new() };
        assert_eq!((arrivals.last_ms(), Arrivals::default().last_ms()), (Some(9.0), None));
    }
}
