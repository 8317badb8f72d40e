//! A load run: its flags, its phases in order, and its results. Every phase is bounded by
//! [`PHASE_LIMIT`], and a phase without any success ends the run.

mod report;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use clap::Args;
use reqwest::Url;
use task_proto::api::{
    CreateDeployment, CreateEnrollmentToken, DeliveryChoice, EnrollRequest, PhaseCount,
};
use task_proto::ids::Labels;
use task_proto::messages::report::Phase as TaskPhase;
use task_proto::trust::token::Token;
use task_proto::{DeploymentId, Digest, MacAddress, TaskName, Version};

use self::report::{Facts, Format, LoadReport};
use crate::measure::phase::{PHASE_LIMIT, Phase, Sample, run_all};
use crate::programs::server::Server;
use crate::simulated::robot::{Identity, Robot};
use crate::system::machine::allow_files;

/// HTTP requests under way at a time.
const CONCURRENT_REQUESTS: usize = 16;
/// MQTT connections begun at a time, the reconnect storm excepted.
const CONCURRENT_CONNECTS: usize = 100;
/// The label that robots of a run carry, and the name of the package they are ordered.
const NAME: &str = "taskbench";
/// Poll interval while waiting for the server to show stored state.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Lifetime of a run's enrollment token, in case the run can't clean up.
const TOKEN_TTL_S: u64 = 3600;
/// Files this process needs besides its robots' connections.
const OTHER_FILES: u64 = 100;

/// The server to measure, and the load.
#[derive(Debug, Args)]
pub struct LoadFlags {
    /// URL of the server
    #[arg(long, value_name = "URL")]
    server: Url,
    /// A file that holds the operator's token (operator.token in the server's data directory)
    #[arg(long, value_name = "FILE")]
    token_file: PathBuf,
    /// How many robots to simulate, at most 20000
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=20_000))]
    robots: u16,
    /// The MQTT broker [default: the address that the server gives its robots]
    #[arg(long, value_name = "HOST:PORT", value_parser = host_and_port)]
    mqtt: Option<(String, u16)>,
    /// Duration of steady reports in seconds, at most 3600
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=3600))]
    seconds: u64,
    /// Steady reports per second, of all robots together; each changes its task's phase. At most
    /// 5000
    #[arg(long, value_name = "R", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=5000))]
    reports_per_s: u32,
    /// Output format
    #[arg(short, long, value_enum, default_value_t = Format::Table, value_name = "FORMAT")]
    output: Format,
    /// Leave the robots and the package on the server
    #[arg(long)]
    keep: bool,
}

/// A run, from its first question to the server on.
pub struct Load {
    flags: LoadFlags,
    server: Server,
    /// Distinguishes this run's robots and package from those of other runs.
    run: String,
    manifest: Option<Digest>,
    report: LoadReport,
}

impl Load {
    /// Checks all preconditions before anything is changed on the server.
    pub async fn prepare(flags: LoadFlags) -> anyhow::Result<Self> {
        allow_files(u64::from(flags.robots) + OTHER_FILES)?;
        let text = std::fs::read_to_string(&flags.token_file);
        let text = text.with_context(|| format!("--token-file {}", flags.token_file.display()))?;
        let token: Token =
            text.parse().with_context(|| format!("--token-file {}", flags.token_file.display()))?;
        let server = Server::new(flags.server.clone(), &token, None)?;
        let info = server.info().await.with_context(|| format!("--server {}", flags.server))?;
        let facts = Facts {
            taskbench: env!("CARGO_PKG_VERSION"),
            taskd: info.version,
            server: flags.server.to_string(),
            robots: flags.robots.into(),
            seconds: flags.seconds,
            reports_per_s: flags.reports_per_s,
            cores: std::thread::available_parallelism().map_or(1, usize::from),
        };
        let report = LoadReport::begin(facts, flags.output);
        Ok(Self {
            flags,
            server,
            run: format!("{:08x}", rand::random::<u32>()),
            manifest: None,
            report,
        })
    }

    /// All phases but the last.
    pub async fn run(&mut self) -> anyhow::Result<()> {
        let mut robots = self.enroll_robots().await?;
        let count = robots.len();

        let begun = Instant::now();
        let steps = robots.iter_mut().map(async |robot| Ok(robot.connect().await?));
        self.add("connect", begun, run_all(CONCURRENT_CONNECTS, PHASE_LIMIT, steps).await)?;

        let begun = Instant::now();
        let steps =
            robots.iter_mut().map(async |robot| Ok(robot.report(TaskPhase::Assigned).await?));
        self.add("first report", begun, run_all(count, PHASE_LIMIT, steps).await)?;

        self.order(&mut robots).await?;
        self.steady(&mut robots).await?;

        robots.iter_mut().for_each(Robot::disconnect);
        let begun = Instant::now();
        let steps = robots.iter_mut().map(async |robot| {
            robot.connect().await?;
            robot.report(TaskPhase::Running).await?;
            Ok(begun.elapsed())
        });
        self.add("reconnect storm", begun, run_all(count, PHASE_LIMIT, steps).await)
    }

    /// The last phase: removes this run's robots and package, in whatever phase the run ended.
    pub async fn clean_up(&mut self) -> anyhow::Result<()> {
        if self.flags.keep {
            return Ok(());
        }
        let begun = Instant::now();
        // The server's list, not ours: an enrollment may have been stored although its answer was
        // lost.
        let left = self.server.robots(&self.label().parse()?).await?.robots;
        let steps = left.iter().map(async |robot| {
            let begun = Instant::now();
            self.server.remove_robot(&robot.id).await?;
            Ok(begun.elapsed())
        });
        let samples = run_all(CONCURRENT_REQUESTS, PHASE_LIMIT, steps).await;
        if let Some(manifest) = self.manifest.take() {
            self.server.remove_package(&NAME.parse()?, &manifest).await?;
        }
        self.add("remove", begun, samples)
    }

    /// Prints the remaining output, and returns the number of failed steps.
    pub fn finish(&self) -> usize {
        self.report.finish()
    }

    /// The label of this run's robots, which is also their selector.
    pub fn label(&self) -> String {
        format!("{NAME}={}", self.run)
    }

    async fn enroll_robots(&mut self) -> anyhow::Result<Vec<Robot>> {
        let labels: Labels = [(NAME.parse()?, self.run.parse()?)].into();
        let order = CreateEnrollmentToken {
            labels,
            ttl_s: Some(TOKEN_TTL_S),
            uses: Some(self.flags.robots.into()),
            ..Default::default()
        };
        let token = self.server.create_enrollment_token(&order).await?.token;
        let key = token
            .parse::<Token>()?
            .server_key()
            .context("the enrollment token pins no key")?
            .clone();
        // Locally administered addresses, distinct from those of other runs.
        let [a, b] = rand::random();
        let server = &self.server;
        let flags = &self.flags;
        let run = &self.run;
        let begun = Instant::now();
        let steps = (0..flags.robots).map(|number| {
            let token = &token;
            let key = &key;
            async move {
                let begun = Instant::now();
                let [high, low] = number.to_be_bytes();
                let mac = MacAddress::from_octets([0x02, a, b, 0, high, low]).context("no MAC")?;
                let name = Some(format!("{NAME}-{run}-{number:05}").parse()?);
                let enrolled = server
                    .enroll(
                        token,
                        &EnrollRequest { mac, name, labels: Labels::new(), client_key: None },
                    )
                    .await?;
                let host = enrolled
                    .mqtt
                    .host
                    .clone()
                    .or_else(|| flags.server.host_str().map(str::to_owned));
                let default = (host.context("--server names no host")?, enrolled.mqtt.port);
                let (host, port) = flags.mqtt.clone().unwrap_or(default);
                Ok((
                    Robot::new(Identity { enrolled, host, port, key: key.clone() }),
                    begun.elapsed(),
                ))
            }
        });
        let mut robots = Vec::new();
        let mut keep = |(robot, latency)| {
            robots.push(robot);
            latency
        };
        let enrolled = run_all(CONCURRENT_REQUESTS, PHASE_LIMIT, steps).await;
        let samples: Vec<Sample> = enrolled.into_iter().map(|one| one.map(&mut keep)).collect();
        self.add("enrol", begun, samples)?;
        Ok(robots)
    }

    /// Orders a package for all robots, which report its phases until it runs. Both are measured
    /// from the order on.
    async fn order(&mut self, robots: &mut [Robot]) -> anyhow::Result<()> {
        let (package, version): (TaskName, Version) = (NAME.parse()?, self.run.parse()?);
        let manifest = self.server.push_package(&package, &version).await?;
        self.manifest = Some(manifest);
        let order = CreateDeployment {
            delivery: DeliveryChoice::PushPull,
            ..CreateDeployment::new(package, manifest, self.label().parse()?)
        };
        let begun = Instant::now();
        let deployment = self.server.order(&order).await?.id;
        let count = robots.len();
        let deployment = &deployment;
        let steps = robots.iter_mut().map(async |robot| {
            let ordered = robot.receive(deployment).await? - begun;
            let run = async {
                for phase in [TaskPhase::Fetching, TaskPhase::Starting, TaskPhase::Running] {
                    robot.report(phase).await?;
                }
                Ok(begun.elapsed())
            };
            Ok((ordered, run.await))
        });
        let mut ordered = Vec::new();
        let mut running = Vec::new();
        for step in run_all(count, PHASE_LIMIT, steps).await {
            match step {
                Ok((order, run)) => (ordered.push(Ok(order)), running.push(run)),
                Err(error) => (ordered.push(Err(error)), running.push(Err(anyhow!("not ordered")))),
            };
        }
        let last = ordered.iter().flatten().max().copied().unwrap_or_default();
        self.report.add(Phase::new("order", last, ordered))?;
        let missing = self.missing(deployment, running.iter().flatten().count()).await?;
        running.extend(
            (0..missing)
                .map(|_| Err(anyhow!("acknowledged, but the server does not show it running"))),
        );
        self.add("order to running", begun, running)
    }

    /// Waits until the server shows `expected` robots running; returns how many are missing at the
    /// time limit.
    async fn missing(&self, deployment: &DeploymentId, expected: usize) -> anyhow::Result<usize> {
        let deadline = Instant::now() + PHASE_LIMIT;
        let mut tick = tokio::time::interval(POLL_INTERVAL);
        loop {
            tick.tick().await;
            let counts = self.server.deployment(deployment).await?.counts;
            let is_running = |count: &&PhaseCount| count.phase == TaskPhase::Running;
            let running = counts.iter().find(is_running).map_or(0, |count| count.count);
            let missing = expected.saturating_sub(usize::try_from(running)?);
            if missing == 0 || Instant::now() >= deadline {
                return Ok(missing);
            }
        }
    }

    /// Reports at a fixed rate, robot by robot. A report is measured from its due time, so that a
    /// server that falls behind shows.
    async fn steady(&mut self, robots: &mut [Robot]) -> anyhow::Result<()> {
        let count = robots.len();
        let rate = f64::from(self.flags.reports_per_s);
        let total = usize::try_from(self.flags.seconds * u64::from(self.flags.reports_per_s))?;
        let begun = Instant::now();
        let steps = robots.iter_mut().enumerate().map(async |(first, robot)| {
            let mut samples: Vec<Sample> = Vec::new();
            for number in (first..total).step_by(count) {
                let due = begun + Duration::from_secs_f64(number as f64 / rate);
                tokio::time::sleep_until(due.into()).await;
                let phase = if samples.len().is_multiple_of(2) {
                    TaskPhase::Starting
                } else {
                    TaskPhase::Running
                };
                samples.push(robot.report(phase).await.map(|_| due.elapsed()).map_err(Into::into));
            }
            Ok(samples)
        });
        let limit = Duration::from_secs(self.flags.seconds) + PHASE_LIMIT;
        let steps = run_all(count, limit, steps).await;
        let samples =
            steps.into_iter().flat_map(|step| step.unwrap_or_else(|error| vec![Err(error)]));
        self.add("steady reports", begun, samples)
    }

    fn add(
        &mut self,
        name: &'static str,
        begun: Instant,
        samples: impl IntoIterator<Item = Sample>,
    ) -> anyhow::Result<()> {
        self.report.add(Phase::new(name, begun.elapsed(), samples))
    }
}

fn host_and_port(text: &str) -> Result<(String, u16), String> {
    let (host, port) = text.rsplit_once(':').ok_or("expected HOST:PORT")?;
    Ok((host.to_owned(), port.parse().map_err(|_| format!("{port:?} is not a port"))?))
}
