//! The run directory: where one start of a task is written down, by the supervisor before it and by
//! the shim during it. One directory is one start; it is never used again. It holds `spec.json`
//! (what to run), `begun` (it may run from now on), `pid.json` (who runs it), `exit.json` (how it
//! ended) and `lock` (held while the start is in progress). It never starts or signals a process.

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

/// One start of a task, by its directory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunDir(PathBuf);

/// What a shim runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunSpec {
    /// The deployment this run belongs to; every process of the task carries it as
    /// `TASKD_ASSIGNMENT`.
    pub assignment: DeploymentId,
    /// The generated script, run by bash.
    pub script: PathBuf,
    /// The directory it runs in.
    pub directory: PathBuf,
    /// The whole environment; nothing is inherited. The supervisor adds `TASKD_ASSIGNMENT` and
    /// `TASKD_RUN_DIR`.
    pub environment: BTreeMap<String, String>,
    /// Who gets the SIGINT of a stop.
    #[serde(default)]
    pub interrupt: Interrupt,
    /// Where the task's output goes.
    pub log: LogSpec,
    /// What it may use.
    #[serde(default)]
    pub limits: RunLimits,
    /// Whom it runs as; absent: whoever the agent is.
    #[serde(default)]
    pub user: Option<TaskUser>,
    /// Whether files in `directory` are to be brought back after the run.
    #[serde(default)]
    pub has_outputs: bool,
    /// The directory of its control group, if it has one. The supervisor makes it.
    #[serde(default)]
    pub cgroup: Option<PathBuf>,
}

/// The processes of a run that has begun.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Started {
    /// The shim.
    pub shim: ProcessIdentity,
    /// The task's first process, which leads its own process group.
    pub task: ProcessIdentity,
}

/// The end of a run. When this is on disk, none of the run's processes is left that the shim could
/// see and end, and what the run wrote for bringing back is on the disk as well.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ended {
    /// How the first process ended.
    #[serde(flatten)]
    pub status: ExitStatus,
    /// When: milliseconds since the machine booted, because a robot's clock may lie.
    pub at_uptime_ms: u64,
    /// The memory it was limited to, if it was killed for using more.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub out_of_memory_bytes: Option<u64>,
}

/// A file of the run directory that could not be used.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// Reading or writing it failed.
    #[error("cannot use {}", path.display())]
    Io {
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It is not what this version writes.
    #[error("{} is not readable as what it should be", path.display())]
    Malformed {
        /// Which file.
        path: PathBuf,
        /// What the parser said.
        source: serde_json::Error,
    },
}

impl RunDirError {
    /// Whether all that is missing is room.
    pub fn is_full(&self) -> bool {
        use io::ErrorKind::{QuotaExceeded, StorageFull};
        matches!(self, Self::Io { source, .. } if matches!(source.kind(), StorageFull | QuotaExceeded))
    }
}

impl RunDir {
    /// The run directory at `path`, created if absent. The path becomes absolute and free of links,
    /// because it is also the key by which the run's processes are found.
    pub fn create(path: &Path) -> Result<Self, RunDirError> {
        let failed = |source| RunDirError::Io { path: path.to_owned(), source };
        durable::create_dir_all(path).map_err(failed)?;
        Ok(Self(path.canonicalize().map_err(failed)?))
    }

    /// The run directory at `path`, as it is.
    pub fn at(path: &Path) -> Self {
        Self(path.to_owned())
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// What was to be run.
    pub fn spec(&self) -> Result<Option<RunSpec>, RunDirError> {
        self.read("spec.json")
    }

    /// Who runs it.
    pub fn started(&self) -> Result<Option<Started>, RunDirError> {
        self.read("pid.json")
    }

    /// How it ended.
    pub fn ended(&self) -> Result<Option<Ended>, RunDirError> {
        self.read("exit.json")
    }

    /// Writes down what to run.
    pub fn write_spec(&self, spec: &RunSpec) -> Result<(), RunDirError> {
        self.write("spec.json", spec)
    }

    /// Writes down that it is about to be run: until it is known by whom, nobody can tell whether
    /// it was.
    pub fn write_begun(&self) -> Result<(), RunDirError> {
        let path = self.0.join("begun");
        durable::write(&path, b"", 0o600).map_err(|source| RunDirError::Io { path, source })
    }

    /// Takes that back, because nothing was run after all.
    pub fn forget_begun(&self) -> Result<(), RunDirError> {
        let path = self.0.join("begun");
        durable::remove_file(&path).map_err(|source| RunDirError::Io { path, source })
    }

    /// Whether it may have been run.
    pub fn has_begun(&self) -> bool {
        self.0.join("begun").exists()
    }

    /// Writes down who runs it.
    pub fn write_started(&self, started: &Started) -> Result<(), RunDirError> {
        self.write("pid.json", started)
    }

    /// Writes down how it ended.
    pub fn write_ended(&self, ended: &Ended) -> Result<(), RunDirError> {
        self.write("exit.json", ended)
    }

    /// Takes the start lock; `None` while a start is in progress. Nobody waits for it in here: a
    /// start may hang, and takes who waits with it. The lock goes with the file, also into a child
    /// that inherits it, so there is no moment at which a start is under way and the lock is free.
    /// Where nothing can be written any more, what runs can still be looked at and stopped.
    pub fn try_lock(&self) -> Result<Option<File>, RunDirError> {
        self.locked(File::try_lock)
    }

    /// The same for who only reads, beside others who do.
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
    fn a_run_on_a_disk_that_became_read_only_can_be_locked() {
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
    fn the_files_read_back_and_have_the_documented_shape() {
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
    fn a_damaged_file_is_named() {
        let temp = tempfile::tempdir().expect("temp dir");
        let dir = RunDir::create(temp.path()).expect("create");
        std::fs::write(dir.path().join("pid.json"), "{").expect("write");
        assert!(dir.started().expect_err("malformed").to_string().contains("pid.json"));
    }
}
