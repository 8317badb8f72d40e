//! The run directories of a task. Leftover processes of a run are ended before its directory is
//! deleted.

use std::path::{Path, PathBuf};
use std::time::Duration;

use task_proto::messages::report::FailureCode;

use super::outcomes::retryable_failure;
use super::{RUN_RECORD, Robot, blocking_io};
use crate::process::supervisor::SupervisorError;
use crate::system::clock;
use crate::system::durable;
use crate::task::plan::StepFailure;
use crate::task::run::{ActiveRun, ProcessRecord};

impl Robot {
    /// Ends the processes of every run directory in `runs` except `kept`: a start that seemed to
    /// fail may have succeeded after all, and a task never has two processes. Returns the other
    /// directories.
    pub(super) async fn end_other_runs(
        &self,
        runs: &Path,
        kept: Option<&Path>,
    ) -> Result<Vec<PathBuf>, SupervisorError> {
        let others = other_runs(runs, kept);
        for dir in &others {
            match self.supervisor.stop(dir, Duration::ZERO).await {
                Err(error)
                    if error.is_malformed()
                        && recorded_process(dir).is_some_and(|run| is_from_earlier_boot(&run)) => {}
                stopped => {
                    stopped?;
                }
            }
        }
        Ok(others)
    }

    /// Deletes every run directory except `kept`, after ending its processes.
    pub(super) async fn delete_runs(
        &self,
        runs: &Path,
        kept: Option<&Path>,
    ) -> Result<(), StepFailure> {
        let ended = self.end_other_runs(runs, kept).await;
        let others = ended.map_err(|error| retryable_failure(FailureCode::IO_ERROR, &error, 0))?;
        blocking_io(move || others.iter().try_for_each(|dir| durable::remove_dir_all(dir))).await
    }
}

/// Whether the machine was restarted after the start of the process. If so, the process is gone,
/// whatever its files say.
pub(super) fn is_from_earlier_boot(process: &ProcessRecord) -> bool {
    clock::boot_id().is_ok_and(|boot_id| boot_id != process.boot_id)
}

/// The process in the copy of the ledger's record that was written before the start.
fn recorded_process(dir: &Path) -> Option<ProcessRecord> {
    let run: ActiveRun = serde_json::from_slice(&std::fs::read(dir.join(RUN_RECORD)).ok()?).ok()?;
    run.process().cloned()
}

/// Every run directory except `kept`.
pub(super) fn other_runs(runs: &Path, kept: Option<&Path>) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(runs).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| Some(path.as_path()) != kept).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::os::unix::process::ExitStatusExt as _;

    use task_proto::desired::{BlobRef, DesiredTask, PackageRef, TargetState};
    use task_proto::packages::manifest::TaskManifest;
    use task_proto::{DeploymentId, Digest};

    use super::super::tests::{robot, run_dir};
    use super::*;
    use crate::process::containment::RUN_DIR_VARIABLE;
    use crate::task::effects::Effects as _;
    use crate::task::observed::ProcessState;
    use crate::task::run::RunRules;

    fn run_of(boot_id: &str) -> ActiveRun {
        let manifest = serde_json::json!({
            "name": "talker", "version": "1.0", "run": { "exec": ["true"] },
            "content": { "tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0 },
        });
        let rules =
            RunRules::from(&serde_json::from_value::<TaskManifest>(manifest).expect("a manifest"));
        let name = "talker".parse();
        let version = "1.0".parse().expect("valid");
        let blob = BlobRef::of(b"1");
        let name: task_proto::TaskName = name.expect("valid");
        let order = DesiredTask {
            task: name.clone(),
            deployment: DeploymentId::random(),
            package: PackageRef { name, version, manifest: blob, config: blob, content: blob },
            wanted: TargetState::Running,
            run: 1,
            delivery: Default::default(),
            priority: 0,
        };
        let process = ProcessRecord {
            dir: "d.1.1.1".to_owned(),
            boot_id: boot_id.to_owned(),
            started_ms: 1,
            pid: Some(7),
        };
        ActiveRun::of(&order, rules, 0).begin(process).become_ready()
    }

    #[tokio::test]
    async fn unreadable_run_is_gone_after_a_reboot() {
        let temp = tempfile::tempdir().expect("a directory");
        let robot = robot(temp.path(), "");
        let talker = "talker".parse().expect("valid");
        let now = run_of(&clock::boot_id().expect("a boot id"));
        let before = run_of("an earlier boot");
        let [now_process, before_process] =
            [&now, &before].map(|run| run.process().cloned().expect("a process"));
        let dir = run_dir(&robot.run_dir(&talker, &now_process), BTreeMap::new());
        std::fs::write(dir.path().join("pid.json"), "{").expect("written");
        let record = |run: &ActiveRun| {
            std::fs::write(dir.path().join(RUN_RECORD), serde_json::to_vec(run).expect("json"))
                .expect("written");
        };
        record(&now);
        assert_eq!(robot.process(&talker, &now_process).await, ProcessState::Unknown);
        robot.remove(&talker).await.expect_err("it may live");
        record(&before);
        assert!(matches!(robot.process(&talker, &before_process).await, ProcessState::Ended(_)));
        robot.remove(&talker).await.expect("removed");
        assert!(!dir.path().exists());
    }

    #[tokio::test]
    async fn hanging_start_does_not_block_observation() {
        let temp = tempfile::tempdir().expect("a directory");
        let robot = robot(temp.path(), "");
        let talker = "talker".parse().expect("valid");
        let process = run_of("boot").process().cloned().expect("a process");
        let dir = run_dir(&robot.run_dir(&talker, &process), BTreeMap::new());
        let hangs = dir.try_lock().expect("locked").expect("nobody has it");
        let looking =
            tokio::time::timeout(Duration::from_secs(10), robot.process(&talker, &process));
        assert_eq!(looking.await.expect("at once"), ProcessState::Unknown);
        drop(hangs);
        // A process that another test is just starting shares the lock for a moment.
        let known = tokio::time::timeout(Duration::from_secs(60), async {
            loop {
                match robot.process(&talker, &process).await {
                    ProcessState::Unknown => tokio::task::yield_now().await,
                    known => break known,
                }
            }
        });
        assert_eq!(known.await.expect("it is known"), ProcessState::NeverStarted);
    }

    #[tokio::test]
    async fn leftover_processes_end_before_their_run_directory_is_deleted() {
        let temp = tempfile::tempdir().expect("a directory");
        let robot = robot(temp.path(), "");
        let talker = "talker".parse().expect("valid");
        let run = run_dir(&robot.data.task(&talker).run().join("d.1.1.1"), BTreeMap::new());
        #[expect(
            clippy::disallowed_methods,
            reason = "a process that a shim has started and not written down"
        )]
        let mut command = std::process::Command::new("sleep");
        let mut process =
            command.arg("1000").env(RUN_DIR_VARIABLE, run.path()).spawn().expect("started");
        robot.prune(&talker, &[], None).await.expect("pruned");
        assert_eq!(process.wait().expect("it has ended").signal(), Some(9));
        assert!(!run.path().exists());
    }
}
