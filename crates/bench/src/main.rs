//! The `taskbench` binary: parses the command line, runs a scenario until its end or an
//! interruption, and always cleans up. The binary itself measures nothing.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context as _;
use clap::{Parser, Subcommand};
use taskbench::results::compare::{CompareFlags, compare};
use taskbench::results::report;
use taskbench::results::run::Run;
use taskbench::scenario::blob::{self, BlobFlags};
use taskbench::scenario::broker::{self, BrokerFlags};
use taskbench::scenario::cluster::{self, ClusterFlags};
use taskbench::scenario::fleet::{self, FleetFlags};
use taskbench::scenario::load::{Load, LoadFlags};
use taskbench::scenario::orders::{self, OrdersFlags};
use taskbench::scenario::page::{self, PageFlags};
use taskbench::scenario::paper::{self, PaperFlags};
use taskbench::scenario::pull::{self, PullFlags};
use taskbench::scenario::status::{self, StatusFlags};
use taskbench::system::progress::print_line;
use tokio::signal::unix::{SignalKind, signal};

/// Measures taskd
///
/// Each scenario starts the real server as a child process, with a directory and ports of its own,
/// and ends it afterwards. Results go to --out as JSON (everything: commit, machine, seed,
/// versions, points), CSV (a row for each quantity) and one HTML file with plots that needs no
/// network. Build the programs with `cargo build --release --bins`.
#[derive(Parser)]
#[command(name = "taskbench", version, propagate_version = true)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Enroll simulated robots, connect them over MQTT, deploy to them, and measure each step
    ///
    /// The robots are one machine's TCP connections with the MQTT client of an independent
    /// implementation. They verify and report orders like a real agent, but fetch
    /// and run nothing. In the end they are removed, and so is the package that was ordered; the
    /// deployment stays in the server's history. The exit code is 0 if nothing failed. Ctrl-C stops
    /// the run and cleans up; a second one ends it at once.
    #[command(after_help = "Example:\n  taskbench load --server http://localhost:8080 \
                            --token-file ~/.local/share/taskd/operator.token --robots 1000")]
    Load(LoadFlags),

    /// The paper's measurements made again: payload and robots against delay, every mechanism side
    /// by side
    ///
    /// For each point: the delay from the operator's order to the server's receipt of the last
    /// robot's verified answer, the message arrival rate, and the bytes at the server's sockets.
    /// Runs are shuffled, failures shown. The exit code is 0 if nothing failed.
    #[command(
        after_help = "Examples:\n  taskbench paper                              the whole grid, under half an hour\n  \
                            taskbench paper --quick                      does everything work?\n  \
                            taskbench paper --link 20mbit --max-payload 2000000   as over bad Wi-Fi (root)\n  \
                            taskbench paper --only push-pull,poll --repetitions 9 --seed 7"
    )]
    Paper(PaperFlags),

    /// The load of a fleet on one server: all robots connect at once, then one deployment goes to
    /// all
    ///
    /// Robots are the agent's own driver, link, fetch and verification, all in one process; they
    /// build and start nothing. The exit code is 0 if nothing failed.
    #[command(after_help = "Examples:\n  taskbench fleet --robots 10,100,1000,10000\n  \
                            taskbench fleet --robots 500 --delivery direct-push --payload 1000000")]
    Fleet(FleetFlags),

    /// Several servers on one Postgres, under load and faults, and whether anything is lost
    ///
    /// Starts Postgres, the servers, HAProxy where it is installed, and robots that log every
    /// acknowledged report. After each run the database is compared with the logs. The exit code is
    /// 0 if no invariant was broken and nothing else failed. Needs PostgreSQL; as root or where
    /// user namespaces are allowed.
    #[command(after_help = "Examples:\n  taskbench cluster --robots 300 --faults F0,F1,F9\n  \
                      taskbench cluster --robots 10000 --seconds 120 --repetitions 5 --cost \\\n    \
                      --faults F0,F1,F2,F3,F4,F6,F7,F8,F9,F10")]
    Cluster(ClusterFlags),

    /// The process of a scenario's robots; it is started by the scenario
    #[command(hide = true)]
    Robots,
    /// Fetch blobs over HTTP, in turns with nginx where it is installed
    ///
    /// One large blob to few and to many connections, a small one to very many, and different large
    /// ones from the disk while the API is probed. Every connection is another robot's. Processor
    /// time is the server's own.
    #[command(after_help = "Example:\n  taskbench blob --runs 7 --out results")]
    Blob(BlobFlags),

    /// One order for a large package, in turns with curl, openssl and tar, which fetch the same
    /// from nginx
    ///
    /// From the order until all robots have verified and unpacked it, against as many shells side
    /// by side that fetch, hash and unpack one step after the other. Processor time is everybody's:
    /// server, robots, programs.
    #[command(after_help = "Example:\n  taskbench pull --robots 8 --runs 7 --out results")]
    Pull(PullFlags),

    /// Send a short message to each of many connected robots, in turns with mosquitto where it is
    /// installed
    ///
    /// The front is measured by itself: `cargo build --release -p taskd --example front` makes the
    /// program for that. The first message to each client is timed apart from the later ones.
    #[command(after_help = "Example:\n  taskbench broker --clients 10000 --runs 7 --out results")]
    Broker(BrokerFlags),

    /// Report at fixed rates, and time when reports are stored, with SQLite and Postgres
    #[command(
        after_help = "Example:\n  taskbench status --rate 10000 --postgres postgres://postgres@localhost/bench"
    )]
    Status(StatusFlags),

    /// Order packages for a whole fleet of rows, and time how long that stops other robots' reports
    ///
    /// Most robots are only in the database, without sessions; a few are connected and report at a
    /// fixed rate. Packages for all robots, for those with a label, two that are cancelled, and
    /// orders of other kinds. The exit code is 0 if nothing failed.
    #[command(
        after_help = "Example:\n  taskbench orders --postgres postgres://postgres@localhost/bench"
    )]
    Orders(OrdersFlags),

    /// Look at the page in a browser while a fleet reports, and scroll
    ///
    /// Needs node, Chromium and the packages of `scripts/need page`. First rows are timed from
    /// asking for the page, with a session; main-thread times are the browser's own trace.
    #[command(
        after_help = "Example:\n  taskbench page --robots 10000 --rate 1000 --browser \"$(scripts/need page)\""
    )]
    Page(PageFlags),

    /// Show the differences between two results of the same scenario
    #[command(after_help = "Example:\n  taskbench compare old/blob.json new/blob.json --least 5")]
    Compare(CompareFlags),

    /// Draw the HTML page of a result again, from its JSON file
    #[command(after_help = "Example:\n  taskbench report taskbench-results/paper.json paper.html")]
    Report {
        /// JSON file of the result
        json: PathBuf,
        /// HTML file to write [default: beside the result]
        html: Option<PathBuf>,
    },
}

fn main() -> ExitCode {
    let CommandLine { command } = CommandLine::parse();
    let outcome = tokio::runtime::Runtime::new()
        .map_err(|error| anyhow::Error::new(error).context("cannot start the runtime's threads"))
        .and_then(|runtime| runtime.block_on(run(command)));
    outcome.unwrap_or_else(|error| report_error(&error))
}

async fn run(command: Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::Load(flags) => load(flags).await,
        Command::Paper(flags) => exit_code(until_interrupted(paper::run(flags)).await?),
        Command::Fleet(flags) => exit_code(until_interrupted(fleet::run(flags)).await?),
        Command::Cluster(flags) => exit_code(until_interrupted(cluster::run(flags)).await?),
        Command::Robots => taskbench::simulated::robots::run().await.map(|()| ExitCode::SUCCESS),
        Command::Blob(flags) => exit_code(until_interrupted(blob::run(flags)).await?),
        Command::Pull(flags) => exit_code(until_interrupted(pull::run(flags)).await?),
        Command::Broker(flags) => exit_code(until_interrupted(broker::run(flags)).await?),
        Command::Status(flags) => exit_code(until_interrupted(status::run(flags)).await?),
        Command::Orders(flags) => exit_code(until_interrupted(orders::run(flags)).await?),
        Command::Page(flags) => exit_code(until_interrupted(page::run(flags)).await?),
        Command::Compare(flags) => {
            print(&compare(&flags)?)?;
            Ok(ExitCode::SUCCESS)
        }
        Command::Report { json, html } => {
            let run = Run::read(&json).with_context(|| json.display().to_string())?;
            let html = html.unwrap_or_else(|| json.with_extension("html"));
            std::fs::write(&html, report::page(&run))
                .with_context(|| html.display().to_string())?;
            Ok(ExitCode::SUCCESS)
        }
    }
}

/// The scenario's outcome. An interruption drops the scenario, and with it all processes it has
/// started.
async fn until_interrupted<T>(
    scenario: impl Future<Output = anyhow::Result<T>>,
) -> anyhow::Result<T> {
    let mut terminated = signal(SignalKind::terminate()).context("SIGTERM can't be received")?;
    tokio::select! {
        outcome = scenario => outcome,
        _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("interrupted")),
        _ = terminated.recv() => Err(anyhow::anyhow!("terminated")),
    }
}

/// Success if nothing failed.
fn exit_code(run: Run) -> anyhow::Result<ExitCode> {
    print_line(&format!(
        "{} points, {} failures, {:.0} s",
        run.points.len(),
        run.failed(),
        run.wall_s
    ));
    Ok(if run.failed() == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Success if every step of every robot succeeded.
async fn load(flags: LoadFlags) -> anyhow::Result<ExitCode> {
    let mut load = Load::prepare(flags).await?;
    let outcome = tokio::select! {
        outcome = load.run() => outcome,
        _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("interrupted")),
    };
    let cleaned = tokio::select! {
        cleaned = load.clean_up() => cleaned,
        _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("interrupted again")),
    };
    let cleaned = cleaned
        .with_context(|| format!("robots labelled {} may be left on the server", load.label()));
    let mut code = if load.finish() == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE };
    for error in [outcome.err(), cleaned.err()].into_iter().flatten() {
        code = report_error(&error);
    }
    Ok(code)
}

fn print(text: &str) -> anyhow::Result<()> {
    use std::io::Write as _;
    std::io::stdout().write_all(text.as_bytes()).context("stdout")
}

/// Prints the error with all causes on stderr.
fn report_error(error: &anyhow::Error) -> ExitCode {
    print_line(&format!("taskbench: {error:#}"));
    ExitCode::FAILURE
}
