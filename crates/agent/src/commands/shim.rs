//! `task-agent shim`: stands between the agent and one task. Only the agent calls it.

use std::path::Path;
use std::process::ExitCode;

/// Runs the shim of the run in `dir` until its task has ended.
pub fn run(dir: &Path) -> anyhow::Result<ExitCode> {
    crate::process::shim::run(dir)?;
    Ok(ExitCode::SUCCESS)
}
