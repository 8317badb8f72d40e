//! `task-agent hold` and `release`: a person at the robot has the last word. Both commands use a
//! flag file in the data directory, so that they work without a server and without a running agent.

use std::process::ExitCode;

use anyhow::Context as _;

use super::DataDir;
use crate::system::durable;
use crate::system::layout::HOLD_FILE;

/// Arguments of `hold` and of `release`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    data: DataDir,
}

/// Blocks starts and switches from now on, also after a power cut.
pub fn hold(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let path = arguments.data.data.join(HOLD_FILE);
    durable::write(&path, b"", 0o644)
        .with_context(|| format!("cannot write {}", path.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Lets the agent follow orders again.
pub fn release(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let path = arguments.data.data.join(HOLD_FILE);
    match std::fs::remove_file(&path) {
        Ok(()) => Ok(ExitCode::SUCCESS),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(ExitCode::SUCCESS),
        Err(error) => Err(error).with_context(|| format!("cannot remove {}", path.display())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hold_file_is_durable_and_release_removes_it() {
        let dir = tempfile::tempdir().expect("a directory");
        let arguments = || Arguments { data: DataDir { data: dir.path().to_owned() } };
        let path = dir.path().join(HOLD_FILE);
        // A durable write replaces the old file and does not write into it.
        std::os::unix::fs::symlink(dir.path().join("elsewhere"), &path).expect("linked");
        hold(arguments()).expect("held");
        assert!(
            path.symlink_metadata().expect("it is there").is_file()
                && !dir.path().join("elsewhere").exists()
        );
        release(arguments()).expect("released");
        assert!(!path.exists());
    }
}
