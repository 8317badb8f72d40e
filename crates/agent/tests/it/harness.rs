//! What the tests share: a deadline for everything that is awaited, and a run of a script under the real shim.

use std::collections::BTreeMap;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::time::Duration;

use task_agent::environment;
use task_agent::launch::Interrupt;
use task_agent::logs::record::Record;
use task_agent::process::ProcessEntry;
use task_agent::run_dir::{LogSpec, RunSpec};
use task_agent::supervisor::Supervisor;

/// Longer than anything here takes on a loaded machine.
const DEADLINE: Duration = Duration::from_secs(60);

/// `future`'s output, or a panic that says what did not happen.
pub async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    tokio::time::timeout(DEADLINE, future).await.unwrap_or_else(|_| panic!("not within {DEADLINE:?}: {what}"))
}

/// Waits until `condition` gives a value. The one place that looks again and again: for what has no event to wait for.
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
            environment: environment::of_this_robot(&BTreeMap::new()),
            interrupt: Interrupt::Group,
            log: LogSpec::at(dir.path().join("task.log")),
        };
        Self { dir, supervisor: supervisor(), spec }
    }

    /// Where the script runs.
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
        eventually(&format!("the output {text:?}"), || self.log().contains(text).then_some(())).await;
    }

    /// The processes that carry this run's assignment.
    pub fn survivors(&self) -> Vec<u32> {
        let marker = format!("TASKD_ASSIGNMENT={}", self.spec.assignment);
        let table = ProcessEntry::all().expect("process table");
        table.iter().filter(|e| !e.is_zombie && e.was_started_with(&marker)).map(|e| e.pid).collect()
    }
}

/// No test leaves a process behind, whatever it died of.
impl Drop for TestRun {
    fn drop(&mut self) {
        let _ = task_agent::containment::Containment::new(&self.run_dir(), None).kill();
    }
}

/// A supervisor whose shims are the binary under test.
pub fn supervisor() -> Supervisor {
    Supervisor::new(env!("CARGO_BIN_EXE_task-agent"))
}

/// Whether `pid` is there and no zombie.
pub fn lives(pid: u32) -> bool {
    ProcessEntry::of(pid).expect("process table").is_some_and(|entry| !entry.is_zombie)
}

/// Writes a file and the directories above it.
pub fn write(path: &Path, text: &str) {
    std::fs::create_dir_all(path.parent().expect("parent")).expect("directories");
    std::fs::write(path, text).expect("file");
}
