//! The process between agent and task: `task-agent shim --dir RUNDIR`. The shim starts the task,
//! owns its output, collects every orphan below itself and records how the task ended. It lives
//! exactly as long as its task, needs nothing from the agent after the start and never decides
//! anything: no restart, no stop.

use std::io::{self, PipeWriter, Write};
use std::path::Path;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde::{Deserialize, Serialize};
use task_proto::error_chain::chain;
use task_proto::time::millis;

use crate::logs::capture;
use crate::process::cgroup::Cgroup;
use crate::process::confinement::{self, Confinement};
use crate::process::containment::Containment;
use crate::process::program::ExitStatus;
use crate::process::program::{self, ChildEvent, ProcessIdentity};
use crate::process::run_dir::{Ended, RunDir, RunDirError, RunSpec, Started};
use crate::system::clock;
use crate::system::durable;

/// Time that leftover processes of a task have to end after SIGTERM.
const LEFTOVER_GRACE: Duration = Duration::from_secs(2);
/// Maximum time after SIGKILL; a process that still exists then hangs in the kernel.
const KILL_TIMEOUT: Duration = Duration::from_secs(10);
/// Number of attempts to write the exit record to a full disk, and the pause between two attempts:
/// an hour in all.
const MAX_WRITES: u32 = 720;
const DISK_FULL_PAUSE: Duration = Duration::from_secs(5);
/// Maximum time for the rest of the output once no process is left to write any.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(2);

/// The shim's answer to the supervisor: one JSON line on the shim's standard output.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Answer {
    /// The task was started; `pid.json` is on disk.
    Started(Started),
    /// The task was not started, and nothing is left of the attempt.
    Failed(String),
}

/// Errors of a shim.
#[derive(Debug, thiserror::Error)]
pub enum ShimError {
    /// A file of the run directory failed.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
    /// The directory has no `spec.json`.
    #[error("{0} has no spec.json")]
    NoSpec(String),
    /// The task's process could not be started.
    #[error("cannot start {script} in {directory}")]
    Start {
        /// Path of the script.
        script: String,
        /// Intended working directory of the script.
        directory: String,
        source: io::Error,
    },
    /// The system refused an operation that every process may do.
    #[error("cannot watch the task's processes")]
    Io(#[from] io::Error),
}

/// A started task and the end of its output.
struct Task {
    started: Started,
    containment: Containment,
    memory_bytes: Option<u64>,
    /// Whether the task wrote files that will be uploaded after the run.
    has_outputs: bool,
    drained: mpsc::Receiver<()>,
}

/// Runs the task of the run directory at `path` to its end. Call it before any other thread exists.
pub fn run(path: &Path) -> Result<(), ShimError> {
    confinement::protect_this_process();
    let dir = RunDir::create(path)?;
    let begun = program::become_shim().map_err(ShimError::Io).and_then(|()| begin(&dir));
    let answer = match &begun {
        Ok(task) => Answer::Started(task.started.clone()),
        Err(error) => Answer::Failed(chain(error)),
    };
    send_answer(&answer);
    program::close_standard_streams()?;
    let task = begun?;
    let status = wait_for_task(task.started.task.pid)?;
    // The exit status is known whatever happens to the leftover processes, so it is recorded in any
    // case.
    let _ = end_leftovers(&task.containment);
    // Output that is still unread after this belongs to a process that hangs in the kernel.
    let _ = task.drained.recv_timeout(DRAIN_TIMEOUT);
    let at_uptime_ms = millis(clock::uptime()?);
    let out_of_memory_bytes = task.memory_bytes.filter(|_| task.containment.is_out_of_memory());
    if task.has_outputs {
        // The agent uploads the files once it reads that the run ended, also after a power cut. The
        // run directory lies on the same file system, and no task can replace it.
        let _ = durable::sync_file_system(dir.path());
    }
    let ended = Ended { status, at_uptime_ms, out_of_memory_bytes };
    retry_while_disk_is_full(DISK_FULL_PAUSE, || dir.write_ended(&ended))?;
    // The next stop of this run or the next boot removes a group that stays here.
    let _ = task.containment.remove();
    Ok(())
}

/// Retries while the disk is full: the task may have filled the disk itself, and its exit status
/// must not be lost for that reason.
fn retry_while_disk_is_full(
    pause: Duration,
    mut write: impl FnMut() -> Result<(), RunDirError>,
) -> Result<(), RunDirError> {
    for _ in 1..MAX_WRITES {
        match write() {
            Err(error) if error.is_full() => std::thread::park_timeout(pause),
            written => return written,
        }
    }
    write()
}

fn begin(dir: &RunDir) -> Result<Task, ShimError> {
    let spec = dir.spec()?.ok_or_else(|| ShimError::NoSpec(dir.path().display().to_string()))?;
    let own = identity(std::process::id())?;
    let containment = Containment::new(dir.path(), Some(own.clone()), spec.cgroup.clone());
    let (output, writer) = io::pipe()?;
    let (errors, error_writer) = io::pipe()?;
    // A power cut may come before the run's processes are recorded on the disk, and a job must not
    // run twice.
    dir.write_begun()?;
    let pid = match start(&spec, writer, error_writer) {
        Ok(pid) => pid,
        Err(source) => {
            // If the file stays, the run counts as lost: a lost job is not run again.
            let _ = dir.remove_begun();
            let script = spec.script.display().to_string();
            let directory = spec.directory.display().to_string();
            return Err(ShimError::Start { script, directory, source });
        }
    };
    let (done, drained) = mpsc::channel();
    std::thread::spawn(move || {
        capture::copy(spec.log, output, errors);
        // The main thread no longer listens when it has given up on the rest.
        let _ = done.send(());
    });
    let written = identity(pid).and_then(|task| {
        let started = Started { shim: own.clone(), task };
        dir.write_started(&started).map_err(ShimError::RunDir).map(|()| started)
    });
    match written {
        Ok(started) => {
            let memory_bytes = spec.limits.memory_bytes;
            let has_outputs = spec.has_outputs;
            Ok(Task { started, containment, memory_bytes, has_outputs, drained })
        }
        Err(error) => {
            // A task that could not be found again must not run.
            let _ = end_leftovers(&containment);
            Err(error)
        }
    }
}

fn start(spec: &RunSpec, output: PipeWriter, errors: PipeWriter) -> io::Result<u32> {
    let cgroup = spec.cgroup.clone().map(Cgroup::at);
    if let Some(cgroup) = &cgroup {
        // If the move fails, the shim stays in the agent's group and ends together with the agent's
        // group.
        let _ = cgroup.enter_shims();
    }
    let confinement =
        Confinement::new(&spec.script, cgroup.as_ref(), &spec.limits, spec.user.as_ref())?;
    if let Some(user) = &spec.user {
        // A task may open its output by name, as `/dev/stdout`.
        user.chown(&output)?;
        user.chown(&errors)?;
    }
    program::spawn_task(
        &spec.script,
        &spec.directory,
        &spec.environment,
        confinement,
        output,
        errors,
    )
}

fn identity(pid: u32) -> Result<ProcessIdentity, ShimError> {
    ProcessIdentity::of(pid)?.ok_or_else(|| io::Error::from(io::ErrorKind::NotFound).into())
}

/// Ignores errors: the supervisor may be gone, and the task runs on all the same.
fn send_answer(answer: &Answer) {
    if let Ok(mut line) = serde_json::to_vec(answer) {
        line.push(b'\n');
        let mut output = io::stdout();
        let _ = output.write_all(&line).and_then(|()| output.flush());
    }
}

fn wait_for_task(task: u32) -> io::Result<ExitStatus> {
    loop {
        match program::next_child(None)? {
            ChildEvent::Ended(pid, status) if pid == task => return Ok(status),
            ChildEvent::NoChildren => {
                return Err(io::Error::other(
                    "another process collected the exit status of the task",
                ));
            }
            ChildEvent::Ended(..) | ChildEvent::TimedOut => {}
        }
    }
}

/// Ends the leftover processes of the task: SIGTERM first, then SIGKILL.
fn end_leftovers(containment: &Containment) -> io::Result<()> {
    if containment.members()?.is_empty() {
        return Ok(());
    }
    containment.signal_all(Signal::SIGTERM)?;
    // A stopped process does not see the SIGTERM before it continues.
    containment.signal_all(Signal::SIGCONT)?;
    if collect_until_empty(containment, LEFTOVER_GRACE)? {
        return Ok(());
    }
    containment.kill()?;
    collect_until_empty(containment, KILL_TIMEOUT).map(|_| ())
}

/// Collects children until the containment is empty; false when processes remain after `timeout`.
fn collect_until_empty(containment: &Containment, timeout: Duration) -> io::Result<bool> {
    let deadline = Instant::now() + timeout;
    loop {
        if containment.members()?.is_empty() {
            return Ok(true);
        }
        let rest = deadline.saturating_duration_since(Instant::now());
        match program::next_child(Some(rest))? {
            ChildEvent::Ended(..) => {}
            ChildEvent::NoChildren | ChildEvent::TimedOut => {
                return Ok(containment.members()?.is_empty());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exit_status_is_written_once_the_disk_has_space() {
        let refused =
            |kind: io::ErrorKind| RunDirError::Io { path: "exit.json".into(), source: kind.into() };
        let mut answers = vec![
            Ok(()),
            Err(refused(io::ErrorKind::StorageFull)),
            Err(refused(io::ErrorKind::QuotaExceeded)),
        ];
        retry_while_disk_is_full(Duration::ZERO, || answers.pop().expect("asked three times"))
            .expect("written");
        assert!(answers.is_empty());
        let mut count = 0;
        let never = retry_while_disk_is_full(Duration::ZERO, || {
            count += 1;
            Err(refused(if count == 2 {
                io::ErrorKind::PermissionDenied
            } else {
                io::ErrorKind::StorageFull
            }))
        });
        assert!(
            never.is_err() && count == 2,
            "an error other than a full disk is reported at once"
        );
    }
}
