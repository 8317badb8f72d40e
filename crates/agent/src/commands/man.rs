//! `task-agent man`: the program's man pages, generated from its command line definition.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context as _;

#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Output directory; created if missing
    directory: PathBuf,
}

/// Writes a page for each subcommand.
pub fn run(arguments: &Arguments, command_line: clap::Command) -> anyhow::Result<ExitCode> {
    let directory = &arguments.directory;
    let written = std::fs::create_dir_all(directory)
        .and_then(|()| clap_mangen::generate_to(command_line, directory));
    written.with_context(|| format!("cannot write to {}", directory.display()))?;
    Ok(ExitCode::SUCCESS)
}
