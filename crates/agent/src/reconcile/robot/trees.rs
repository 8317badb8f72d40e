//! The files of a version on the disk, and their owners. Unpacked and built trees belong to root
//! and are compared with their seal before each start. The working directory beside them belongs to
//! the task.

use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use task_proto::TaskName;
use task_proto::desired::PackageRef;
use task_proto::messages::report::{Failure, FailureCode};
use task_proto::packages::manifest::{BuildTool, TaskManifest};

use super::outcomes::{fetch_failure, retryable_failure};
use super::{BUILT_MARKER, Robot};
use crate::install::fetch::FetchError;
use crate::install::seal::{Seal, SealMismatch};
use crate::install::work_dir;
use crate::system::accounts::AccountPair;
use crate::system::disk::Need;
use crate::system::durable;
use crate::system::layout::VersionDir;
use crate::system::task_user::{self, TaskUser};
use crate::task::plan::{Done, StepFailure};

/// Why a version cannot be started or built.
#[derive(Debug, thiserror::Error)]
enum TreeError {
    #[error(
        "this version's files on the disk were changed: {0}; they were deleted and will be fetched and built again"
    )]
    Changed(SealMismatch),
    #[error(
        "this version's files on the disk are incomplete; they will be fetched and built again"
    )]
    Incomplete,
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// The purpose of a verification.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    /// The version is to be built.
    Build,
    /// The version is to be started.
    Start,
}

/// A version on the disk, and the path of its seal.
#[derive(Debug, Clone)]
struct Trees {
    version: VersionDir,
    seal: PathBuf,
    tool: BuildTool,
}

impl Robot {
    /// The accounts of a task; `None`: the task runs as the agent's user.
    pub(super) fn accounts_of(&self, task: &TaskName) -> Result<Option<AccountPair>, StepFailure> {
        let base = self
            .task_user
            .as_ref()
            .map_err(|error| retryable_failure(FailureCode::NO_TASK_USER, error, 0))?;
        let pair = base.as_ref().map(|base| self.accounts.of(task, base)).transpose();
        pair.map_err(|error| retryable_failure(FailureCode::IO_ERROR, &error, 0))
    }

    fn trees(&self, package: &PackageRef, tool: BuildTool) -> Trees {
        let seal = self.data.task(&package.name).seal(&package.manifest.digest);
        Trees { version: self.version(package), seal, tool }
    }

    /// Seals the files of this version, which were just unpacked or built.
    pub(super) async fn seal(
        &self,
        package: &PackageRef,
        tool: BuildTool,
    ) -> Result<(), StepFailure> {
        let trees = self.trees(package, tool);
        let protects_files = self.protects_files();
        run_blocking(self.data.root(), move || {
            if protects_files { trees.write_seal() } else { trees.forget_seal() }
        })
        .await
    }

    /// Seals the version after a pull. A pull that was put off has left no files.
    pub(super) async fn seal_pulled(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        done: Done,
    ) -> Result<Done, StepFailure> {
        if done == Done::Complete {
            self.seal(package, manifest.build.tool).await?;
        }
        Ok(done)
    }

    /// Verifies that the unpacked files and, for a start, the built files of this version are
    /// complete and unchanged. A changed version is deleted.
    pub(super) async fn verify(
        &self,
        package: &PackageRef,
        tool: BuildTool,
        purpose: Purpose,
    ) -> Result<(), StepFailure> {
        let trees = self.trees(package, tool);
        let protects_files = self.protects_files();
        run_blocking(self.data.root(), move || {
            if protects_files { trees.verify(purpose) } else { trees.forget_seal() }?;
            // An earlier fetch or build of the version may have been cut.
            let is_ready = purpose == Purpose::Build || is_built(&trees.version, tool);
            if is_ready { Ok(()) } else { Err(TreeError::Incomplete) }
        })
        .await
    }

    /// Makes the working directory of a version for `user`, and gives `user` access to the
    /// version's files.
    pub(super) async fn make_work_dir(
        &self,
        package: &PackageRef,
        tool: BuildTool,
        user: Option<TaskUser>,
    ) -> Result<(), StepFailure> {
        let version = self.version(package);
        let made = move || {
            user.as_ref().map_or(Ok(()), |user| user.grant_entry(version.root()))?;
            Ok(work_dir::refresh(tool, &version, user.as_ref())?)
        };
        run_blocking(self.data.root(), made).await
    }

    /// The directory that a run of this version wrote to, and the user of that run. Earlier agents
    /// let tasks run among their package's own files.
    pub(super) fn output_directory(
        &self,
        package: &PackageRef,
        tool: BuildTool,
    ) -> Result<(PathBuf, Option<TaskUser>), StepFailure> {
        let trees = self.trees(package, tool);
        if trees.version.work().is_dir() && trees.is_owned_by_agent() {
            return Ok((
                trees.version.work(),
                self.accounts_of(&package.name)?.map(|pair| pair.run),
            ));
        }
        let user = self
            .task_user
            .clone()
            .map_err(|error| retryable_failure(FailureCode::NO_TASK_USER, &error, 0))?;
        Ok((trees.legacy_work_dir(), user))
    }

    /// Whether tasks run as users of their own, so that their program files can be protected from
    /// them.
    pub(super) fn protects_files(&self) -> bool {
        matches!(self.task_user, Ok(Some(_)))
    }
}

impl Trees {
    fn write_seal(&self) -> Result<(), TreeError> {
        Ok(Seal::of(&self.version)?.write(&self.seal)?)
    }

    /// Deletes the seal. Trees that a task may change are not sealed: Python alone writes its
    /// caches there.
    fn forget_seal(&self) -> Result<(), TreeError> {
        Ok(durable::remove_file(&self.seal)?)
    }

    fn verify(&self, purpose: Purpose) -> Result<(), TreeError> {
        if !self.is_owned_by_agent() {
            self.adopt()?;
        }
        let mismatch = match Seal::read(&self.seal)? {
            // The version was unpacked before seals existed, or a moment ago by an agent that ended
            // before sealing.
            None if self.version.src().is_dir() => return self.write_seal(),
            None | Some(Err(_)) => Some(SealMismatch::Source),
            Some(Ok(seal)) => seal.mismatch(&self.version)?,
        };
        // A build begins with the leftovers of an interrupted build.
        let matters = |mismatch: &SealMismatch| {
            purpose == Purpose::Start || *mismatch == SealMismatch::Source
        };
        let Some(mismatch) = mismatch.filter(matters) else { return Ok(()) };
        // The seal goes last: until then no remaining file is taken for intact.
        durable::remove_file(&self.version.root().join(BUILT_MARKER))?;
        durable::remove_dir_all(&self.version.install())?;
        durable::remove_dir_all(&self.version.src())?;
        durable::remove_file(&self.seal)?;
        Err(TreeError::Changed(mismatch))
    }

    /// Takes over trees that an earlier agent had given to the account of all tasks, including the
    /// files that the task wrote there.
    fn adopt(&self) -> Result<(), TreeError> {
        let owner = std::fs::symlink_metadata(self.version.root())?.uid();
        let since = work_dir::handed_over(&self.version)?;
        task_user::return_to_root(self.version.root(), owner)?;
        Ok(work_dir::move_written(self.tool, &self.version, since)?)
    }

    fn is_owned_by_agent(&self) -> bool {
        let own = nix::unistd::geteuid().as_raw();
        std::fs::symlink_metadata(self.version.root()).is_ok_and(|about| about.uid() == own)
    }

    fn legacy_work_dir(&self) -> PathBuf {
        match self.tool {
            BuildTool::None => self.version.src(),
            BuildTool::Colcon | BuildTool::Catkin => self.version.root().to_owned(),
        }
    }
}

/// Whether the version is unpacked and, if `tool` builds it, built.
pub(super) fn is_built(version: &VersionDir, tool: BuildTool) -> bool {
    let has_marker = || version.root().join(BUILT_MARKER).exists();
    version.src().is_dir() && (tool == BuildTool::None || has_marker())
}

/// Does blocking work on the disk that holds `root`.
async fn run_blocking(
    root: &Path,
    work: impl FnOnce() -> Result<(), TreeError> + Send + 'static,
) -> Result<(), StepFailure> {
    use io::ErrorKind::{QuotaExceeded, StorageFull};
    let done = tokio::task::spawn_blocking(work)
        .await
        .map_err(|error| TreeError::Io(error.into()))
        .flatten();
    done.map_err(|unfit| match unfit {
        TreeError::Changed(_) | TreeError::Incomplete => {
            let failure = Failure::new(FailureCode::TREE_CHANGED, unfit.to_string());
            StepFailure { failure, retry_after_ms: Some(0) }
        }
        TreeError::Io(error) if matches!(error.kind(), StorageFull | QuotaExceeded) => {
            fetch_failure(FetchError::disk(root, error).or_disk_full(root, Need::of_file(0)))
        }
        TreeError::Io(error) => retryable_failure(FailureCode::IO_ERROR, &error, 0),
    })
}
