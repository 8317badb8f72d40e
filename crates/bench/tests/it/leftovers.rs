//! Leftovers of a killed agent: processes, which name its directory, and control groups.

use std::collections::BTreeSet;
use std::fs::File;
use std::os::fd::AsFd as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

use nix::poll::{PollFd, PollFlags, poll};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use crate::harness::TIMEOUT;

/// Ends all that the agent with this data directory has started.
pub fn end(data: &Path) {
    let groups = cgroups_of(data);
    end_processes_below(data);
    groups.iter().for_each(|group| remove_cgroup(group));
}

/// The control groups of a robot's runs and of its other processes: those that only the killed
/// agent would remove.
fn cgroups_of(data: &Path) -> BTreeSet<PathBuf> {
    let entries = |dir: PathBuf| {
        std::fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path())
    };
    let runs = entries(data.join("tasks")).flat_map(|task| entries(task.join("run")));
    let written = runs.filter_map(|run| {
        let spec: Value =
            serde_json::from_slice(&std::fs::read(run.join("spec.json")).ok()?).ok()?;
        Some(PathBuf::from(spec["cgroup"].as_str()?))
    });
    let mounts = std::fs::read_to_string("/proc/mounts").expect("mounts");
    let mount = mounts
        .lines()
        .find_map(|line| line.contains(" cgroup2 ").then(|| line.split(' ').nth(1)).flatten());
    let carry = processes_with(data.to_str().expect("utf-8 path").as_bytes());
    let joined = carry.into_iter().filter_map(|pid| {
        let groups = std::fs::read_to_string(format!("/proc/{pid}/cgroup")).ok()?;
        let own = groups.lines().find_map(|line| line.strip_prefix("0::/"))?;
        own.contains("taskd/run-").then_some(Path::new(mount?).join(own))
    });
    written.chain(joined).collect()
}

/// Ends the group's remaining processes and removes the group, and its parent if no other test has
/// groups there.
fn remove_cgroup(group: &Path) {
    let start = Instant::now();
    while group.exists() && std::fs::remove_dir(group).is_err() && start.elapsed() < TIMEOUT {
        let inside = std::fs::read_to_string(group.join("cgroup.procs")).unwrap_or_default();
        for pid in inside.lines().filter_map(|line| line.parse().ok()) {
            let _ = kill(Pid::from_raw(pid), Signal::SIGKILL);
        }
        // The kernel takes a moment to let a killed process go, and says when.
        if let Ok(events) = File::open(group.join("cgroup.events")) {
            let _ = poll(&mut [PollFd::new(events.as_fd(), PollFlags::POLLPRI)], 50_u8);
        }
    }
    let base = group.parent().expect("lies in one");
    let _ = std::fs::remove_dir(base.join("shims")).and_then(|()| std::fs::remove_dir(base));
}

/// Kills all our processes with `dir` in their environment or command line.
fn end_processes_below(dir: &Path) {
    let needle = dir.to_str().expect("utf-8 path").as_bytes().to_owned();
    // Killing a shim frees its children; a few rounds find those too.
    for _ in 0..3 {
        for pid in processes_with(&needle) {
            let _ = kill(Pid::from_raw(pid), Signal::SIGKILL);
        }
    }
}

/// Pids of processes with `needle` in their environment or command line, except our own process.
pub fn processes_with(needle: &[u8]) -> Vec<i32> {
    let own = i32::try_from(std::process::id()).expect("pid");
    std::fs::read_dir("/proc")
        .expect("/proc")
        .filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok())
        .filter(|&pid| pid != own)
        .filter(|pid| {
            ["environ", "cmdline"].iter().any(|file| {
                std::fs::read(format!("/proc/{pid}/{file}"))
                    .is_ok_and(|bytes| bytes.windows(needle.len()).any(|window| window == needle))
            })
        })
        .collect()
}
