//! `task-agent hold` and `release`: a person at the robot has the last word. A flag file in the data directory, so that
//! both work without server and without a running agent.

use std::process::ExitCode;

use anyhow::Context as _;

use super::DataDir;
use crate::effects::HOLD_FILE;

/// Arguments of `hold` and of `release`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    data: DataDir,
}

/// From now on nothing is started or switched.
pub fn hold(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let path = arguments.data.data.join(HOLD_FILE);
    std::fs::write(&path, b"").with_context(|| format!("cannot write {}", path.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// From now on orders are followed again.
pub fn release(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let path = arguments.data.data.join(HOLD_FILE);
    match std::fs::remove_file(&path) {
        Ok(()) => Ok(ExitCode::SUCCESS),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(ExitCode::SUCCESS),
        Err(error) => Err(error).with_context(|| format!("cannot remove {}", path.display())),
    }
}
