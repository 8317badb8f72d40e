//! The `taskbench` binary: parses the command line, runs a scenario until it ends or is interrupted, and always cleans
//! up. It never measures anything.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context as _;
use clap::{Parser, Subcommand};
use taskbench::load::{Load, LoadFlags};
use taskbench::progress::say;
use taskbench::report::page;
use taskbench::run::Run;

/// Measures taskd
///
/// Each scenario starts the real server as a child process, with a directory and ports of its own, and ends it
/// afterwards. Results go to --out as JSON (everything: commit, machine, seed, versions, points), CSV (a row for each
/// quantity) and one HTML file with plots that needs no network. Build the programs with `cargo build --release --bins`.
#[derive(Parser)]
#[command(name = "taskbench", version, propagate_version = true)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Enrol simulated robots, connect them over MQTT, deploy to them, and measure each step
    ///
    /// The robots are one machine's TCP connections with the MQTT client of an independent implementation. They verify
    /// and report what they are ordered like a real agent, but fetch and run nothing. In the end they are removed, and
    /// so is the package that was ordered; the deployment stays in the server's history. The exit code is 0 if nothing
    /// failed. Ctrl-C stops the run and cleans up; a second one ends it at once.
    #[command(after_help = "Example:\n  taskbench load --server http://localhost:8080 \
                            --token-file ~/.local/share/taskd/operator.token --robots 1000")]
    Load(LoadFlags),

    /// Draw the HTML page of a result again, from its JSON file
    #[command(after_help = "Example:\n  taskbench report taskbench-results/paper.json paper.html")]
    Report {
        /// The result
        json: PathBuf,
        /// The page [default: beside the result]
        html: Option<PathBuf>,
    },
}

fn main() -> ExitCode {
    let CommandLine { command } = CommandLine::parse();
    let outcome = tokio::runtime::Runtime::new()
        .map_err(|error| anyhow::Error::new(error).context("no threads to run on"))
        .and_then(|runtime| runtime.block_on(run(command)));
    outcome.unwrap_or_else(|error| complain(&error))
}

async fn run(command: Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::Load(flags) => load(flags).await,
        Command::Report { json, html } => {
            let run = Run::read(&json).with_context(|| json.display().to_string())?;
            let html = html.unwrap_or_else(|| json.with_extension("html"));
            std::fs::write(&html, page(&run)).with_context(|| html.display().to_string())?;
            Ok(ExitCode::SUCCESS)
        }
    }
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
    let cleaned = cleaned.with_context(|| format!("robots labelled {} may be left on the server", load.label()));
    let mut code = if load.finish() == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE };
    for error in [outcome.err(), cleaned.err()].into_iter().flatten() {
        code = complain(&error);
    }
    Ok(code)
}

/// Says on stderr what went wrong, with all causes.
fn complain(error: &anyhow::Error) -> ExitCode {
    say(&format!("taskbench: {error:#}"));
    ExitCode::FAILURE
}
