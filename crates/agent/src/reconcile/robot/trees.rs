//! The files of a version on the disk, and their owners. Unpacked and built trees belong to root
//! and are compared with their seal before each start. The working directory beside them belongs to
//! the task.

use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use task_proto::TaskName;
use task_proto::desired::PackageRef;
use task_proto::manifest::{BuildTool, TaskManifest};
use task_proto::report::{Failure, FailureCode};

use super::outcomes::{fetch_failure, later};
use super::{BUILT_MARKER, Robot};
use crate::install::fetch::FetchError;
use crate::install::seal::{Broken, Seal};
use crate::install::work_dir;
use crate::system::accounts::AccountPair;
use crate::system::disk::Need;
use crate::system::durable;
use crate::system::layout::VersionDir;
use crate::system::task_user::{self, TaskUser};
use crate::task::plan::{Done, StepFailure};

/// Why a version cannot be started or built.
#[derive(Debug, thiserror::Error)]
enum Unfit {
    #[error(
        "what is on the disk of this version was changed: {0}; it was deleted, to be fetched and built anew"
    )]
    Changed(Broken),
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
        let base =
            self.task_user.as_ref().map_err(|error| later(FailureCode::NO_TASK_USER, error, 0))?;
        let pair = base.as_ref().map(|base| self.accounts.of(task, base)).transpose();
        pair.map_err(|error| later(FailureCode::IO_ERROR, &error, 0))
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
        let (trees, protects) = (self.trees(package, tool), self.protects());
        fit(self.data.root(), move || if protects { trees.note() } else { trees.forget_seal() })
            .await
    }

    /// Seals the version after a pull. A pull that was put off has left no files.
    pub(super) async fn seal_pulled(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        done: Done,
    ) -> Result<Done, StepFailure> {
        if done == Done::Well {
            self.seal(package, manifest.build.tool).await?;
        }
        Ok(done)
    }

    /// Verifies that the unpacked files and, for a start, the built files of this version are
    /// unchanged. A changed version is deleted.
    pub(super) async fn verify(
        &self,
        package: &PackageRef,
        tool: BuildTool,
        purpose: Purpose,
    ) -> Result<(), StepFailure> {
        let (trees, protects) = (self.trees(package, tool), self.protects());
        fit(
            self.data.root(),
            move || if protects { trees.verify(purpose) } else { trees.forget_seal() },
        )
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
            user.as_ref().map_or(Ok(()), |user| user.admit(version.root()))?;
            Ok(work_dir::refresh(tool, &version, user.as_ref())?)
        };
        fit(self.data.root(), made).await
    }

    /// The directory that a run of this version wrote to, and the user of that run. Earlier agents
    /// let tasks run among their package's own files.
    pub(super) fn written_in(
        &self,
        package: &PackageRef,
        tool: BuildTool,
    ) -> Result<(PathBuf, Option<TaskUser>), StepFailure> {
        let trees = self.trees(package, tool);
        if trees.version.work().is_dir() && trees.is_the_agents() {
            return Ok((
                trees.version.work(),
                self.accounts_of(&package.name)?.map(|pair| pair.run),
            ));
        }
        let user =
            self.task_user.clone().map_err(|error| later(FailureCode::NO_TASK_USER, &error, 0))?;
        Ok((trees.former_work_dir(), user))
    }

    /// Whether tasks run as users of their own, so that their program files can be protected from
    /// them.
    pub(super) fn protects(&self) -> bool {
        matches!(self.task_user, Ok(Some(_)))
    }
}

impl Trees {
    fn note(&self) -> Result<(), Unfit> {
        Ok(Seal::of(&self.version)?.write(&self.seal)?)
    }

    /// Deletes the seal. Trees that a task may change are not sealed: Python alone writes its
    /// caches there.
    fn forget_seal(&self) -> Result<(), Unfit> {
        Ok(durable::remove_file(&self.seal)?)
    }

    fn verify(&self, purpose: Purpose) -> Result<(), Unfit> {
        if !self.is_the_agents() {
            self.adopt()?;
        }
        let broken = match Seal::read(&self.seal)? {
            // The version was unpacked before seals existed, or a moment ago by an agent that ended
            // before sealing.
            None if self.version.src().is_dir() => return self.note(),
            None | Some(Err(_)) => Some(Broken::Source),
            Some(Ok(seal)) => seal.broken(&self.version)?,
        };
        // A build begins with the leftovers of an interrupted build.
        let matters = |broken: &Broken| purpose == Purpose::Start || *broken == Broken::Source;
        let Some(broken) = broken.filter(matters) else { return Ok(()) };
        // The seal goes last: until then no remaining file is taken for intact.
        durable::remove_file(&self.version.root().join(BUILT_MARKER))?;
        durable::remove_dir_all(&self.version.install())?;
        durable::remove_dir_all(&self.version.src())?;
        durable::remove_file(&self.seal)?;
        Err(Unfit::Changed(broken))
    }

    /// Takes over trees that an earlier agent had given to the account of all tasks, including the
    /// files that the task wrote there.
    fn adopt(&self) -> Result<(), Unfit> {
        let owner = std::fs::symlink_metadata(self.version.root())?.uid();
        let since = work_dir::handed_over(&self.version)?;
        task_user::take_back(self.version.root(), owner)?;
        Ok(work_dir::move_written(self.tool, &self.version, since)?)
    }

    fn is_the_agents(&self) -> bool {
        let own = nix::unistd::geteuid().as_raw();
        std::fs::symlink_metadata(self.version.root()).is_ok_and(|about| about.uid() == own)
    }

    fn former_work_dir(&self) -> PathBuf {
        match self.tool {
            BuildTool::None => self.version.src(),
            BuildTool::Colcon | BuildTool::Catkin => self.version.root().to_owned(),
        }
    }
}

/// Does blocking work on the disk that holds `root`.
async fn fit(
    root: &Path,
    work: impl FnOnce() -> Result<(), Unfit> + Send + 'static,
) -> Result<(), StepFailure> {
    use io::ErrorKind::{QuotaExceeded, StorageFull};
    let done =
        tokio::task::spawn_blocking(work).await.map_err(|error| Unfit::Io(error.into())).flatten();
    done.map_err(|unfit| match unfit {
        Unfit::Changed(_) => {
            let failure = Failure::new(FailureCode::TREE_CHANGED, unfit.to_string());
            StepFailure { failure, retry_after_ms: Some(0) }
        }
        Unfit::Io(error) if matches!(error.kind(), StorageFull | QuotaExceeded) => {
            fetch_failure(FetchError::disk(root, error).for_want_of_room(root, Need::of_file(0)))
        }
        Unfit::Io(error) => later(FailureCode::IO_ERROR, &error, 0),
    })
}
