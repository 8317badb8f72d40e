//! The run directory: the record of one start of a task, written by the supervisor before the start
//! and by the shim during the run. One directory is one start and is never reused. The directory
//! holds `spec.json` (the program to run), `begun` (the task may run from now on), `pid.json` (the
//! run's processes), `exit.json` (the exit status) and `lock` (held while the start is in
//! progress). This module never starts or signals a process.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use task_proto::DeploymentId;

use crate::logs::LogSpec;
use crate::process::cgroup::RunLimits;
use crate::process::program::{ExitStatus, ProcessIdentity};
use crate::setup::launch::Interrupt;
use crate::system::durable;
use crate::system::task_user::TaskUser;

/// The run directory of one start of a task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunDir(PathBuf);

/// The specification of a run, for the shim.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunSpec {
    /// The deployment this run belongs to; every process of the task carries it as
    /// `TASKD_ASSIGNMENT`.
    pub assignment: DeploymentId,
    /// The generated script, run by bash.
    pub script: PathBuf,
    /// The working directory of the script.
    pub directory: PathBuf,
    /// The whole environment; nothing is inherited. The supervisor adds `TASKD_ASSIGNMENT` and
    /// `TASKD_RUN_DIR`.
    pub environment: BTreeMap<String, String>,
    /// The processes that get the SIGINT of a stop.
    #[serde(default)]
    pub interrupt: Interrupt,
    /// Log of the task's output.
    pub log: LogSpec,
    /// The run's resource limits.
    #[serde(default)]
    pub limits: RunLimits,
    /// The account of the run; absent: the agent's own account.
    #[serde(default)]
    pub user: Option<TaskUser>,
    /// Whether files in `directory` are to be uploaded after the run.
    #[serde(default)]
    pub has_outputs: bool,
    /// The directory of the run's control group, if the run has one. The supervisor makes the
    /// group.
    #[serde(default)]
    pub cgroup: Option<PathBuf>,
}

/// The processes of a run that has begun.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Started {
    pub shim: ProcessIdentity,
    /// The task's first process, which leads its own process group.
    pub task: ProcessIdentity,
}

/// The end of a run. When this record is on disk, none of the run's processes is left that the shim
/// could see and end, and the run's output files for upload are on the disk as well.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ended {
    /// Exit status of the first process.
    #[serde(flatten)]
    pub status: ExitStatus,
    /// Time of the end: milliseconds since the machine booted, because a robot's clock may be
    /// wrong.
    pub at_uptime_ms: u64,
    /// The memory limit, if the run was killed for exceeding the limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub out_of_memory_bytes: Option<u64>,
}

/// A file of the run directory that could not be used.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// Reading or writing it failed.
    #[error("cannot use {}", path.display())]
    Io { path: PathBuf, source: io::Error },
    /// The file is not in the format that this version writes.
    #[error("{} is damaged", path.display())]
    Malformed { path: PathBuf, source: serde_json::Error },
}

impl RunDirError {
    /// Whether the error is a lack of disk space.
    pub fn is_full(&self) -> bool {
        use io::ErrorKind::{QuotaExceeded, StorageFull};
        matches!(self, Self::Io { source, .. } if matches!(source.kind(), StorageFull | QuotaExceeded))
    }
}

impl RunDir {
    /// The run directory at `path`, created if absent. The path becomes absolute and free of links,
    /// because the path is also the key by which the run's processes are found.
    pub fn create(path: &Path) -> Result<Self, RunDirError> {
        let failed = |source| RunDirError::Io { path: path.to_owned(), source };
        durable::create_dir_all(path).map_err(failed)?;
        Ok(Self(path.canonicalize().map_err(failed)?))
    }

    /// The run directory at `path`, without creating or changing it.
    pub fn at(path: &Path) -> Self {
        Self(path.to_owned())
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The specification of the run.
    pub fn spec(&self) -> Result<Option<RunSpec>, RunDirError> {
        self.read("spec.json")
    }

    pub fn started(&self) -> Result<Option<Started>, RunDirError> {
        self.read("pid.json")
    }

    /// The record of the run's end.
    pub fn ended(&self) -> Result<Option<Ended>, RunDirError> {
        self.read("exit.json")
    }

    /// Writes the specification of the run.
    pub fn write_spec(&self, spec: &RunSpec) -> Result<(), RunDirError> {
        self.write("spec.json", spec)
    }

    /// Records that the run is about to begin: until its processes are recorded, it is uncertain
    /// whether the task ran.
    pub fn write_begun(&self) -> Result<(), RunDirError> {
        let path = self.0.join("begun");
        durable::write(&path, b"", 0o600).map_err(|source| RunDirError::Io { path, source })
    }

    /// Removes that record, because nothing ran after all.
    pub fn remove_begun(&self) -> Result<(), RunDirError> {
        let path = self.0.join("begun");
        durable::remove_file(&path).map_err(|source| RunDirError::Io { path, source })
    }

    /// Whether the task may have run.
    pub fn has_begun(&self) -> bool {
        self.0.join("begun").exists()
    }

    /// Records the run's processes.
    pub fn write_started(&self, started: &Started) -> Result<(), RunDirError> {
        self.write("pid.json", started)
    }

    /// Records the end of the run.
    pub fn write_ended(&self, ended: &Ended) -> Result<(), RunDirError> {
        self.write("exit.json", ended)
    }

    /// Takes the start lock; `None` while a start is in progress. This call never waits: a start
    /// may hang and would block the waiting thread. The lock goes with the file, also into a child
    /// that inherits the file, so there is no moment at which a start is under way and the lock is
    /// free. Where files can no longer be written, running tasks can still be observed and stopped.
    pub fn try_lock(&self) -> Result<Option<File>, RunDirError> {
        self.locked(File::try_lock)
    }

    /// Takes the start lock for reading only, shared with other readers.
    pub fn try_lock_shared(&self) -> Result<Option<File>, RunDirError> {
        self.locked(File::try_lock_shared)
    }

    fn locked(
        &self,
        lock: impl Fn(&File) -> Result<(), TryLockError>,
    ) -> Result<Option<File>, RunDirError> {
        let path = self.0.join("lock");
        let failed = |source| RunDirError::Io { path: path.clone(), source };
        let mut anew = OpenOptions::new();
        anew.read(true).write(true).create(true).truncate(false).mode(0o600);
        let file = match anew.open(&path) {
            Err(error) if error.kind() == io::ErrorKind::ReadOnlyFilesystem => File::open(&path),
            opened => opened,
        };
        let file = file.map_err(failed)?;
        match lock(&file) {
            Ok(()) => Ok(Some(file)),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(source)) => Err(failed(source)),
        }
    }

    fn read<T: DeserializeOwned>(&self, name: &str) -> Result<Option<T>, RunDirError> {
        let path = self.0.join(name);
        match std::fs::read(&path) {
            Ok(bytes) => serde_json::from_slice(&bytes)
                .map(Some)
                .map_err(|source| RunDirError::Malformed { path, source }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(source) => Err(RunDirError::Io { path, source }),
        }
    }

    fn write<T: Serialize>(&self, name: &str, value: &T) -> Result<(), RunDirError> {
        let path = self.0.join(name);
        let bytes = serde_json::to_vec(value)
            .map_err(|source| RunDirError::Malformed { path: path.clone(), source })?;
        durable::write(&path, &bytes, 0o600).map_err(|source| RunDirError::Io { path, source })
    }
}

#[cfg(test)]
mod tests {
    use nix::mount::{MsFlags, mount};

    use super::*;
    use crate::system::durable::own_mounts::with_own_mounts;

    #[test]
    fn run_on_a_read_only_disk_can_be_locked() {
        let temp = tempfile::tempdir().expect("temp dir");
        with_own_mounts(|| {
            let mounted =
                |flags| mount(Some("tmpfs"), temp.path(), Some("tmpfs"), flags, None::<&str>);
            mounted(MsFlags::empty()).expect("mounted");
            let dir = RunDir::create(&temp.path().join("run")).expect("create");
            drop(dir.try_lock().expect("locked").expect("nobody has it"));
            mounted(MsFlags::MS_REMOUNT | MsFlags::MS_RDONLY).expect("mounted anew");
            let held =
                RunDir::create(dir.path()).expect("it is there").try_lock_shared().expect("locked");
            assert!(dir.try_lock().expect("looked at").is_none());
            assert!(
                dir.try_lock_shared().expect("locked").is_some(),
                "readers do not wait for each other"
            );
            drop(held);
        });
    }

    #[test]
    fn run_files_read_back_and_have_the_documented_shape() {
        let temp = tempfile::tempdir().expect("temp dir");
        let dir = RunDir::create(&temp.path().join("run")).expect("create");
        assert_eq!(dir.ended().expect("read"), None);
        let ended =
            Ended { status: ExitStatus::Signal(9), at_uptime_ms: 77, out_of_memory_bytes: None };
        dir.write_ended(&ended).expect("write");
        assert_eq!(dir.ended().expect("read"), Some(ended));
        let text = std::fs::read_to_string(dir.path().join("exit.json")).expect("read");
        assert_eq!(text, r#"{"signal":9,"at_uptime_ms":77}"#);
    }

    #[test]
    fn damaged_file_is_named() {
        let temp = tempfile::tempdir().expect("temp dir");
        let dir = RunDir::create(temp.path()).expect("create");
        std::fs::write(dir.path().join("pid.json"), "{").expect("write");
        assert!(dir.started().expect_err("malformed").to_string().contains("pid.json"));
    }
}
