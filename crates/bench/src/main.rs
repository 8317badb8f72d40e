//! The `taskbench` binary: parses the command line, runs the load, and always cleans up. It never measures anything.

mod load;
mod measure;
mod report;
mod robot;
mod server;

use std::io::Write as _;
use std::process::ExitCode;

use anyhow::Context as _;
use clap::{Parser, Subcommand};

use crate::load::{Load, LoadFlags};

/// Measures a taskd server with simulated robots
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
    Load(LoadFlags),
}

fn main() -> ExitCode {
    let CommandLine { command: Command::Load(flags) } = CommandLine::parse();
    let outcome = tokio::runtime::Runtime::new()
        .map_err(|error| anyhow::Error::new(error).context("no threads to run on"))
        .and_then(|runtime| runtime.block_on(load(flags)));
    outcome.unwrap_or_else(|error| complain(&error))
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

/// Says on stderr what went wrong, with all causes. A broken stderr is no reason to panic.
fn complain(error: &anyhow::Error) -> ExitCode {
    let _ = writeln!(std::io::stderr(), "taskbench: {error:#}");
    ExitCode::FAILURE
}
