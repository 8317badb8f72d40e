//! Owns the load of a run: orders, a rollout, pushes and deletions of packages, readers of events
//! and questions to robots, each at a random server, all at the same time; it never judges an
//! answer.

mod orders;
mod pusher;
mod questions;
mod rollout;
mod streams;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::Context as _;
use rand::SeedableRng as _;
use rand::rngs::SmallRng;
use task_proto::{DeploymentId, TaskName, Version};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

pub use self::rollout::RolloutSample;
use crate::programs::package::Package;
use crate::programs::server::{Server, ServerError};
use crate::scenario::cluster::database::Database;

/// Time limit of one try at one server: a paused one does not answer.
const TRY_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit of a request with all its tries.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(90);
/// Pause before a further try.
const AGAIN: Duration = Duration::from_millis(200);
/// Time limit for requests under way when the load ends.
const END_TIMEOUT: Duration = Duration::from_secs(120);

/// The sizes of the load.
#[derive(Debug, Clone)]
pub struct LoadArgs {
    /// Robots of the fleet.
    pub robots: usize,
    /// Robots of each order.
    pub order_robots: usize,
    /// Bytes of the package that the rollout is about.
    pub payload_bytes: u64,
    pub seed: u64,
}

/// Everything that the load has done and seen.
#[derive(Debug, Default)]
pub struct Record {
    pub orders: Vec<OrderRecord>,
    /// Pairs of answers to the same order at two servers.
    pub repeated: Vec<(DeploymentId, DeploymentId)>,
    pub samples: Vec<RolloutSample>,
    /// Packages pushed, and deleted.
    pub pushed: u64,
    pub deleted: u64,
    /// Milliseconds until a robot's answer.
    pub answers_ms: Vec<f64>,
    /// Questions that got no answer, by the reason.
    pub unanswered: BTreeMap<String, u64>,
    /// Numbers of the feed's entries, as each connection of a reader got them.
    pub feeds: Vec<Vec<u64>>,
    /// Requests that failed at all servers.
    pub failures: Vec<String>,
}

/// An order to some robots.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OrderRecord {
    pub deployment: DeploymentId,
    /// When its first request was sent, by the machine's monotonic clock.
    pub ordered_ns: u64,
    pub robots: Vec<usize>,
}

/// The servers and the record, for all parts of the load.
#[derive(Clone)]
struct Client {
    servers: Arc<[Arc<Server>]>,
    args: Arc<LoadArgs>,
    record: Arc<Mutex<Record>>,
    /// Cancelled: no further request is begun.
    stop: CancellationToken,
}

/// The running load.
pub struct Load {
    client: Client,
    tasks: JoinSet<anyhow::Result<()>>,
}

impl Load {
    /// Begins the load on these servers.
    pub fn begin(servers: &[Arc<Server>], database: Database, args: LoadArgs) -> Self {
        let client = Client {
            servers: servers.into(),
            args: Arc::new(args),
            record: Arc::default(),
            stop: CancellationToken::new(),
        };
        let mut tasks = JoinSet::new();
        tasks.spawn(orders::run(client.clone()));
        tasks.spawn(rollout::run(client.clone(), database));
        tasks.spawn(pusher::run(client.clone()));
        tasks.spawn(questions::run(client.clone()));
        for reader in 0..streams::READERS {
            tasks.spawn(streams::run(client.clone(), reader));
        }
        Self { client, tasks }
    }

    /// Ends the load, and waits for requests under way.
    pub async fn end(mut self) -> anyhow::Result<Record> {
        self.client.stop.cancel();
        let ending = async {
            while let Some(ended) = self.tasks.join_next().await {
                if let Err(error) = ended.context("a part of the load")? {
                    self.client.fail(&error);
                }
            }
            anyhow::Ok(())
        };
        let ended = tokio::time::timeout(END_TIMEOUT, ending).await;
        if let Ok(ended) = ended {
            ended?;
        } else {
            let record = &mut self.client.record();
            record.failures.push(format!("a part of the load did not end within {END_TIMEOUT:?}"));
        }
        Ok(std::mem::take(&mut *self.client.record()))
    }
}

impl Client {
    fn record(&self) -> MutexGuard<'_, Record> {
        self.record.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn fail(&self, error: &anyhow::Error) {
        self.record().failures.push(format!("{error:#}"));
    }

    /// Random numbers of one part of the load.
    fn random(&self, part: u64) -> SmallRng {
        SmallRng::seed_from_u64(self.args.seed.wrapping_mul(31).wrapping_add(part))
    }

    /// Asks the server `first`, and those after it while none answers. Returns the answer and the
    /// server that gave it.
    async fn ask_until_answered<T, Asking>(
        &self,
        first: usize,
        ask: impl Fn(Arc<Server>) -> Asking,
    ) -> anyhow::Result<(usize, T)>
    where
        Asking: Future<Output = Result<T, ServerError>>,
    {
        let deadline = Instant::now() + REQUEST_TIMEOUT;
        let mut last = anyhow::anyhow!("no server");
        for number in (0..self.servers.len()).cycle().skip(first % self.servers.len()) {
            match tokio::time::timeout(TRY_TIMEOUT, ask(self.servers[number].clone())).await {
                Ok(Ok(answer)) => return Ok((number, answer)),
                Ok(Err(error @ ServerError::Refused(_, status, _)))
                    if status.is_client_error() && status.as_u16() != 429 =>
                {
                    return Err(error.into());
                }
                Ok(Err(error)) => last = error.into(),
                Err(_) => last = anyhow::anyhow!("no answer within {TRY_TIMEOUT:?}"),
            }
            if Instant::now() > deadline {
                return Err(last.context("no server has answered"));
            }
            tokio::time::sleep(AGAIN).await;
        }
        Err(last)
    }

    /// Pushes a package, at `first` or another server.
    async fn push(
        &self,
        first: usize,
        package: impl Fn() -> Package,
    ) -> anyhow::Result<task_proto::Digest> {
        let push = |server: Arc<Server>| {
            let package = package();
            async move { server.push(package).await }
        };
        Ok(self.ask_until_answered(first, push).await?.1)
    }

    /// Waits for the next tick; false once the load ends.
    async fn goes_on(&self, tick: &mut tokio::time::Interval) -> bool {
        tokio::select! {
            biased;
            () = self.stop.cancelled() => false,
            _ = tick.tick() => true,
        }
    }
}

/// Ticks that do not catch up after a delay.
fn ticks(every: Duration) -> tokio::time::Interval {
    let mut tick = tokio::time::interval(every);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    tick
}

fn name_and_version(name: &str, version: u64) -> anyhow::Result<(TaskName, Version)> {
    Ok((name.parse()?, format!("{version}").parse()?))
}
