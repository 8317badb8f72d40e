//! Every two seconds, an order for a job to some random robots at a random server, and the same
//! order again at the next server.

use std::sync::Arc;
use std::time::Duration;

use rand::RngExt as _;
use rand::rngs::SmallRng;
use rand::seq::index::sample;
use task_proto::api::{CreateDeployment, DeliveryChoice};
use task_proto::packages::manifest::TaskKind;
use tokio::task::JoinSet;

use super::{Client, OrderRecord, TRY_TIMEOUT, name_and_version, ticks};
use crate::programs::package::Package;
use crate::programs::server::Server;
use crate::simulated::fleet::name;
use crate::system::clock::monotonic_ns;

const INTERVAL: Duration = Duration::from_secs(2);
const PAYLOAD_BYTES: u64 = 32;

pub(super) async fn run(client: Client) -> anyhow::Result<()> {
    let mut random = client.random(1);
    let mut tick = ticks(INTERVAL);
    let mut under_way = JoinSet::new();
    let mut version = 0;
    while client.goes_on(&mut tick).await {
        version += 1;
        // An order that takes long delays no other.
        under_way.spawn(order(client.clone(), version, choose(&mut random, &client)));
    }
    while let Some(ordered) = under_way.join_next().await {
        if let Err(error) = ordered? {
            client.fail(&error);
        }
    }
    Ok(())
}

/// The server and the robots of an order.
fn choose(random: &mut SmallRng, client: &Client) -> (usize, Vec<usize>) {
    let server = random.random_range(0..client.servers.len());
    let count = client.args.order_robots.min(client.args.robots);
    (server, sample(random, client.args.robots, count).into_vec())
}

async fn order(
    client: Client,
    version: u64,
    (first, robots): (usize, Vec<usize>),
) -> anyhow::Result<()> {
    let (task, number) = name_and_version("job", version)?;
    let seed = client.args.seed.wrapping_add(version);
    let package =
        || Package::of_kind(TaskKind::Job, task.clone(), number.clone(), PAYLOAD_BYTES, seed);
    let manifest = client.push(first, package).await?;
    let names: Vec<String> = robots.iter().copied().map(name).collect();
    let order = CreateDeployment {
        delivery: DeliveryChoice::PushPull,
        ..CreateDeployment::new(task.clone(), manifest, names.join(",").parse()?)
    };
    let key = format!("taskbench-{:x}-{version}", client.args.seed);
    let ordered_ns = monotonic_ns();
    let (order, key) = (&order, key.as_str());
    let place = |server: Arc<Server>| async move { server.order_with_key(order, key).await };
    let (answered, view) = client.ask_until_answered(first, place).await?;
    let deployment = view.id;
    client.record().orders.push(OrderRecord { deployment: deployment.clone(), ordered_ns, robots });
    let next = &client.servers[(answered + 1) % client.servers.len()];
    if let Ok(Ok(again)) = tokio::time::timeout(TRY_TIMEOUT, place(next.clone())).await {
        client.record().repeated.push((deployment, again.id));
    }
    Ok(())
}
