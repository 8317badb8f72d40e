//! Starts runs, finds them again and ends them. All of its knowledge comes from the run directory:
//! a new agent sees the same state as the last one. The supervisor never restarts anything by
//! itself and never decides which tasks should run.
//!
//! ```text
//!   NeverStarted ── start ──▶ Running ── task ends ──▶ Exited
//!                                │ shim killed, or the machine rebooted
//!                                └──▶ Gone
//! ```

use std::io::{self, PipeReader};
use std::path::{Path, PathBuf};
use std::time::Duration;

use nix::sys::signal::Signal;
use tokio::io::AsyncReadExt as _;
use tokio::net::unix::pipe;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::process::cgroup::Cgroups;
use crate::process::containment::{
    ASSIGNMENT_VARIABLE, Containment, ContainmentError, RUN_DIR_VARIABLE, signal_each,
};
use crate::process::program;
use crate::process::program::{ExitStatus, ProcessIdentity};
use crate::process::run_dir::{RunDir, RunDirError, RunSpec, Started};
use crate::process::shim::Answer;
use crate::setup::launch::Interrupt;

/// Maximum time for a start, which consists of a fork, an exec and two small files.
const START_TIMEOUT: Duration = Duration::from_secs(20);
/// Interval between attempts to take a run's lock while its start is in progress.
const LOCK_PAUSE: Duration = Duration::from_millis(20);
/// Maximum time for killed processes to be gone.
const KILL_TIMEOUT: Duration = Duration::from_secs(10);
/// The longest answer a shim gives.
const MAX_ANSWER_BYTES: u64 = 64 * 1024;

/// Starts shims and reads the files that they leave on disk.
#[derive(Debug, Clone)]
pub struct Supervisor {
    program: PathBuf,
    cgroups: Option<Cgroups>,
}

/// State of a run, from its run directory and the process table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RunState {
    /// No run was ever started in the directory.
    NeverStarted,
    /// The run's shim lives.
    Running {
        /// The task's first process.
        pid: u32,
        /// Time since the first process was started.
        age: Duration,
    },
    /// The task ended and the shim recorded the exit status.
    Exited(ExitStatus),
    /// The kernel killed the task because it used more memory than its limit.
    OutOfMemory { limit_bytes: u64 },
    /// The run was started, but its exit status is unknown: its shim was killed, or the machine
    /// went down. None of its processes is left.
    Gone,
}

/// Progress of a start.
enum StartProgress {
    /// The run was started before.
    AlreadyRunning(Started),
    /// The shim writes the result of the start to this pipe.
    ShimStarted(PipeReader),
}

/// Errors of starting, observing or ending a run.
#[derive(Debug, thiserror::Error)]
pub enum SupervisorError {
    /// A file of the run directory failed.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
    /// The run directory holds an earlier run that has ended.
    #[error("{} belongs to a run that has ended; a start needs a directory of its own", .0.display())]
    Used(PathBuf),
    /// The shim refused, for this reason.
    #[error("the task was not started: {0}")]
    Refused(String),
    /// The shim gave no answer within its time.
    #[error("the task's shim did not answer within {} s", START_TIMEOUT.as_secs())]
    NoAnswer,
    /// The result of the start is not known yet.
    #[error("a start of the task is in progress or hangs")]
    Starting,
    /// Processes could not be found or ended.
    #[error(transparent)]
    Containment(#[from] ContainmentError),
    /// The system refused something.
    #[error("cannot {what}")]
    Io {
        /// The operation that failed.
        what: &'static str,
        source: io::Error,
    },
}

impl SupervisorError {
    /// Whether a file of the run directory exists and can't be parsed.
    pub fn is_malformed(&self) -> bool {
        matches!(self, Self::RunDir(RunDirError::Malformed { .. }))
    }
}

impl Supervisor {
    /// A supervisor that starts its shims as `program shim` and makes the control groups of its
    /// runs in `cgroups`.
    pub fn new(program: impl Into<PathBuf>, cgroups: Option<Cgroups>) -> Self {
        Self { program: program.into(), cgroups }
    }

    /// A supervisor that starts its shims from the running program, also after a newer version has
    /// replaced the program's file.
    pub fn of_this_program(cgroups: Option<Cgroups>) -> Self {
        Self::new("/proc/self/exe", cgroups)
    }

    /// Starts `spec` in the run directory at `path`. A run that already runs there stays as it is.
    /// From the moment the shim exists the run survives the caller: dropping this future cancels
    /// the start only before that moment. After [`SupervisorError::NoAnswer`] the run may or may
    /// not have started, and [`Self::observe`] tells which.
    pub async fn start(&self, path: &Path, spec: &RunSpec) -> Result<Started, SupervisorError> {
        let started = tokio::time::timeout(START_TIMEOUT, self.start_shim(path, spec));
        started.await.unwrap_or(Err(SupervisorError::NoAnswer))
    }

    async fn start_shim(&self, path: &Path, spec: &RunSpec) -> Result<Started, SupervisorError> {
        let program = self.program.clone();
        let cgroups = self.cgroups.clone();
        let path = path.to_owned();
        let mut spec = spec.clone();
        let (dir, lock) = with_lock(&path, START_TIMEOUT, |dir| Ok(dir.try_lock()?)).await?;
        let given_up = CancellationToken::new();
        let _when_dropped = given_up.clone().drop_guard();
        let progress = in_background("start the shim", move || {
            let started = dir.started()?;
            if started.is_some() || dir.has_begun() {
                let runs = dir.ended()?.is_none();
                let running = started.filter(|started| runs && started.shim.is_alive());
                return running
                    .map(StartProgress::AlreadyRunning)
                    .ok_or(SupervisorError::Used(path));
            }
            spec.environment.insert(ASSIGNMENT_VARIABLE.to_owned(), spec.assignment.to_string());
            spec.environment.insert(RUN_DIR_VARIABLE.to_owned(), dir.path().display().to_string());
            spec.cgroup =
                cgroups.as_ref().map(|cgroups| cgroups.group(dir.path()).path().to_owned());
            dir.write_spec(&spec)?;
            if let Some(cgroups) = cgroups {
                cgroups
                    .create(dir.path(), &spec.limits)
                    .map_err(failed("make the task's control group"))?;
            }
            // A caller that gave up and observes the run meanwhile finds the spec, and waits for
            // the lock.
            if given_up.is_cancelled() {
                return Err(SupervisorError::NoAnswer);
            }
            program::spawn_shim(&program, dir.path(), lock)
                .map(StartProgress::ShimStarted)
                .map_err(failed("start the shim"))
        });
        let answer = match progress.await? {
            StartProgress::AlreadyRunning(started) => return Ok(started),
            StartProgress::ShimStarted(answer) => answer,
        };
        let unread = failed("read the shim's answer");
        let answer = pipe::Receiver::from_owned_fd(answer.into()).map_err(&unread)?;
        let mut line = Vec::new();
        answer.take(MAX_ANSWER_BYTES).read_to_end(&mut line).await.map_err(&unread)?;
        match serde_json::from_slice(&line) {
            Ok(Answer::Started(started)) => Ok(started),
            Ok(Answer::Failed(reason)) => Err(SupervisorError::Refused(reason)),
            Err(_) => Err(SupervisorError::Refused("its shim ended without an answer".to_owned())),
        }
    }

    /// The state of the run at `path`. Waits for a start in progress. When the shim was killed,
    /// this call ends the processes that are left: their output is no longer read and their exit
    /// status could not be determined.
    pub async fn observe(&self, path: &Path) -> Result<RunState, SupervisorError> {
        self.observe_within(path, START_TIMEOUT).await
    }

    /// Like `observe`, but waits at most that long for a start in progress.
    pub async fn observe_within(
        &self,
        path: &Path,
        time_limit: Duration,
    ) -> Result<RunState, SupervisorError> {
        if !path.join("spec.json").exists() {
            return Ok(RunState::NeverStarted);
        }
        let (dir, started, cgroup) = read_within(path, time_limit).await?;
        let Some(started) = started else {
            // The shim died, or the machine went down, before the processes of the run were
            // recorded.
            Containment::new(dir.path(), None, cgroup).end(KILL_TIMEOUT).await?;
            return Ok(if dir.has_begun() { RunState::Gone } else { RunState::NeverStarted });
        };
        // The order matters: before it ends, a shim writes `exit.json` if it can.
        let shim_lives = started.shim.is_alive();
        if let Some(ended) = dir.ended()? {
            let killed =
                ended.out_of_memory_bytes.map(|limit_bytes| RunState::OutOfMemory { limit_bytes });
            return Ok(killed.unwrap_or(RunState::Exited(ended.status)));
        }
        if shim_lives {
            let age = started.task.age().map_err(failed("read the machine's uptime"))?;
            return Ok(RunState::Running { pid: started.task.pid, age });
        }
        Containment::new(dir.path(), None, cgroup).end(KILL_TIMEOUT).await?;
        Ok(RunState::Gone)
    }

    /// Resolves when the run at `path` does not run any more, at once if it does not run now. This
    /// call does not poll. Cancel-safe.
    pub async fn wait(&self, path: &Path) -> Result<RunState, SupervisorError> {
        loop {
            let observed = self.observe(path).await?;
            if !matches!(observed, RunState::Running { .. }) {
                return Ok(observed);
            }
            let Some(started) = read(path).await?.1 else { continue };
            if let Some(shim) = started.shim.open().map_err(failed("watch the shim"))? {
                shim.ended().await.map_err(failed("watch the shim"))?;
            }
        }
    }

    /// The current processes of the run at `path`.
    pub async fn pids(&self, path: &Path) -> Result<Vec<u32>, SupervisorError> {
        let (dir, started, cgroup) = read(path).await?;
        let containment = Containment::new(dir.path(), started.map(|started| started.shim), cgroup);
        let members = containment.in_background(Containment::members).await;
        let members = members.map_err(failed("look for the task's processes"))?;
        Ok(members.iter().map(|member| member.pid).collect())
    }

    /// Ends the run at `path`: SIGINT to the task's process group, or to its first process alone
    /// where its launcher wants that; `grace`; SIGTERM to all processes; `grace`; SIGKILL.
    /// Afterwards none of the run's processes is left, wherever they had hidden. Dropping the
    /// future leaves a run that may still be ending. Another call begins with SIGINT again; on a
    /// run that has ended, it only verifies that no process is left.
    pub async fn stop(&self, path: &Path, grace: Duration) -> Result<RunState, SupervisorError> {
        let mut observed = match self.observe(path).await {
            Err(SupervisorError::Starting) => {
                self.end_start(path).await?;
                self.observe(path).await?
            }
            observed => observed?,
        };
        if observed == RunState::NeverStarted && !path.exists() {
            return Ok(observed);
        }
        let (dir, started, cgroup) = read(path).await?;
        let containment = Containment::new(
            dir.path(),
            started.as_ref().map(|started| started.shim.clone()),
            cgroup,
        );
        if let (RunState::Running { .. }, Some(started)) = (&observed, &started) {
            observed = self.end_run(&dir, &containment, &started.task, grace).await?;
        }
        containment.end(KILL_TIMEOUT).await?;
        Ok(observed)
    }

    /// Kills all processes in the control group of a run whose start does not end: the start hangs
    /// before the task's own program, for example on a file system that does not answer. The shim
    /// then sees a task that has ended, and releases the lock.
    async fn end_start(&self, path: &Path) -> Result<(), SupervisorError> {
        let Some(cgroups) = self.cgroups.clone() else { return Err(SupervisorError::Starting) };
        let path = path.to_owned();
        in_background("end the start", move || {
            let group = cgroups.group(RunDir::create(&path)?.path());
            group.kill().map_err(failed("end the start"))
        })
        .await
    }

    async fn end_run(
        &self,
        dir: &RunDir,
        containment: &Containment,
        task: &ProcessIdentity,
        grace: Duration,
    ) -> Result<RunState, SupervisorError> {
        let path = dir.path();
        let signalled = failed("signal the task");
        match dir.spec()?.map(|spec| spec.interrupt).unwrap_or_default() {
            // The task's first process leads its group.
            Interrupt::Group => {
                let group = task.pid;
                containment.in_background(move |all| all.signal_group(group, Signal::SIGINT)).await
            }
            Interrupt::Leader => signal_each([task], Signal::SIGINT),
        }
        .map_err(&signalled)?;
        if let Ok(ended) = tokio::time::timeout(grace, self.wait(path)).await {
            return ended;
        }
        containment
            .in_background(|all| all.signal_all(Signal::SIGTERM))
            .await
            .map_err(&signalled)?;
        if let Ok(ended) = tokio::time::timeout(grace, self.wait(path)).await {
            return ended;
        }
        containment.end(KILL_TIMEOUT).await?;
        // The shim needs a moment to record the end. If the shim hangs, the run is over all the
        // same.
        tokio::time::timeout(KILL_TIMEOUT, self.wait(path)).await.unwrap_or(Ok(RunState::Gone))
    }
}

/// The run directory, its processes and its control group, once no start is in progress; an error
/// if a start never ends.
async fn read(path: &Path) -> Result<(RunDir, Option<Started>, Option<PathBuf>), SupervisorError> {
    read_within(path, START_TIMEOUT).await
}

async fn read_within(
    path: &Path,
    time_limit: Duration,
) -> Result<(RunDir, Option<Started>, Option<PathBuf>), SupervisorError> {
    let (dir, (started, spec)) = with_lock(path, time_limit, |dir| {
        let Some(_no_start_in_progress) = dir.try_lock_shared()? else { return Ok(None) };
        Ok(Some((dir.started()?, dir.spec()?)))
    })
    .await?;
    Ok((dir, started, spec.and_then(|spec| spec.cgroup)))
}

/// Runs `attempt` on the run directory once its lock is held. The lock is tried repeatedly, because
/// a thread that blocked on the lock of a hanging start would be lost forever.
async fn with_lock<T: Send + 'static>(
    path: &Path,
    time_limit: Duration,
    attempt: impl Fn(&RunDir) -> Result<Option<T>, SupervisorError> + Copy + Send + 'static,
) -> Result<(RunDir, T), SupervisorError> {
    let deadline = Instant::now() + time_limit;
    loop {
        let path = path.to_owned();
        let tried = in_background("read the run directory", move || {
            let dir = RunDir::create(&path)?;
            Ok(attempt(&dir)?.map(|found| (dir, found)))
        });
        match tried.await? {
            Some(found) => return Ok(found),
            None if Instant::now() >= deadline => return Err(SupervisorError::Starting),
            None => tokio::time::sleep(LOCK_PAUSE).await,
        }
    }
}

async fn in_background<T: Send + 'static>(
    what: &'static str,
    work: impl FnOnce() -> Result<T, SupervisorError> + Send + 'static,
) -> Result<T, SupervisorError> {
    tokio::task::spawn_blocking(work).await.map_err(|error| failed(what)(error.into()))?
}

fn failed(what: &'static str) -> impl Fn(io::Error) -> SupervisorError {
    move |source| SupervisorError::Io { what, source }
}
