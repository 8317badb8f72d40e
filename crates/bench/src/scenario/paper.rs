//! `taskbench paper`: repeats the measurements of the paper, with every mechanism side by side.

mod grid;

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::Args;

use self::grid::{Cell, Extent, MAX_ROBOTS, Mechanism, plots, runs};
use super::run_once::{DeliveryArgs, Outcome, run_once};
use crate::programs::taskd::{Taskd, TaskdArgs, TaskdFlags};
use crate::results::axis::written;
use crate::results::run::{Point, Run, RunFlags, Unit};
use crate::simulated::fleet::Fleet;
use crate::system::link::{Link, LinkQuality};
use crate::system::progress::{RunProgress, print_line};

/// Poll interval when MQTT announces changes: the agent's own default.
const SLOW_POLL: Duration = Duration::from_secs(300);
/// Time limit for the robots to connect.
const START_LIMIT: Duration = Duration::from_secs(60);
/// Time limit of an order, independent of its size.
const ORDER_LIMIT: Duration = Duration::from_secs(20);
/// The rate that an unlimited machine reaches at least, bytes per second of all robots together.
const SLOW_MACHINE_BYTES_PER_S: u64 = 20_000_000;
/// Factor below which two durations count as about equal,
const TOLERANCE_RATIO: f64 = 1.1;
/// or difference in milliseconds.
const TOLERANCE_MS: f64 = 20.0;
/// How long unreferenced blobs stay on the server.
const BLOB_GRACE: &str = "40s";

#[derive(Debug, Args)]
pub struct PaperFlags {
    /// A small grid: does everything work?
    #[arg(long, conflicts_with = "full")]
    quick: bool,
    /// Every number of robots at every one of twelve sizes; takes hours
    #[arg(long)]
    full: bool,
    /// How often each point is measured [default: 5; 1 with --quick]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1000))]
    repetitions: Option<u16>,
    /// Only these mechanisms, by the beginning of their names as the results have them: poll,
    /// direct-push, …
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    only: Vec<String>,
    /// Only packages up to this many bytes
    #[arg(long, value_name = "BYTES")]
    max_payload: Option<u64>,
    /// Seconds between two polls where nothing is announced; robots vary it by half
    #[arg(long, value_name = "S", default_value_t = 1.0)]
    poll_s: f64,
    /// Put a link between server and robots: RATE or RATE,DELAY, each way. Needs root, ip and tc
    #[arg(long, value_name = "20mbit,30ms")]
    link: Option<LinkQuality>,
    #[command(flatten)]
    taskd: TaskdFlags,
    #[command(flatten)]
    run: RunFlags,
}

/// Settings of a server and its robots for a group of mechanisms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Setting {
    AsItComes,
    Qos(u8),
    OneMessage,
    FastPoll,
}

impl Setting {
    fn of(mechanism: Mechanism) -> Self {
        match mechanism {
            Mechanism::PushPull
            | Mechanism::Inline
            | Mechanism::Adaptive
            | Mechanism::DirectPush(1) => Self::AsItComes,
            Mechanism::DirectPush(qos) => Self::Qos(qos),
            Mechanism::OneMessage => Self::OneMessage,
            Mechanism::Poll => Self::FastPoll,
        }
    }
}

/// A server with robots.
struct Testbed {
    taskd: Taskd,
    fleet: Fleet,
}

/// Runs the experiment; returns the run, with all failures in it.
pub async fn run(flags: PaperFlags) -> anyhow::Result<Run> {
    let begun = Instant::now();
    let seed = flags.run.seed();
    let mut run = Run::begin("paper", seed).await;
    let cells = chosen(&flags, seed)?;
    let link = match flags.link {
        Some(quality) => Some(Link::make(quality).await?),
        None => None,
    };
    let mut testbeds = BTreeMap::new();
    for setting in cells.iter().map(|cell| Setting::of(cell.mechanism)).collect::<BTreeSet<_>>() {
        testbeds.insert(setting, Testbed::start(&flags, setting, link.as_ref()).await?);
    }
    let version =
        testbeds.values().next().map(|testbed| testbed.taskd.version.clone()).unwrap_or_default();
    run.versions.insert("taskd".to_owned(), version);
    run.plots = plots();
    run.notes = notes(&flags);

    let mut results: BTreeMap<Cell, Vec<Outcome>> = BTreeMap::new();
    let mut progress = RunProgress::new(cells.len());
    for (number, cell) in cells.iter().enumerate() {
        progress.set_message(&format!(
            "{}, {} B, {} robots",
            cell.mechanism, cell.payload_bytes, cell.robots
        ));
        let testbed = testbeds
            .get_mut(&Setting::of(cell.mechanism))
            .context("a testbed for each mechanism")?;
        let order = DeliveryArgs {
            choice: cell.mechanism.choice(),
            payload_bytes: cell.payload_bytes,
            robots: cell.robots,
            // 2⁵³ seeds times the runs of one: no two packages are the same.
            seed: seed.wrapping_mul(1 << 11).wrapping_add(number as u64),
            limit: limit(&flags, cell),
        };
        let outcome = match run_once(&testbed.taskd, &mut testbed.fleet, order).await {
            Ok(outcome) => outcome,
            // The failure belongs to this mechanism; the others are measured with a fresh server
            // and fresh robots.
            Err(error) => {
                let why = testbed.taskd.ended().unwrap_or_else(|| format!("{error:#}"));
                *testbed =
                    Testbed::start(&flags, Setting::of(cell.mechanism), link.as_ref()).await?;
                Outcome::failed(why, cell.robots)
            }
        };
        results.entry(*cell).or_default().push(outcome);
        progress.step();
    }
    run.notes.extend(decisions(&results));
    run.points = results.iter().map(|(cell, outcomes)| point(cell, outcomes)).collect();
    run.notes.extend(adaptive_note(&run.points));
    for (_, testbed) in testbeds {
        testbed.fleet.end().await?;
        testbed.taskd.end().await?;
    }
    for file in run.write(&flags.run.out, begun).context("the results can't be written")? {
        print_line(&format!("{}", file.display()));
    }
    Ok(run)
}

impl Testbed {
    async fn start(
        flags: &PaperFlags,
        setting: Setting,
        link: Option<&Link>,
    ) -> anyhow::Result<Self> {
        let mut order = TaskdArgs::default();
        let mut set =
            |name: &str, value: &str| order.settings.push((name.to_owned(), value.to_owned()));
        set("TASKD_BLOB_GRACE", BLOB_GRACE);
        match setting {
            Setting::AsItComes | Setting::FastPoll => {}
            Setting::Qos(qos) => set("TASKD_DELIVERY_QOS", &qos.to_string()),
            Setting::OneMessage => set("TASKD_DELIVERY_PART_BYTES", "250000000"),
        }
        if let Some(link) = link {
            set("TASKD_ALLOW_PLAINTEXT", "true");
            order.listen = link.server();
        }
        let taskd = Taskd::start(&flags.taskd, &order).await?;
        let poll = if setting == Setting::FastPoll {
            Duration::from_secs_f64(flags.poll_s)
        } else {
            SLOW_POLL
        };
        let mut fleet = Fleet::assemble(&taskd, MAX_ROBOTS, poll, link).await?;
        let started = fleet.start(START_LIMIT).await?;
        anyhow::ensure!(
            started.failures.is_empty(),
            "robots do not connect: {}",
            started.failures.join("; ")
        );
        Ok(Self { taskd, fleet })
    }
}

fn chosen(flags: &PaperFlags, seed: u64) -> anyhow::Result<Vec<Cell>> {
    anyhow::ensure!((0.1..=3600.0).contains(&flags.poll_s), "--poll-s: expected 0.1 to 3600");
    let (extent, usual) = match (flags.quick, flags.full) {
        (true, _) => (Extent::Quick, 1),
        (_, true) => (Extent::Full, 5),
        _ => (Extent::Normal, 5),
    };
    let mut cells = runs(extent, flags.repetitions.unwrap_or(usual).into(), seed);
    let is_wanted = |cell: &Cell| {
        let name = cell.mechanism.to_string();
        flags.only.is_empty() || flags.only.iter().any(|wanted| name.starts_with(wanted.as_str()))
    };
    cells.retain(|cell| {
        is_wanted(cell) && flags.max_payload.is_none_or(|most| cell.payload_bytes <= most)
    });
    let names =
        || Mechanism::ALL.map(|mechanism| format!("{:?}", mechanism.to_string())).join(", ");
    anyhow::ensure!(
        !cells.is_empty(),
        "--only, --max-payload: nothing is left to measure; mechanisms are {}",
        names()
    );
    Ok(cells)
}

/// Time limit of a run: twice the time needed on a slow machine or on the link.
fn limit(flags: &PaperFlags, cell: &Cell) -> Duration {
    let rate = flags.link.map_or(SLOW_MACHINE_BYTES_PER_S, |link| {
        (link.bits_per_s / 8).min(SLOW_MACHINE_BYTES_PER_S)
    });
    let bytes = cell.payload_bytes * cell.robots as u64;
    ORDER_LIMIT
        + Duration::from_secs_f64(3.0 * flags.poll_s + 2.0 * bytes as f64 / rate.max(1) as f64)
}

fn notes(flags: &PaperFlags) -> Vec<String> {
    let link = match flags.link {
        Some(link) => format!(
            "All robots share one link of {} kbit/s each way{}.",
            link.bits_per_s / 1000,
            link.delay_ms.map_or(String::new(), |ms| format!(" with {ms} ms of delay each way"))
        ),
        None => "Server and robots are on one machine, over loopback.".to_owned(),
    };
    vec![
        link,
        "The delay is from the operator's order to the moment when the last robot's report that it has verified and \
         unpacked the package is acknowledged, and so stored. Robots are the agent's own driver, link, fetch and \
         verification around a body that starts nothing; their disks are in memory, the server's is a disk. Each run has \
         bytes of its own that nothing can compress."
            .to_owned(),
        format!(
            "Robots that poll ask every {} s, varied by half; all others hear by MQTT. A cross is a point where \
             something failed; a thin line reaches to the 99th percentile.",
            flags.poll_s
        ),
        "The transmission load is counted at the server's sockets, both ways, MQTT and HTTP together, from the order to \
         the last answer; the order itself, about 2 to 4 KB, is in it."
            .to_owned(),
    ]
}

/// The choices of the adaptive mechanism, by size.
fn decisions(results: &BTreeMap<Cell, Vec<Outcome>>) -> Option<String> {
    let mut chosen: BTreeMap<u64, BTreeSet<&str>> = BTreeMap::new();
    for (cell, outcomes) in results.iter().filter(|(cell, _)| cell.mechanism == Mechanism::Adaptive)
    {
        let all = outcomes.iter().flat_map(|outcome| outcome.decisions.iter().map(String::as_str));
        chosen.entry(cell.payload_bytes).or_default().extend(all);
    }
    let describe = |(bytes, decisions): (u64, BTreeSet<&str>)| {
        let size = written(bytes as f64, Unit::Bytes);
        format!("{size} by {}", decisions.into_iter().collect::<Vec<_>>().join(" or "))
    };
    let described: Vec<String> = chosen.into_iter().map(describe).collect();
    (!described.is_empty())
        .then(|| format!("Adaptive, with the rule that decided: {}.", described.join("; ")))
}

/// The number of cells in which adaptive is about as fast as the fastest of the others.
fn adaptive_note(points: &[Point]) -> Option<String> {
    let adaptive = Mechanism::Adaptive.to_string();
    let delay = |point: &Point| point.quantities.get("delay").map(|delay| delay.median);
    let mut places = 0;
    let mut good = 0;
    for own in points.iter().filter(|point| point.series == adaptive) {
        let others = points
            .iter()
            .filter(|other| other.series != adaptive && other.settings == own.settings);
        let Some(best) = others.filter_map(delay).min_by(f64::total_cmp) else { continue };
        places += 1;
        good += usize::from(
            delay(own).is_some_and(|own| own <= (best * TOLERANCE_RATIO).max(best + TOLERANCE_MS)),
        );
    }
    (places > 0).then(|| {
        format!(
            "Adaptive is within 10 % or 20 ms of the fastest mechanism at {good} of {places} points, medians compared."
        )
    })
}

fn point(cell: &Cell, outcomes: &[Outcome]) -> Point {
    let settings = [("payload_bytes", cell.payload_bytes as f64), ("robots", cell.robots as f64)];
    let mut point = Point::new(&cell.mechanism.to_string(), settings);
    for failure in outcomes.iter().flat_map(|outcome| &outcome.arrivals.failures) {
        point.fail(failure);
    }
    let arrival =
        |outcome: &Outcome| 100.0 * outcome.arrivals.arrived.len() as f64 / cell.robots as f64;
    point.measure("arrival", Unit::Percent, outcomes.iter().map(arrival));
    // A run that lost a robot has no last answer.
    let whole: Vec<&Outcome> =
        outcomes.iter().filter(|outcome| outcome.arrivals.arrived.len() == cell.robots).collect();
    point.measure(
        "delay",
        Unit::Milliseconds,
        whole.iter().filter_map(|outcome| outcome.arrivals.last_ms()),
    );
    let each = outcomes.iter().flat_map(|outcome| outcome.arrivals.delays_ms());
    point.measure("robot_delay", Unit::Milliseconds, each);
    let load = |outcome: &Outcome| (outcome.mqtt_bytes + outcome.http_bytes) as f64;
    point.measure("load", Unit::Bytes, whole.iter().map(|outcome| load(outcome)));
    point.measure("load_mqtt", Unit::Bytes, whole.iter().map(|outcome| outcome.mqtt_bytes as f64));
    point.measure("load_http", Unit::Bytes, whole.iter().map(|outcome| outcome.http_bytes as f64));
    let needed = (cell.payload_bytes * cell.robots as u64) as f64;
    point.measure("load_ratio", Unit::Number, whole.iter().map(|outcome| load(outcome) / needed));
    point.measure(
        "fell_behind",
        Unit::Number,
        outcomes.iter().map(|outcome| outcome.fell_behind as f64),
    );
    point
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn adaptive_is_compared_with_the_fastest_at_the_same_place() {
        let point = |mechanism: Mechanism, robots: f64, delay: f64| {
            let mut point = Point::new(&mechanism.to_string(), [("robots", robots)]);
            point.measure("delay", Unit::Milliseconds, [delay]);
            point
        };
        let adaptive = Mechanism::Adaptive;
        let pull = Mechanism::PushPull;
        let poll = Mechanism::Poll;
        let mut points = vec![
            point(adaptive, 1.0, 119.0),
            point(pull, 1.0, 100.0),
            point(poll, 1.0, 900.0),
            point(adaptive, 2.0, 1099.0),
            point(pull, 2.0, 1000.0),
            point(adaptive, 3.0, 1200.0),
            point(poll, 3.0, 1000.0),
            // No other point to compare with.
            point(adaptive, 4.0, 1.0),
        ];
        let described = adaptive_note(&points).expect("described");
        assert!(described.contains("at 2 of 3 points"), "{described}");
        points.retain(|point| point.series != adaptive.to_string());
        assert_eq!(adaptive_note(&points), None);
    }
}
