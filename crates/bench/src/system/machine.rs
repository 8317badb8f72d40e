//! Context of every measurement: the machine and the commit. Unknown values are `unknown`, never an
//! error. Also limits how much of the machine a run may use.

use std::path::Path;

use anyhow::{Context as _, ensure};
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::utsname::uname;
use serde::{Deserialize, Serialize};

use crate::system::process::Program;

const UNKNOWN: &str = "unknown";

/// The machine of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    pub cpu: String,
    /// Cores available to this program.
    pub cores: usize,
    pub memory_bytes: u64,
    /// The kernel's name and release.
    pub kernel: String,
    pub system: String,
}

impl Machine {
    pub fn here() -> Self {
        let read = |path: &str| std::fs::read_to_string(Path::new(path)).unwrap_or_default();
        let kilobytes: Option<u64> = field(&read("/proc/meminfo"), "MemTotal", ':')
            .and_then(|text| text.split_whitespace().next()?.parse().ok());
        let kernel = uname().ok().map(|name| {
            format!("{} {}", name.sysname().to_string_lossy(), name.release().to_string_lossy())
        });
        Self {
            cpu: field(&read("/proc/cpuinfo"), "model name", ':')
                .unwrap_or_else(|| UNKNOWN.to_owned()),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_bytes: kilobytes.unwrap_or(0) * 1024,
            kernel: kernel.unwrap_or_else(|| UNKNOWN.to_owned()),
            system: field(&read("/etc/os-release"), "PRETTY_NAME", '=')
                .unwrap_or_else(|| UNKNOWN.to_owned()),
        }
    }
}

/// The commit of the repository in the working directory, with `-dirty` if files differ from the
/// commit.
pub async fn commit() -> String {
    let git = Program::named("git").args([
        "describe",
        "--always",
        "--dirty",
        "--abbrev=12",
        "--exclude=*",
    ]);
    match git.output().await {
        Ok(text) => text.trim().to_owned(),
        Err(_) => UNKNOWN.to_owned(),
    }
}

/// The value of the first line `name SEPARATOR value`, without quotes.
fn field(text: &str, name: &str, separator: char) -> Option<String> {
    text.lines().find_map(|line| {
        let (key, value) = line.split_once(separator)?;
        (key.trim() == name).then(|| value.trim().trim_matches('"').to_owned())
    })
}

/// Raises the limit of open files to `needed` for this program and each of its children: every
/// connection is one file, on both sides.
pub fn allow_files(needed: u64) -> anyhow::Result<()> {
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).context("the limit of open files")?;
    if soft >= needed {
        return Ok(());
    }
    let raised = setrlimit(Resource::RLIMIT_NOFILE, needed, hard.max(needed));
    ensure!(
        raised.is_ok(),
        "{needed} open files are needed, this system allows {hard} (ulimit -Hn): raise it, run as root or ask for less"
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn machine_description_is_complete() {
        let here = Machine::here();
        assert!(
            here.cores > 0 && here.memory_bytes > 1 << 20 && here.kernel.starts_with("Linux "),
            "{here:?}"
        );
        assert_eq!(
            field("a : x\nmodel name\t: Fast 9\n", "model name", ':').as_deref(),
            Some("Fast 9")
        );
        assert_eq!(
            field("PRETTY_NAME=\"A System\"\n", "PRETTY_NAME", '=').as_deref(),
            Some("A System")
        );
        assert_eq!(field("", "x", ':'), None);
    }
}
