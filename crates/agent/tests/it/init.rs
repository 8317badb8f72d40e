//! The agent as process 1, in a process namespace of its own as in a container.

use std::path::Path;
use std::process::{Child, Stdio};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use task_agent::process::program::ProcessEntry;

use crate::doctor::write_identity;
use crate::harness::eventually;

/// Kills its processes when dropped, for any outcome of the test.
struct Namespace(Child);

impl Drop for Namespace {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[expect(clippy::disallowed_methods, reason = "the test starts the program it tests")]
fn agent_as_init(data: &Path) -> Namespace {
    let mut command = std::process::Command::new("unshare");
    command.args([
        "--pid",
        "--fork",
        "--mount-proc",
        "--kill-child",
        env!("CARGO_BIN_EXE_task-agent"),
        "run",
        "--data",
    ]);
    command.arg(data).env("TASK_AGENT_MQTT", "false").stdin(Stdio::null()).stderr(Stdio::null());
    Namespace(command.spawn().unwrap())
}

#[expect(
    clippy::disallowed_methods,
    reason = "the test puts orphans into the namespace of the program it tests"
)]
fn leave_orphans_to(init: u32) -> bool {
    let mut command = std::process::Command::new("nsenter");
    command.args([
        "--target",
        &init.to_string(),
        "--pid",
        "--mount",
        "sh",
        "-c",
        "sleep 1000 & sleep 1000 &",
    ]);
    command.stdin(Stdio::null()).status().unwrap().success()
}

fn children_of(parent: u32) -> Vec<ProcessEntry> {
    ProcessEntry::all().unwrap().into_iter().filter(|entry| entry.parent == parent).collect()
}

fn handles(pid: u32, signal: Signal) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
    u64::from_str_radix(caught.trim(), 16).unwrap() & 1 << (signal as i32 - 1) != 0
}

#[tokio::test]
async fn agent_as_process_1_collects_orphans_and_ends_in_good_order() {
    if !nix::unistd::geteuid().is_root() {
        return eprintln!("unavailable: only root may make a process namespace");
    }
    let dir = tempfile::tempdir().unwrap();
    write_identity(dir.path(), "http://127.0.0.1:9");
    let mut namespace = agent_as_init(dir.path());
    let only_child = |parent| move || children_of(parent).first().map(|entry| entry.pid);
    let init = eventually("process 1", only_child(namespace.0.id())).await;
    let agent = eventually("the agent below it", only_child(init)).await;
    assert!(leave_orphans_to(init));
    let orphans = eventually("the orphans", || {
        Some(children_of(init)).filter(|children| children.len() == 3)
    })
    .await;
    for orphan in orphans.iter().filter(|entry| entry.pid != agent) {
        kill(Pid::from_raw(orphan.pid.try_into().unwrap()), Signal::SIGKILL).unwrap();
    }
    eventually("nothing but the agent", || (children_of(init).len() == 1).then_some(())).await;

    eventually("the agent to handle signals", || handles(agent, Signal::SIGTERM).then_some(()))
        .await;
    kill(Pid::from_raw(init.try_into().unwrap()), Signal::SIGTERM).unwrap();
    let ended = eventually("the end", || namespace.0.try_wait().unwrap()).await;
    assert!(ended.success(), "{ended}");
}
