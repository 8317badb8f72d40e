//! The cost of a connected robot and of a report for a number of servers: reports at a fixed rate
//! over plain connections straight to the servers, and nothing else.

use std::net::SocketAddr;
use std::time::Duration;

use anyhow::Context as _;

use super::database::Database;
use super::engines::{EngineArgs, Engines};
use super::figures::Resources;
use crate::results::run::{Point, Unit};
use crate::scenario::reporters::{connect_to, report_at, stored_times};

/// Time for the servers to come to rest after the connections.
const REST: Duration = Duration::from_secs(3);

/// The sizes of a measurement.
#[derive(Debug, Clone)]
pub struct CostArgs<'a> {
    pub engines: EngineArgs<'a>,
    pub robots: usize,
    /// Reports per second, of all robots together.
    pub rate: u32,
    pub seconds: u64,
}

/// Connects the robots, lets them report, and divides.
pub async fn measure(args: &CostArgs<'_>) -> anyhow::Result<Point> {
    let settings = [("nodes", args.engines.nodes as f64), ("robots", args.robots as f64)];
    let mut point = Point::new("cost", settings);
    let engines = Engines::start(&args.engines).await?;
    let mut database = Database::new(engines.database.clone());
    let counters = database.counters().await?;
    let empty = Resources::now(&engines, counters, 0);
    let addresses: Vec<SocketAddr> = engines.nodes.iter().map(|node| node.mqtt).collect();
    let first = engines.servers.first().context("no servers")?;
    let mut robots = connect_to(first, &addresses, args.robots).await?;
    tokio::time::sleep(REST).await;
    let from = Resources::now(&engines, database.counters().await?, 0);
    let grown = from.nodes_resident_bytes() - empty.nodes_resident_bytes();
    point.measure("resident_per_robot", Unit::Bytes, [grown / args.robots as f64]);
    let (_, outcomes) = report_at(&mut robots, args.rate, args.seconds).await?;
    let to = Resources::now(&engines, database.counters().await?, 0);
    let stored = stored_times(outcomes, &mut point);
    let reports = stored.len() as f64;
    point.measure("stored", Unit::Milliseconds, stored);
    let (used, per) = (to.minus(&from), |value: f64| [value / reports]);
    point.measure("server_cpu_per_report", Unit::Milliseconds, per(used.servers_cpu_s * 1000.0));
    point.measure("postgres_cpu_per_report", Unit::Milliseconds, per(used.postgres_cpu_s * 1000.0));
    point.measure("wal_per_report", Unit::Bytes, per(used.wal_bytes));
    point.measure("rows_written_per_report", Unit::Number, per(used.rows_written));
    point.measure("commits_per_report", Unit::Number, per(used.commits));
    drop(robots);
    engines.end().await?;
    Ok(point)
}
