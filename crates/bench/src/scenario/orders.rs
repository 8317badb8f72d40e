//! `taskbench orders`: orders to a whole fleet of which most robots are rows of the database,
//! without sessions. A few robots are connected and report at a fixed rate all the time; how long
//! their reports take to be stored shows how long an order stops reports. A report is measured from
//! its due time. Nothing is built, fetched or started.

use std::time::{Duration, Instant};

use anyhow::{Context as _, bail, ensure};
use clap::Args;
use task_proto::api::{CreateDeployment, DeliveryChoice, DeploymentState, DeploymentView};
use task_proto::ids::selector::Selector;

use super::reporters::{Reporter, connect, report_at, stored_times};
use crate::programs::database::{add_robots, sqlite_url};
use crate::programs::taskd::{Taskd, TaskdArgs, TaskdFlags};
use crate::results::run::{Point, Run, RunFlags, Unit};
use crate::system::machine::allow_files;
use crate::system::progress::{RunProgress, print_line};

/// From the first report until the order.
const LEAD: Duration = Duration::from_secs(2);
/// Pause between two questions how far the order has got.
const PAUSE: Duration = Duration::from_millis(100);
/// Seconds of reports that the server has stored before robots are added.
const WARM_UP_S: u64 = 1;

#[derive(Debug, Args)]
pub struct OrdersFlags {
    /// How many robots there are as rows of the database
    #[arg(long, value_name = "N", default_value_t = 100_000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    robots: u32,
    /// How many robots are connected and report
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u16).range(1..=5_000))]
    reporters: u16,
    /// Reports per second, of all robots together
    #[arg(long, value_name = "R", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    rate: u32,
    /// How long robots report around each order; the order has to be carried out by then
    #[arg(long, value_name = "S", default_value_t = 60, value_parser = clap::value_parser!(u64).range(5..=600))]
    seconds: u64,
    /// An empty Postgres database, which is measured as well [default: SQLite alone]
    #[arg(long, value_name = "URL")]
    postgres: Option<String>,
    #[command(flatten)]
    taskd: TaskdFlags,
    #[command(flatten)]
    run: RunFlags,
}

/// An order to the robots.
enum Ordered {
    /// A new package. It is cancelled as soon as this part of the robots have their assignments.
    Package { selector: &'static str, cancelled_at: Option<f64> },
    /// Something else, by this path and with this body, in JSON.
    Other { path: &'static str, body: &'static str },
}

const PACKAGE: Ordered = Ordered::Package { selector: "*", cancelled_at: None };

/// The orders with their series. The first one finds robots without any task; the later ones
/// replace it.
const ORDERS: [(&str, Ordered); 8] = [
    ("first order to all", PACKAGE),
    ("next order to all", PACKAGE),
    ("order to a label", Ordered::Package { selector: "site=s3", cancelled_at: None }),
    ("cancel at a tenth", Ordered::Package { selector: "*", cancelled_at: Some(0.1) }),
    ("cancel of all", Ordered::Package { selector: "*", cancelled_at: Some(1.0) }),
    (
        "stop of all",
        Ordered::Other { path: "/api/v1/tasks/fleet/stop", body: r#"{"selector":"*"}"# },
    ),
    (
        "label of all",
        Ordered::Other {
            path: "/api/v1/bulk/labels",
            body: r#"{"selector":"*","set":{"base":"x"},"remove":[]}"#,
        },
    ),
    (
        "removal of a tenth",
        Ordered::Other { path: "/api/v1/bulk/remove", body: r#"{"selector":"site=s3"}"# },
    ),
];

pub async fn run(flags: OrdersFlags) -> anyhow::Result<Run> {
    let began = Instant::now();
    let mut run = Run::begin("orders", flags.run.seed()).await;
    allow_files(u64::from(flags.reporters) + 200)?;
    let mut databases = vec![("SQLite", None)];
    match &flags.postgres {
        Some(url) => databases.push(("Postgres", Some(url.clone()))),
        None => print_line("no --postgres: SQLite is measured alone"),
    }
    let mut progress = RunProgress::new(databases.len() * (ORDERS.len() + 1));
    for (name, url) in databases {
        let mut start = TaskdArgs::default();
        start.settings.extend(url.iter().map(|url| ("TASKD_DATABASE".to_owned(), url.clone())));
        let taskd = Taskd::start(&flags.taskd, &start).await?;
        run.versions.insert("taskd".to_owned(), taskd.version.clone());
        progress.set_message(&format!("{name}: making {} robots", flags.robots));
        let mut reporters = connect(&taskd, flags.reporters.into()).await.context(name)?;
        report_at(&mut reporters, flags.reporters.into(), WARM_UP_S).await?;
        let url = url.unwrap_or_else(|| sqlite_url(&taskd.dir().join("data/taskd.sqlite")));
        add_robots(&url, flags.robots).await.context(name)?;
        progress.set_message(&format!("{name}: reports alone"));
        let settings =
            [("robots", f64::from(flags.robots)), ("reports_per_s", f64::from(flags.rate))];
        let mut point = Point::new(&format!("{name}, no order"), settings);
        let outcomes = report_at(&mut reporters, flags.rate, flags.seconds.min(20)).await?.1;
        record_reports(&mut point, outcomes);
        run.points.push(point);
        progress.step();
        for (number, (series, order)) in ORDERS.iter().enumerate() {
            progress.set_message(&format!("{name}: {series}"));
            let mut point = Point::new(&format!("{name}, {series}"), settings);
            measure(&taskd, &mut reporters, &flags, number, order, &mut point)
                .await
                .context(name)?;
            run.points.push(point);
            progress.step();
        }
        drop(reporters);
        taskd.end().await?;
    }
    for path in run.write(&flags.run.out, began)? {
        print_line(&format!("wrote {}", path.display()));
    }
    Ok(run)
}

/// Gives one order while the robots report.
async fn measure(
    taskd: &Taskd,
    reporters: &mut [Reporter],
    flags: &OrdersFlags,
    number: usize,
    order: &Ordered,
    point: &mut Point,
) -> anyhow::Result<()> {
    let before = taskd.usage();
    let ordering = async {
        tokio::time::sleep(LEAD).await;
        let limit = Duration::from_secs(flags.seconds);
        match tokio::time::timeout(limit, carry_out(taskd, number, order)).await {
            Ok(done) => done,
            Err(_) => bail!("the order was not carried out within {limit:?}"),
        }
    };
    let reporting = report_at(reporters, flags.rate, flags.seconds);
    let (done, reported) = tokio::join!(ordering, reporting);
    record_reports(point, reported?.1);
    let cpu_s = taskd.usage().cpu_s - before.cpu_s;
    point.measure("server_cpu", Unit::Seconds, [cpu_s]);
    match done {
        Ok(Done { answered_s, done_s, cancelled_s, robots }) => {
            point.measure("answered_after", Unit::Seconds, [answered_s]);
            point.measure("done_after", Unit::Seconds, [done_s]);
            point.measure("cancel_answered_after", Unit::Seconds, cancelled_s);
            point.measure("assignments", Unit::Number, robots.map(|robots| robots as f64));
        }
        Err(error) => point.fail(format!("{error:#}")),
    }
    Ok(())
}

/// How an order went.
struct Done {
    /// From the order until its answer.
    answered_s: f64,
    /// From the order until it was carried out for all robots.
    done_s: f64,
    /// From the cancel until its answer.
    cancelled_s: Option<f64>,
    /// Robots that got an assignment.
    robots: Option<u64>,
}

async fn carry_out(taskd: &Taskd, number: usize, order: &Ordered) -> anyhow::Result<Done> {
    let (selector, cancelled_at) = match order {
        Ordered::Package { selector, cancelled_at } => (selector, *cancelled_at),
        Ordered::Other { path, body } => {
            let began = Instant::now();
            taskd.server.order_at("the order", path, &serde_json::from_str(body)?).await?;
            let answered_s = began.elapsed().as_secs_f64();
            return Ok(Done { answered_s, done_s: answered_s, cancelled_s: None, robots: None });
        }
    };
    let selector: Selector = selector.parse()?;
    let name = "fleet".parse()?;
    let manifest = taskd.server.push_package(&name, &format!("{number}").parse()?).await?;
    let create = CreateDeployment {
        delivery: DeliveryChoice::Poll,
        ..CreateDeployment::new(name, manifest, selector)
    };
    let began = Instant::now();
    let id = taskd.server.order(&create).await?.id;
    let answered_s = began.elapsed().as_secs_f64();
    let mut cancelled_s = None;
    loop {
        let newest = taskd.server.newest_deployment().await?;
        ensure!(newest.id == id, "another deployment is the newest");
        if cancelled_at.is_some_and(|part| part_placed(&newest) >= part) && cancelled_s.is_none() {
            let began = Instant::now();
            taskd.server.cancel(&id).await?;
            cancelled_s = Some(began.elapsed().as_secs_f64());
            continue;
        }
        let open = newest.counts.iter().filter(|count| !count.phase.is_final());
        let is_over = match newest.state {
            DeploymentState::Cancelled => open.count() == 0,
            _ => newest.placing.is_none(),
        };
        if is_over {
            let done_s = began.elapsed().as_secs_f64();
            let robots = Some(newest.counts.iter().map(|count| count.count).sum());
            return Ok(Done { answered_s, done_s, cancelled_s, robots });
        }
        tokio::time::sleep(PAUSE).await;
    }
}

/// The part of its robots that an order is placed for.
fn part_placed(view: &DeploymentView) -> f64 {
    view.placing.map_or(1.0, |placing| placing.placed as f64 / placing.selected as f64)
}

fn record_reports(point: &mut Point, outcomes: Vec<anyhow::Result<Vec<f64>>>) {
    let stored = stored_times(outcomes, point);
    let longest = stored.iter().copied().fold(0.0, f64::max);
    point.measure("longest_stop_of_reports", Unit::Milliseconds, [longest]);
    point.measure("stored_after", Unit::Milliseconds, stored);
}
