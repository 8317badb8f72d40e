//! Shared test helpers: a deadline for everything that is awaited, and a run of a script under the
//! real shim.

use std::collections::BTreeMap;
use std::future::Future;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use task_agent::logs::LogSpec;
use task_agent::logs::record::Record;
use task_agent::process::cgroup::{Cgroups, RunLimits};
use task_agent::process::containment::Containment;
use task_agent::process::program::ProcessEntry;
use task_agent::process::run_dir::{RunDir, RunSpec};
use task_agent::process::supervisor::Supervisor;
use task_agent::setup::environment;
use task_agent::setup::launch::Interrupt;
use task_agent::system::task_user::TaskUser;

/// Longer than any test step takes on a loaded machine.
const DEADLINE: Duration = Duration::from_secs(60);

/// Returns `future`'s output, or panics with the missing event.
pub async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    tokio::time::timeout(DEADLINE, future)
        .await
        .unwrap_or_else(|_| panic!("not within {DEADLINE:?}: {what}"))
}

/// Polls until `condition` returns a value. The only polling in these tests, for conditions without
/// an event to wait for.
pub async fn eventually<T>(what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let mut tick = tokio::time::interval(Duration::from_millis(20));
    within(what, async {
        loop {
            tick.tick().await;
            if let Some(value) = condition() {
                return value;
            }
        }
    })
    .await
}

/// One run of a script, in a directory of its own.
pub struct TestRun {
    dir: tempfile::TempDir,
    pub supervisor: Supervisor,
    pub spec: RunSpec,
}

impl TestRun {
    /// A run of `script`, not started.
    pub fn of(script: &str) -> Self {
        let dir = tempfile::tempdir().expect("temp dir");
        let path = dir.path().join("run.sh");
        std::fs::write(&path, format!("#!/bin/bash\n{script}\n")).expect("script");
        let spec = RunSpec {
            assignment: task_proto::DeploymentId::random(),
            script: path,
            directory: dir.path().to_owned(),
            environment: environment::robot_environment(&BTreeMap::new()),
            interrupt: Interrupt::Group,
            log: LogSpec::at(dir.path().join("task.log")),
            limits: RunLimits::default(),
            user: None,
            has_outputs: false,
            cgroup: None,
        };
        Self { dir, supervisor: supervisor(), spec }
    }

    /// The same with the machine's control groups, if available.
    pub fn grouped(script: &str) -> Self {
        let mut run = Self::of(script);
        run.supervisor = grouped_supervisor();
        run
    }

    /// Makes the script run as `user`, in a directory of that user's own, below one that the user
    /// can only pass through.
    pub fn run_as(&mut self, user: &TaskUser) {
        self.spec.directory = self.path("work");
        user.make_home(&self.spec.directory).expect("handed over");
        std::fs::set_permissions(self.path("."), std::fs::Permissions::from_mode(0o700))
            .expect("closed");
        user.allow_traversal(&[self.path(".")]).expect("let through");
        self.spec.user = Some(user.clone());
    }

    fn cgroup_if_any(&self) -> Option<PathBuf> {
        RunDir::create(&self.run_dir()).ok()?.spec().ok()??.cgroup
    }

    /// The run's control group, as a new agent finds it.
    pub fn cgroup(&self) -> Option<PathBuf> {
        RunDir::create(&self.run_dir())
            .expect("run dir")
            .spec()
            .expect("spec")
            .expect("written")
            .cgroup
    }

    /// A path in the script's working directory.
    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// The run directory.
    pub fn run_dir(&self) -> PathBuf {
        self.path("run")
    }

    /// The task's output so far, without times.
    pub fn log(&self) -> String {
        let log = std::fs::read(&self.spec.log.path).unwrap_or_default();
        let lines = log.split_inclusive(|byte| *byte == b'\n');
        lines.map(|line| String::from_utf8_lossy(Record::parse(line).text).into_owned()).collect()
    }

    /// Waits until the task has written `text`.
    pub async fn wrote(&self, text: &str) {
        eventually(&format!("the output {text:?}"), || self.log().contains(text).then_some(()))
            .await;
    }

    /// The processes that carry this run's assignment.
    pub fn survivors(&self) -> Vec<u32> {
        let marker = format!("TASKD_ASSIGNMENT={}", self.spec.assignment);
        let table = ProcessEntry::all().expect("process table");
        table
            .iter()
            .filter(|e| !e.is_zombie && e.was_started_with(&marker))
            .map(|e| e.pid)
            .collect()
    }
}

/// Ensures that no test leaves a process behind, even after a panic.
impl Drop for TestRun {
    fn drop(&mut self) {
        let containment = Containment::new(&self.run_dir(), None, self.cgroup_if_any());
        let _ = containment.kill().and_then(|_| containment.remove());
    }
}

/// A supervisor that runs the binary under test as shims, and uses the machine's control groups if
/// permitted.
pub fn grouped_supervisor() -> Supervisor {
    Supervisor::new(env!("CARGO_BIN_EXE_task-agent"), Cgroups::find())
}

/// A user id that no other test uses; `None`, with a printed note, for tests that do not run as
/// root.
#[expect(clippy::print_stderr, reason = "a skipped test is reported")]
pub fn other_user() -> Option<TaskUser> {
    static USED: AtomicU32 = AtomicU32::new(0);
    if !nix::unistd::geteuid().is_root() {
        eprintln!("unavailable: only root can start something as another user");
        return None;
    }
    let uid = 1_000_000 + std::process::id() % 100_000 * 100 + USED.fetch_add(1, Ordering::Relaxed);
    Some(TaskUser { name: uid.to_string(), uid, gid: uid, groups: vec![uid + 50] })
}

/// A supervisor that runs the binary under test as shims, without control groups.
pub fn supervisor() -> Supervisor {
    Supervisor::new(env!("CARGO_BIN_EXE_task-agent"), None)
}

/// Whether `pid` exists and is no zombie.
pub fn lives(pid: u32) -> bool {
    ProcessEntry::of(pid).expect("process table").is_some_and(|entry| !entry.is_zombie)
}

/// Writes a file and the directories above it.
pub fn write(path: &Path, text: &str) {
    std::fs::create_dir_all(path.parent().expect("parent")).expect("directories");
    std::fs::write(path, text).expect("file");
}
