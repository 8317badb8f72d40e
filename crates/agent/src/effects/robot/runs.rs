//! The run directories that a task has: what may still run of them is ended before they go.

use std::path::{Path, PathBuf};
use std::time::Duration;

use task_proto::report::FailureCode;

use super::outcomes::later;
use super::{Robot, on_disk};
use crate::durable;
use crate::plan::StepFailure;
use crate::supervisor::SupervisorError;

impl Robot {
    /// Ends what runs of every run directory in `runs` but one: a start that seemed to fail may have come about after all,
    /// and there are never two processes of a task. Gives these directories.
    pub(super) async fn end_other_runs(
        &self,
        runs: &Path,
        kept: Option<&Path>,
    ) -> Result<Vec<PathBuf>, SupervisorError> {
        let others = other_runs(runs, kept);
        for dir in &others {
            self.supervisor.stop(dir, Duration::ZERO).await?;
        }
        Ok(others)
    }

    /// Deletes every run directory but one.
    pub(super) async fn forget_runs(&self, runs: &Path, kept: Option<&Path>) -> Result<(), StepFailure> {
        let ended = self.end_other_runs(runs, kept).await;
        let others = ended.map_err(|error| later(FailureCode::IO_ERROR, &error, 0))?;
        on_disk(move || others.iter().try_for_each(|dir| durable::remove_dir_all(dir))).await
    }
}

/// Every run directory but one.
pub(super) fn other_runs(runs: &Path, kept: Option<&Path>) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(runs).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| Some(path.as_path()) != kept).collect()
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt as _;

    use task_proto::DeploymentId;

    use super::super::tests::robot;
    use crate::cgroup::RunLimits;
    use crate::containment::RUN_DIR_VARIABLE;
    use crate::effects::Effects as _;
    use crate::launch::Interrupt;
    use crate::run_dir::{LogSpec, RunDir, RunSpec};

    #[tokio::test]
    async fn what_still_runs_of_an_old_run_is_ended_before_its_directory_goes() {
        let temp = tempfile::tempdir().expect("a directory");
        let robot = robot(temp.path(), "");
        let talker = "talker".parse().expect("valid");
        let run = RunDir::create(&robot.data.task(&talker).run().join("d.1.1.1")).expect("made");
        let spec = RunSpec {
            assignment: DeploymentId::random(),
            script: "run.sh".into(),
            directory: "/".into(),
            environment: Default::default(),
            interrupt: Interrupt::default(),
            log: LogSpec::at("log".into()),
            limits: RunLimits::default(),
            user: None,
            cgroup: None,
        };
        run.write_spec(&spec).expect("written");
        #[expect(clippy::disallowed_methods, reason = "a process that a shim has started and not written down")]
        let mut command = std::process::Command::new("sleep");
        let mut process = command.arg("1000").env(RUN_DIR_VARIABLE, run.path()).spawn().expect("started");
        robot.prune(&talker, &[], None).await.expect("pruned");
        assert_eq!(process.wait().expect("it has ended").signal(), Some(9));
        assert!(!run.path().exists());
    }
}
