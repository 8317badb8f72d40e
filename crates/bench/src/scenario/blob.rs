//! `taskbench blob`: the speed and the cost of downloads of blobs, compared with nginx with the
//! same files in the same run. Every connection belongs to a different robot, with its own token
//! and the right to just these blobs.

mod cold;

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context as _, ensure};
use clap::Args;
use rustls::ClientConfig;
use task_proto::CaPin;
use task_proto::api::{CreateDeployment, DeliveryChoice, EnrollResponse};
use task_proto::desired::BlobRef;

use crate::measure::downloads::{Downloads, Target, Until, download};
use crate::programs::encryption::{Certificate, ENCRYPTION_NOTE, client_config};
use crate::programs::enrollment::enroll_robots;
use crate::programs::package::Package;
use crate::programs::peer::Peer;
use crate::programs::server::Server;
use crate::programs::taskd::{Taskd, TaskdArgs, TaskdFlags};
use crate::results::run::{Plot, Point, Run, RunFlags, Unit};
use crate::system::machine::allow_files;
use crate::system::process::Usage;
use crate::system::progress::{RunProgress, print_line};

/// The ratios of one program's figures to the other's.
const RATIO: &str = "taskd / nginx";
/// Duration of each measurement of the small blob.
const SMALL_TIME: Duration = Duration::from_secs(4);
/// Bytes of the small blob.
const SMALL_BYTES: u64 = 10_000;
/// Bytes in all that each measurement of the large blob moves at least.
const MIN_BYTES: u64 = 3_200_000_000;

#[derive(Debug, Args)]
pub struct BlobFlags {
    /// How often everything is measured, in turns with nginx
    #[arg(long, value_name = "N", default_value_t = 7, value_parser = clap::value_parser!(u32).range(1..=100))]
    runs: u32,
    /// Size of the large blob in megabytes
    #[arg(long, value_name = "MB", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=2000))]
    megabytes: u64,
    /// How many fetch the large blob at a time; may be given more than once
    #[arg(long, value_name = "N", default_values_t = [8, 64], value_parser = clap::value_parser!(u16).range(1..=1000))]
    clients: Vec<u16>,
    /// How many fetch the small blob at a time; 0: nobody
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u16).range(..=8000))]
    small_clients: u16,
    /// How many different large blobs are pulled from disk while the API is probed; 0: none
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u16).range(..=200))]
    cold: u16,
    /// Whether both encrypt: taskd with rustls, nginx with OpenSSL, both with ECDSA keys
    #[arg(long)]
    tls: bool,
    #[command(flatten)]
    taskd: TaskdFlags,
    #[command(flatten)]
    run: RunFlags,
}

/// One blob to fetch by a number of robots.
struct Case<'a> {
    blob: BlobRef,
    clients: usize,
    until: Until,
    robots: &'a [EnrollResponse],
}

pub async fn run(flags: BlobFlags) -> anyhow::Result<Run> {
    let began = Instant::now();
    let seed = flags.run.seed();
    let mut run = Run::begin("blob", seed).await;
    let most =
        flags.clients.iter().copied().chain([flags.small_clients, flags.cold]).max().unwrap_or(0);
    allow_files(u64::from(most) + 200)?;
    let order = if flags.tls { TaskdArgs::default().encrypted() } else { TaskdArgs::default() };
    let taskd = Taskd::start(&flags.taskd, &order).await?;
    run.versions.insert("taskd".to_owned(), taskd.version.clone());
    run.notes.extend(flags.tls.then(|| ENCRYPTION_NOTE.to_owned()));
    let certificate = flags.tls.then(Certificate::new).transpose()?;
    let nginx = Peer::nginx(taskd.dir(), &taskd.blobs(), certificate.as_ref()).await?;
    match &nginx {
        Some(nginx) => drop(run.versions.insert("nginx".to_owned(), nginx.version.clone())),
        None => {
            print_line("nginx is not installed: taskd is measured alone");
            run.notes.push("nginx was not installed, so there are no ratios.".to_owned());
        }
    }
    print_line("enrolling robots and pushing packages");
    let robots = enroll_robots(&taskd.server, usize::from(most.max(1))).await?;
    let large = order_blob(&taskd.server, "large", "*", flags.megabytes * 1_000_000, seed).await?;
    let small = order_blob(&taskd.server, "small", "*", SMALL_BYTES, seed + 1).await?;
    let mut cases: Vec<Case<'_>> =
        flags.clients.iter().map(|&clients| large_case(large, clients.into(), &robots)).collect();
    if flags.small_clients > 0 {
        let clients = flags.small_clients.into();
        cases.push(Case {
            blob: small,
            clients,
            until: Until::Elapsed(SMALL_TIME),
            robots: &robots,
        });
    }
    measure_cases(&mut run, &flags, &taskd, nginx.as_ref(), &cases).await?;
    if flags.cold > 0 {
        let runs = flags.runs;
        let pulls = flags.cold.into();
        let plan = cold::Plan { runs, pulls, size: flags.megabytes * 1_000_000, seed };
        cold::measure(&mut run, &plan, taskd, nginx.as_ref(), &robots).await?;
    } else {
        taskd.end().await?;
    }
    if let Some(nginx) = nginx {
        nginx.end().await;
    }
    run.plots = plots(flags.megabytes);
    for path in run.write(&flags.run.out, began)? {
        print_line(&format!("wrote {}", path.display()));
    }
    Ok(run)
}

fn large_case(blob: BlobRef, clients: usize, robots: &[EnrollResponse]) -> Case<'_> {
    let fetches = MIN_BYTES.div_ceil(blob.size * clients as u64);
    Case { blob, clients, until: Until::Fetches(fetches), robots }
}

/// Pushes a package of `size` random bytes and orders the package for the robots that match
/// `selector`; returns its blob.
async fn order_blob(
    server: &Server,
    name: &str,
    selector: &str,
    size: u64,
    seed: u64,
) -> anyhow::Result<BlobRef> {
    let package = Package::random(name.parse()?, "1".parse()?, size, seed);
    let name = package.name.clone();
    let content = package.content_blob();
    let manifest = server.push(package).await?;
    let order = CreateDeployment {
        delivery: DeliveryChoice::Poll,
        ..CreateDeployment::new(name, manifest, selector.parse()?)
    };
    server.order(&order).await?;
    Ok(content)
}

/// Targets for each robot's download of the blob from taskd.
fn at_taskd(taskd: &Taskd, blob: BlobRef, robots: &[EnrollResponse]) -> Vec<Target> {
    let tls = tls(taskd.pin);
    let target = |robot: &EnrollResponse| Target {
        address: taskd.http,
        tls: tls.clone(),
        path: format!("/v2/bench/blobs/{}", blob.digest),
        token: Some(robot.token.clone()),
        size: blob.size,
    };
    robots.iter().map(target).collect()
}

/// Targets for the same number of downloads from nginx.
fn at_nginx(nginx: &Peer, blob: BlobRef, count: usize) -> Vec<Target> {
    let path = format!("/{}", blob.digest.hex());
    vec![
        Target { address: nginx.address, tls: tls(nginx.pin), path, token: None, size: blob.size };
        count
    ]
}

fn tls(pin: Option<CaPin>) -> Option<Arc<ClientConfig>> {
    pin.map(|pin| Arc::new(client_config(Some(pin))))
}

async fn measure_cases(
    run: &mut Run,
    flags: &BlobFlags,
    taskd: &Taskd,
    nginx: Option<&Peer>,
    cases: &[Case<'_>],
) -> anyhow::Result<()> {
    let mut progress = RunProgress::new(cases.len() * (flags.runs as usize + 1));
    for case in cases {
        let own = at_taskd(taskd, case.blob, &case.robots[..case.clients]);
        let others = nginx.map(|nginx| at_nginx(nginx, case.blob, case.clients));
        // The first time tokens are used for the first time and files are read.
        download(&own, Until::Fetches(1), || ()).await.context("taskd")?;
        if let Some(others) = &others {
            download(others, Until::Fetches(1), || ()).await.context("nginx")?;
        }
        progress.step();
        let mut figures = [Figures::default(), Figures::default()];
        for turn in 0..flags.runs {
            progress.set_message(&format!("{} bytes to {} clients", case.blob.size, case.clients));
            // The order alternates, so that neither server always finds the machine as the other
            // left it.
            for side in if turn % 2 == 0 { [0, 1] } else { [1, 0] } {
                match (side, nginx, &others) {
                    (0, ..) => {
                        figures[0].add(&own, case.until, || taskd.usage()).await.context("taskd")?
                    }
                    (_, Some(nginx), Some(others)) => {
                        figures[1]
                            .add(others, case.until, || nginx.usage())
                            .await
                            .context("nginx")?;
                    }
                    _ => {}
                }
            }
            progress.step();
        }
        let settings =
            || [("payload_bytes", case.blob.size as f64), ("clients", case.clients as f64)];
        let [own, others] = figures;
        if nginx.is_some() {
            run.points.push(own.ratio(&others, Point::new(RATIO, settings())));
            run.points.push(others.point(Point::new("nginx", settings())));
        }
        run.points.push(own.point(Point::new("taskd", settings())));
    }
    Ok(())
}

/// Measurements of one server, run by run.
#[derive(Default)]
struct Figures {
    cpu_s_per_gb: Vec<f64>,
    bytes_per_s: Vec<f64>,
    requests_per_s: Vec<f64>,
}

impl Figures {
    async fn add(
        &mut self,
        targets: &[Target],
        until: Until,
        usage: impl Fn() -> Usage,
    ) -> anyhow::Result<()> {
        let mut before = Usage::default();
        let Downloads { fetches, bytes, wall } =
            download(targets, until, || before = usage()).await?;
        let cpu_s = usage().cpu_s - before.cpu_s;
        ensure!(bytes > 0 && cpu_s > 0.0, "too little was fetched to be measured");
        self.cpu_s_per_gb.push(cpu_s / (bytes as f64 / 1e9));
        self.bytes_per_s.push(bytes as f64 / wall.as_secs_f64());
        self.requests_per_s.push(fetches as f64 / wall.as_secs_f64());
        Ok(())
    }

    fn point(self, mut point: Point) -> Point {
        point.measure("server_cpu", Unit::SecondsPerGigabyte, self.cpu_s_per_gb);
        point.measure("throughput", Unit::BytesPerSecond, self.bytes_per_s);
        point.measure("requests", Unit::PerSecond, self.requests_per_s);
        point
    }

    fn ratio(&self, other: &Self, mut point: Point) -> Point {
        let of = |own: &[f64], others: &[f64]| {
            own.iter().zip(others).map(|(own, other)| own / other).collect::<Vec<_>>()
        };
        point.measure("server_cpu", Unit::Number, of(&self.cpu_s_per_gb, &other.cpu_s_per_gb));
        point.measure("throughput", Unit::Number, of(&self.bytes_per_s, &other.bytes_per_s));
        point.measure("requests", Unit::Number, of(&self.requests_per_s, &other.requests_per_s));
        point
    }
}

fn plots(megabytes: u64) -> Vec<Plot> {
    let size = (megabytes * 1_000_000) as f64;
    let plot = |title: &str, y: &str, y_label: &str| Plot {
        title: format!("{title}, a blob of {megabytes} MB"),
        x: "clients".to_owned(),
        x_label: "clients".to_owned(),
        y: y.to_owned(),
        y_label: y_label.to_owned(),
        only: [("payload_bytes".to_owned(), (size, size * 1.1))].into(),
        series: ["taskd", "nginx"].map(str::to_owned).to_vec(),
        ..Plot::default()
    };
    vec![
        plot("Server's processor time", "server_cpu", "seconds for each GB"),
        plot("Throughput", "throughput", "bytes per second"),
    ]
}
