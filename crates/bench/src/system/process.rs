//! Starts and ends child processes: no other module does. Each child is ended by its own pid when
//! its handle is dropped, and dies with this process even on SIGKILL. This module also reads a
//! process's resource usage from `/proc/<pid>`.
#![expect(clippy::disallowed_methods, reason = "this is where processes are started")]

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::signal::{Signal, kill, killpg};
use nix::sys::time::TimeVal;
use nix::sys::wait::{Id, WaitPidFlag, waitid};
use nix::unistd::Pid;
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

/// Kernel ticks per second in `/proc/<pid>/stat`: USER_HZ.
const TICKS_PER_SECOND: f64 = 100.0;
/// Time limit for a program that only prints an answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);
/// How long a program may take to end after SIGTERM before it is killed.
const END_TIMEOUT: Duration = Duration::from_secs(15);

/// Why a program is of no use.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// The program did not start.
    #[error("{program} can't be started")]
    Start { program: String, source: io::Error },
    /// The program is not at its expected path.
    #[error("{name} is not beside {}: build it (cargo build --release --bins) or give --{name} PATH", dir.display())]
    Missing { name: &'static str, dir: PathBuf },
    /// The program ended with a failure.
    #[error("{program} ended with {status}: {message}")]
    Failed {
        program: String,
        status: std::process::ExitStatus,
        /// The end of its stderr.
        message: String,
    },
    /// The program ran longer than its time limit.
    #[error("{program} did not end within {ANSWER_TIMEOUT:?}")]
    Late { program: String },
}

/// A program and its arguments, not started yet.
#[derive(Debug, Clone)]
pub struct Program {
    path: PathBuf,
    arguments: Vec<OsString>,
    environment: Vec<(String, String)>,
}

impl Program {
    /// A program of this name in the `PATH`, or a path.
    pub fn named(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into(), arguments: Vec::new(), environment: Vec::new() }
    }

    /// The workspace's program `name`: `given`, otherwise the one in this program's own directory.
    pub fn beside(name: &'static str, given: Option<&Path>) -> Result<Self, ProcessError> {
        if let Some(path) = given {
            return Ok(Self::named(path));
        }
        let own = std::env::current_exe()
            .map_err(|source| ProcessError::Start { program: name.to_owned(), source })?;
        let dir = own.parent().unwrap_or(Path::new(".")).to_owned();
        // An end-to-end test's program is one directory deeper.
        let path =
            [dir.join(name), dir.join("..").join(name)].into_iter().find(|path| path.is_file());
        path.map(Self::named).ok_or(ProcessError::Missing { name, dir })
    }

    #[must_use]
    pub fn args(mut self, arguments: impl IntoIterator<Item = impl AsRef<OsStr>>) -> Self {
        self.arguments.extend(arguments.into_iter().map(|argument| argument.as_ref().to_owned()));
        self
    }

    #[must_use]
    pub fn variable(mut self, name: &str, value: &str) -> Self {
        self.environment.push((name.to_owned(), value.to_owned()));
        self
    }

    /// The program started by `outer`, which gets its path and arguments after its own.
    #[must_use]
    pub fn within(self, outer: Program) -> Self {
        let inner = std::iter::once(self.path.into_os_string()).chain(self.arguments);
        let mut outer = outer.args(inner);
        outer.environment.extend(self.environment);
        outer
    }

    /// Runs the program to its end and returns its stdout on success.
    pub async fn output(&self) -> Result<String, ProcessError> {
        let running = self.command().stdout(Stdio::piped()).stderr(Stdio::piped()).output();
        let program = self.name();
        let output = match tokio::time::timeout(ANSWER_TIMEOUT, running).await {
            Ok(Ok(output)) => output,
            Ok(Err(source)) => return Err(ProcessError::Start { program, source }),
            Err(_) => return Err(ProcessError::Late { program }),
        };
        if output.status.success() {
            return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
        }
        let message = last_line(&String::from_utf8_lossy(&output.stderr));
        Err(ProcessError::Failed { program, status: output.status, message })
    }

    /// Starts the program; stdout and stderr go to `log`.
    pub fn start(&self, log: &Path) -> Result<Process, ProcessError> {
        self.spawn(|command| {
            let log = File::options().create(true).append(true).open(log)?;
            command.stdout(log.try_clone()?).stderr(log).spawn()
        })
    }

    /// Starts the program with pipes for stdin and stdout: one line, one message. Its stderr goes
    /// to `log`.
    pub fn converse(&self, log: &Path) -> Result<(Process, ChildStdin, ChildStdout), ProcessError> {
        let mut process = self.spawn(|command| {
            let log = File::options().create(true).append(true).open(log)?;
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log).spawn()
        })?;
        let pipes = process.child.stdin.take().zip(process.child.stdout.take());
        let missing = || ProcessError::Start {
            program: self.name(),
            source: io::ErrorKind::BrokenPipe.into(),
        };
        let (input, output) = pipes.ok_or_else(missing)?;
        Ok((process, input, output))
    }

    fn spawn(
        &self,
        start: impl FnOnce(&mut Command) -> io::Result<Child>,
    ) -> Result<Process, ProcessError> {
        let mut command = self.command();
        let child = start(&mut command)
            .map_err(|source| ProcessError::Start { program: self.name(), source })?;
        Ok(Process { child, name: self.name() })
    }

    fn command(&self) -> Command {
        let mut command = Command::new(&self.path);
        command.args(&self.arguments).stdin(Stdio::null()).kill_on_drop(true);
        command.envs(self.environment.iter().map(|(name, value)| (name, value)));
        // Ctrl-C must reach only this program, which ends its children in its own order.
        command.process_group(0);
        let parent = Pid::this();
        let die_with_parent = move || {
            nix::sys::prctl::set_pdeathsig(Signal::SIGKILL)?;
            // The parent may have ended before prctl took effect.
            if nix::unistd::getppid() == parent {
                Ok(())
            } else {
                Err(io::ErrorKind::BrokenPipe.into())
            }
        };
        // SAFETY: between fork and exec only prctl and getppid are called, which are
        // async-signal-safe; nothing is allocated (an error kind is none).
        unsafe { command.pre_exec(die_with_parent) };
        command
    }

    fn name(&self) -> String {
        self.path.display().to_string()
    }
}

/// Runs a program to its end in code that cannot await; returns whether the program succeeded.
pub fn run_now(path: &str, arguments: &[&str]) -> bool {
    let mut command = std::process::Command::new(path);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// Processor seconds of all children that have ended and were waited for, and of theirs.
pub fn ended_children_cpu_s() -> io::Result<f64> {
    let usage = getrusage(UsageWho::RUSAGE_CHILDREN)?;
    let seconds = |time: TimeVal| time.tv_sec() as f64 + time.tv_usec() as f64 / 1e6;
    Ok(seconds(usage.user_time()) + seconds(usage.system_time()))
}

/// A running program. Dropping the handle kills the whole process group: a server's workers outlive
/// its main process.
#[derive(Debug)]
pub struct Process {
    child: Child,
    name: String,
}

impl Process {
    /// The pid; `None` once the end of the process was noticed.
    pub fn pid(&self) -> Option<u32> {
        self.child.id()
    }

    /// How the process ended; `None` while the process runs.
    pub fn ended(&mut self) -> Option<String> {
        match self.child.try_wait() {
            Ok(None) => None,
            Ok(Some(status)) => Some(format!("{} ended with {status}", self.name)),
            Err(error) => Some(format!("{} is lost: {error}", self.name)),
        }
    }

    /// Sends a signal to the process itself. Returns false once its end was noticed.
    pub fn signal(&self, signal: Signal) -> bool {
        let pid = self.pid().and_then(|pid| i32::try_from(pid).ok());
        pid.is_some_and(|pid| kill(Pid::from_raw(pid), signal).is_ok())
    }

    /// Kills the process and its group at once, and waits for its end.
    pub async fn kill(mut self) {
        self.kill_group();
        let _ = self.child.kill().await;
    }

    /// Sends SIGTERM, and kills the process after a timeout.
    pub async fn end(mut self) {
        let pid = self.child.id().and_then(|pid| i32::try_from(pid).ok());
        if pid.is_some_and(|pid| kill(Pid::from_raw(pid), Signal::SIGTERM).is_ok()) {
            let _ = tokio::time::timeout(END_TIMEOUT, self.child.wait()).await;
        }
        self.kill_group();
        let _ = self.child.kill().await;
    }

    /// Kills the process group, unless the process was already reaped: until then the pid, and with
    /// it the process group id, cannot be reused.
    fn kill_group(&self) {
        if let Some(pid) = self.pid().and_then(|pid| i32::try_from(pid).ok()) {
            let _ = killpg(Pid::from_raw(pid), Signal::SIGKILL);
        }
    }

    /// Resource usage until now; zero once the process has ended.
    pub fn usage(&self) -> Usage {
        self.pid().and_then(Usage::of).unwrap_or_default()
    }

    /// Resource usage of the process and its children, for a server whose workers are processes.
    pub fn family_usage(&self) -> Usage {
        let Some(pid) = self.pid() else { return Usage::default() };
        let children =
            std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap_or_default();
        let children = children.split_whitespace().filter_map(|child| child.parse().ok());
        std::iter::once(pid)
            .chain(children)
            .filter_map(Usage::of)
            .fold(Usage::default(), Usage::plus)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill_group();
        // A directory that is removed next must not be written to any more. The exit status stays
        // for the runtime, which reaps the process.
        if let Some(pid) = self.pid().and_then(|pid| i32::try_from(pid).ok()) {
            let ended = WaitPidFlag::WEXITED | WaitPidFlag::WNOWAIT;
            let _ = waitid(Id::Pid(Pid::from_raw(pid)), ended);
        }
    }
}

/// Resources that a process has used, and holds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Usage {
    /// Seconds of processor time, all threads together, user and system.
    pub cpu_s: f64,
    /// Memory that is its own and no file's.
    pub anonymous_bytes: u64,
    /// Memory with mapped files.
    pub resident_bytes: u64,
}

impl Usage {
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            cpu_s: self.cpu_s + other.cpu_s,
            anonymous_bytes: self.anonymous_bytes + other.anonymous_bytes,
            resident_bytes: self.resident_bytes + other.resident_bytes,
        }
    }

    /// Of a process that lives.
    pub fn of(pid: u32) -> Option<Self> {
        let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
        let kilobytes = |name: &str| -> Option<u64> {
            let line = status.lines().find(|line| line.starts_with(name))?;
            line.split_whitespace().nth(1)?.parse().ok()
        };
        Some(Self {
            cpu_s: cpu_ticks(&stat)? as f64 / TICKS_PER_SECOND,
            anonymous_bytes: kilobytes("RssAnon:")? * 1024,
            resident_bytes: kilobytes("VmRSS:")? * 1024,
        })
    }
}

/// Fields 14 and 15 of `/proc/<pid>/stat`, counted after the name, which may hold anything.
fn cpu_ticks(stat: &str) -> Option<u64> {
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let field = |number: usize| -> Option<u64> { fields.get(number)?.parse().ok() };
    Some(field(11)? + field(12)?)
}

fn last_line(text: &str) -> String {
    text.trim_end().lines().next_back().unwrap_or("no output").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpu_time_is_found_behind_any_name() {
        let stat = "12 (a ) name) S 1 1 1 0 -1 4194304 9 0 0 0 250 17 0 0 20 0 1 0 5 6 7";
        assert_eq!(cpu_ticks(stat), Some(267));
        assert_eq!(cpu_ticks("12 (a"), None);
    }

    #[tokio::test]
    async fn nested_program_reports_its_failure() {
        let echo = Program::named("echo").args(["hello"]).variable("WORD", "x");
        assert_eq!(echo.within(Program::named("env")).output().await.expect("runs"), "hello\n");
        let failed =
            Program::named("sh").args(["-c", "echo this is why >&2; exit 3"]).output().await;
        assert!(failed.expect_err("fails").to_string().contains("this is why"));
        let missing = Program::named("/nonexistent/program").output().await.expect_err("missing");
        assert!(missing.to_string().contains("/nonexistent/program"), "{missing}");
    }

    #[tokio::test]
    async fn process_ends_and_its_usage_is_read() {
        let dir = tempfile::tempdir().expect("a directory");
        let process = Program::named("cat").converse(&dir.path().join("log")).expect("starts");
        let (process, _input, _output) = process;
        let pid = process.pid().expect("a pid");
        assert!(process.usage().resident_bytes > 0);
        process.end().await;
        assert_eq!(Usage::of(pid), None);
    }
}
