//! One run: engines and robots start, the load begins, a fault comes and goes, the load ends, all
//! settles, and the database is compared with the robots' logs.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{Context as _, ensure};
use rand::rngs::SmallRng;
use rand::{RngExt as _, SeedableRng as _};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

use super::database::{Counters, Database, count_notifications};
use super::engines::{EngineArgs, Engines};
use super::faults::{Fault, Injected, inject};
use super::figures::{
    Resources, measure_latencies, measure_pause, measure_reconnects, measure_resources,
};
use super::invariants::{self, Stored};
use super::load::{Load, LoadArgs, Record};
use super::robot_logs::RobotLogs;
use super::sessions;
use crate::results::run::{Point, Unit};
use crate::simulated::fleet::Fleet;

/// The share of a run's time in which the fault begins, and for which it lasts.
const BEGINS: std::ops::Range<f64> = 0.25..0.4;
const LASTS: f64 = 0.3;
const LONGEST_FAULT: Duration = Duration::from_secs(60);
/// Time for all robots to connect, and for all to settle in the end.
const CONNECT_LIMIT: Duration = Duration::from_secs(300);
const SETTLE_LIMIT: Duration = Duration::from_secs(180);
const SETTLE_INTERVAL: Duration = Duration::from_millis(500);
/// Examples of a broken invariant that are named.
const EXAMPLES: usize = 3;

/// The sizes of a run.
#[derive(Debug, Clone)]
pub struct RunArgs<'a> {
    pub engines: EngineArgs<'a>,
    pub fault: Fault,
    pub load: LoadArgs,
    pub length: Duration,
}

/// The record of a run, for the comparison.
struct Evidence {
    record: Record,
    double: std::collections::BTreeSet<String>,
    fault: Injected,
    from: Resources,
    to: Resources,
}

/// Runs once; returns the point with figures and broken invariants, and the servers' version.
pub async fn run_once(args: &RunArgs<'_>) -> anyhow::Result<(Point, String)> {
    let settings = [("nodes", args.engines.nodes as f64), ("robots", args.load.robots as f64)];
    let mut point = Point::new(args.fault.label(), settings);
    let mut engines = Engines::start(&args.engines).await?;
    let mut database = Database::new(engines.database.clone());
    if args.engines.standby {
        database.wait_for_standby().await?;
    }
    let mut fleet = engines.fleet(args.load.robots).await?;
    let empty = Resources::now(&engines, Counters::default(), 0);
    let connected = fleet.start(CONNECT_LIMIT).await?;
    point.measure("connected", Unit::Milliseconds, connected.delays_ms());
    connected.failures.into_iter().for_each(|why| point.fail(why));
    let full = Resources::now(&engines, Counters::default(), 0);
    let grown = full.nodes_resident_bytes() - empty.nodes_resident_bytes();
    point.measure("resident_per_robot", Unit::Bytes, [grown / args.load.robots as f64]);

    let evidence = put_under_load(args, &mut engines, &mut database).await?;
    let settled = settle(&mut database, &fleet).await;
    settled.err().into_iter().for_each(|error| point.fail(format!("{error:#}")));
    // The logs first: each report that they have as acknowledged must be in the database.
    let logs = RobotLogs::read(fleet.logs())?;
    let times = evidence.fault.times;
    measure_latencies(&mut point, &logs, &evidence.record, times);
    measure_reconnects(&mut point, &logs, times);
    measure_pause(&mut point, &logs, times.began_ns, evidence.to.at_ns);
    measure_resources(&mut point, &logs, &evidence.from, &evidence.to);
    check(&mut point, &logs, &evidence, &engines, &mut database).await?;
    for node in &mut engines.nodes {
        node.ended().into_iter().for_each(|how| point.fail(how));
        (0..node.panics()).for_each(|_| point.fail("a server has panicked"));
    }
    let version = engines.version.clone();
    fleet.end().await?;
    engines.end().await?;
    Ok((point, version))
}

/// The load, and in its midst the fault.
async fn put_under_load(
    args: &RunArgs<'_>,
    engines: &mut Engines,
    database: &mut Database,
) -> anyhow::Result<Evidence> {
    let mut random = SmallRng::seed_from_u64(args.load.seed);
    let stop = CancellationToken::new();
    let names = engines.nodes.iter().map(|node| node.name.clone());
    let servers = names.zip(engines.servers.iter().cloned()).collect();
    let watching = sessions::watch(servers, args.load.robots, stop.clone());
    let watching = AbortOnDropHandle::new(tokio::spawn(watching));
    let notifications = Arc::new(AtomicU64::new(0));
    let counter = notifications.clone();
    let url = engines.database.first().context("no database")?.clone();
    let _counting = AbortOnDropHandle::new(tokio::spawn(async move {
        count_notifications(&url, &counter).await;
    }));
    let counted = || notifications.load(Ordering::Relaxed);
    let from = Resources::now(engines, database.counters().await?, counted());
    let own = Database::new(engines.database.clone());
    let load = Load::begin(&engines.servers, own, args.load.clone());

    let begun = Instant::now();
    tokio::time::sleep(args.length.mul_f64(random.random_range(BEGINS))).await;
    let hold = args.length.mul_f64(LASTS).min(LONGEST_FAULT);
    let fault = inject(args.fault, engines, database, hold, &mut random).await?;
    tokio::time::sleep_until(begun + args.length).await;

    let to = Resources::now(engines, database.counters().await?, counted());
    let record = load.end().await?;
    stop.cancel();
    let double = watching.await.context("the watch of sessions")?;
    Ok(Evidence { record, double, fault, from, to })
}

/// Waits until no robot is behind, no assignment is open, and all stored reports are acknowledged.
async fn settle(database: &mut Database, fleet: &Fleet) -> anyhow::Result<()> {
    let deadline = Instant::now() + SETTLE_LIMIT;
    let mut tick = tokio::time::interval(SETTLE_INTERVAL);
    loop {
        tick.tick().await;
        let open = database.unsettled().await?;
        if open == 0 {
            let logs = RobotLogs::read(fleet.logs())?;
            let robots = database.robots().await?;
            let is_current = |(robot, last): (&usize, &super::robot_logs::Acknowledged)| {
                let name = crate::simulated::fleet::name(*robot);
                robots.get(&name).is_some_and(|row| row.position == last.position)
            };
            let has_session = logs.gaps.iter().all(|gap| gap.until_ns.is_some());
            if has_session && logs.last.iter().all(is_current) {
                return Ok(());
            }
        }
        ensure!(
            Instant::now() < deadline,
            "{open} robots and assignments have not settled {SETTLE_LIMIT:?} after the load"
        );
    }
}

/// Compares, and adds a failure for each broken invariant, with some examples.
async fn check(
    point: &mut Point,
    logs: &RobotLogs,
    evidence: &Evidence,
    engines: &Engines,
    database: &mut Database,
) -> anyhow::Result<()> {
    let Evidence { record, double, .. } = evidence;
    let stored =
        Stored { robots: database.robots().await?, assignments: database.assignments().await? };
    let numbers = (database.deployment_numbers().await?, database.audit_numbers().await?);
    let mut audit = invariants::wrong_numbers(&numbers.0, &numbers.1);
    audit.extend(engines.verify_audit().await.err().map(|error| format!("{error:#}")));
    let packages = engines.packages();
    let size = |object: &str| std::fs::metadata(packages.join(object)).ok().map(|file| file.len());
    let (needed, blobs) = (database.needed_blobs().await?, database.blobs().await?);
    let feed = database.feed().await?;
    let doubled = double.iter().map(|robot| format!("{robot} kept sessions at two servers"));
    let robots = stored.robots.len();
    let mut lost = invariants::lost_reports(logs, &stored);
    if let Injected { times, promoted: Some(robots) } = &evidence.fault {
        lost.extend(invariants::lost_at_failover(logs, times.began_ns, robots));
    }
    let found = [
        ("I1", lost),
        ("I2", invariants::other_generations(logs, &stored, robots)),
        ("I3", invariants::repeated_runs(logs)),
        ("I4", invariants::exceeded_limits(&record.samples)),
        ("I5", audit),
        ("I6", doubled.collect()),
        ("I7", invariants::other_answers(&record.repeated)),
        ("I8", invariants::missing_objects(&needed, &blobs, size)),
        ("I9", invariants::repeated_feed(&feed, &record.feeds)),
    ];
    for (invariant, broken) in found {
        let more = broken.len().saturating_sub(EXAMPLES);
        for text in broken.into_iter().take(EXAMPLES) {
            point.fail(format!("{invariant}: {text}"));
        }
        if more > 0 {
            point.fail(format!("{invariant}: {more} more"));
        }
    }
    // A check of nothing proves nothing.
    let compared = [
        ("acknowledged_reports", logs.acknowledged as usize),
        ("orders_repeated", record.repeated.len()),
        ("rollout_samples", record.samples.len()),
        ("runs_started", logs.started.len()),
        ("objects_needed", needed.len()),
        ("feed_entries", feed.len()),
        ("feed_entries_heard", record.feeds.iter().map(Vec::len).sum()),
    ];
    for (quantity, count) in compared {
        point.measure(quantity, Unit::Number, [count as f64]);
        if count == 0 {
            point.fail(format!("{quantity}: there are none to check"));
        }
    }
    for why in &record.failures {
        point.fail(format!("load: {why}"));
    }
    Ok(())
}
