//! `task-agent run`.

use std::process::ExitCode;

use super::DataDir;

/// Arguments of `run`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    data: DataDir,
}

/// Runs the subcommand.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    anyhow::bail!("nothing is enrolled in {}", arguments.data.data.display())
}
