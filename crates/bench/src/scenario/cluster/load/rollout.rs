//! Rollouts of a package to the whole fleet in batches, one after the other, and samples of their
//! progress.

use std::sync::Arc;
use std::time::Duration;

use rand::RngExt as _;
use task_proto::api::{CreateDeployment, DeliveryChoice};
use tokio::time::Instant;

use super::{Client, name_and_version, ticks};
use crate::programs::package::Package;
use crate::programs::server::Server;
use crate::scenario::cluster::database::{Database, Progress};

/// Batches of a rollout to a large fleet, and to a small one.
const BATCHES: usize = 20;
const FEW_BATCHES: usize = 4;
/// Robots of a batch that are many: a smaller fleet has fewer batches, each of which takes seconds.
const LARGE_BATCH: usize = 100;
/// One in this many robots may fail.
const ROBOTS_PER_FAILURE: usize = 200;
const SAMPLE_INTERVAL: Duration = Duration::from_millis(200);
/// Time for a rollout to go on to its end when the load ends.
const END_TIMEOUT: Duration = Duration::from_secs(90);

/// The progress of a rollout at one moment, with its limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RolloutSample {
    pub progress: Progress,
    pub batch: u64,
    pub max_failures: u64,
}

/// The robots of a batch in a fleet of this size.
fn batch(robots: usize) -> u64 {
    robots.div_ceil(BATCHES).max(robots.div_ceil(FEW_BATCHES).min(LARGE_BATCH)) as u64
}

pub(super) async fn run(client: Client, mut database: Database) -> anyhow::Result<()> {
    let mut random = client.random(2);
    let batch = batch(client.args.robots);
    let max_failures = client.args.robots.div_ceil(ROBOTS_PER_FAILURE) as u64;
    let mut version = 0;
    while !client.stop.is_cancelled() {
        version += 1;
        let (task, number) = name_and_version("rollout", version)?;
        let seed = client.args.seed.wrapping_sub(version);
        let bytes = client.args.payload_bytes;
        let package = || Package::random(task.clone(), number.clone(), bytes, seed);
        let first = random.random_range(0..client.servers.len());
        let manifest = client.push(first, package).await?;
        let order = CreateDeployment {
            delivery: DeliveryChoice::PushPull,
            batch: Some(batch),
            max_failures: Some(max_failures),
            ..CreateDeployment::new(task.clone(), manifest, "*".parse()?)
        };
        let order = &order;
        let place = |server: Arc<Server>| async move { server.order(order).await };
        let rollout = client.ask_until_answered(first, place).await?.1.id;
        let mut tick = ticks(SAMPLE_INTERVAL);
        let mut deadline = None;
        loop {
            tick.tick().await;
            // A database that is away has no progress.
            let Ok(progress) = database.progress(&rollout).await else { continue };
            client.record().samples.push(RolloutSample { progress, batch, max_failures });
            if progress.waiting + progress.busy == 0 {
                break;
            }
            if client.stop.is_cancelled() {
                let deadline = *deadline.get_or_insert_with(|| Instant::now() + END_TIMEOUT);
                anyhow::ensure!(
                    Instant::now() < deadline,
                    "a rollout was not over {END_TIMEOUT:?} after the load ended"
                );
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_fleets_have_few_batches() {
        assert_eq!([10, 300, 1000, 10_000].map(batch), [3, 75, 100, 500]);
    }
}
