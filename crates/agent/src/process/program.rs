//! Starts processes, signals them and identifies them again. This is the only module that calls
//! `fork`, `exec`, `kill` or `waitpid`, and the only one that reads `/proc/<pid>`. It never decides
//! which process should live.
//!
//! A pid alone identifies no process, because the kernel reuses pids. A [`ProcessIdentity`] is the
//! pid with the process's start time and the boot. Signals go through a pidfd that was checked
//! against this identity.

use std::collections::BTreeMap;
use std::ffi::CString;
use std::fs::File;
use std::io::{self, PipeReader, PipeWriter};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd};
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use nix::errno::Errno;
use nix::sys::prctl;
use nix::sys::resource::{Resource, setrlimit};
use nix::sys::signal::{SigHandler, SigSet, SigmaskHow, Signal};
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;
use serde::{Deserialize, Serialize};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use crate::process::confinement::Confinement;
use crate::system::clock;
use crate::system::untrusted_file;

pub mod environments;

/// Kernel ticks per second in `/proc/<pid>/stat`: USER_HZ, 100 on every architecture that Linux
/// runs ROS on.
const TICKS_PER_SECOND: u64 = 100;
/// Maximum number of bytes read of an environment. Linux starts no process with more than 6 MiB of
/// environment: a larger one was made up later.
const MAX_ENVIRONMENT_BYTES: u64 = 6 << 20;

/// Signals that process 1 forwards to the agent.
const PASSED_ON: [Signal; 6] = [
    Signal::SIGTERM,
    Signal::SIGINT,
    Signal::SIGHUP,
    Signal::SIGQUIT,
    Signal::SIGUSR1,
    Signal::SIGUSR2,
];

/// A process, distinguishable from every other process, also from a later one with the same pid.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ProcessIdentity {
    pub pid: u32,
    /// Start time of the process: clock ticks since boot.
    pub start_ticks: u64,
    /// The boot that the process belongs to.
    pub boot_id: String,
}

/// One line of the process table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProcessEntry {
    pub pid: u32,
    pub parent: u32,
    pub group: u32,
    /// Start time of the process: clock ticks since boot.
    pub start_ticks: u64,
    /// Whether the process has ended and only waits to be collected.
    pub is_zombie: bool,
}

/// A handle on one living process. The handle can never refer to another process.
#[derive(Debug)]
pub struct PidFd(OwnedFd);

/// How a task's first process ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ExitStatus {
    /// The process exited with this code.
    Code(i32),
    /// This signal killed the process.
    Signal(i32),
}

/// Result of waiting for a child of the caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChildEvent {
    /// This child ended and has been collected.
    Ended(u32, ExitStatus),
    /// The caller has no children.
    NoChildren,
    /// No child ended in time.
    TimedOut,
}

impl ProcessIdentity {
    /// The identity of the process that has `pid` now, if there is one.
    pub fn of(pid: u32) -> io::Result<Option<Self>> {
        let Some(entry) = ProcessEntry::of(pid)? else { return Ok(None) };
        Ok(Some(Self { pid, start_ticks: entry.start_ticks, boot_id: clock::boot_id()? }))
    }

    /// Whether the process still runs. A zombie does not.
    pub fn is_alive(&self) -> bool {
        let same = |entry: ProcessEntry| entry.start_ticks == self.start_ticks && !entry.is_zombie;
        self.is_of_this_boot() && ProcessEntry::of(self.pid).ok().flatten().is_some_and(same)
    }

    /// Whether the process was started since the machine booted.
    pub fn is_of_this_boot(&self) -> bool {
        clock::boot_id().is_ok_and(|boot_id| boot_id == self.boot_id)
    }

    /// Time since the process was started.
    pub fn age(&self) -> io::Result<Duration> {
        let started =
            Duration::from_millis(self.start_ticks.saturating_mul(1000 / TICKS_PER_SECOND));
        Ok(clock::uptime()?.saturating_sub(started))
    }

    /// A pidfd for the process; `None` when the process is gone. The identity is checked after the
    /// pidfd is taken, so the pidfd cannot belong to a later process.
    pub fn open(&self) -> io::Result<Option<PidFd>> {
        let Some(handle) = PidFd::open(self.pid)? else { return Ok(None) };
        Ok(self.is_alive().then_some(handle))
    }

    /// Sends `signal` to the process, if the process still exists.
    pub fn signal(&self, signal: Signal) -> io::Result<()> {
        self.open()?.map_or(Ok(()), |handle| handle.signal(signal))
    }
}

impl ProcessEntry {
    /// The entry of `pid`, if there is such a process.
    pub fn of(pid: u32) -> io::Result<Option<Self>> {
        match std::fs::read(format!("/proc/{pid}/stat")) {
            Ok(line) => Ok(Self::parse(pid, &line)),
            Err(error) if is_gone(&error) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The whole process table.
    pub fn all() -> io::Result<Vec<Self>> {
        let mut entries = Vec::new();
        for item in std::fs::read_dir("/proc")? {
            let name = item?.file_name();
            if let Some(pid) = name.to_str().and_then(|name| name.parse().ok()) {
                // A process that another user hides is not one of ours.
                entries.extend(Self::of(pid).ok().flatten());
            }
        }
        Ok(entries)
    }

    /// The command name may hold spaces and parentheses, so the fields are counted from the last
    /// `)`.
    fn parse(pid: u32, line: &[u8]) -> Option<Self> {
        let end = line.iter().rposition(|byte| *byte == b')')?;
        let fields: Vec<&str> =
            std::str::from_utf8(line.get(end + 1..)?).ok()?.split_ascii_whitespace().collect();
        Some(Self {
            pid,
            is_zombie: matches!(*fields.first()?, "Z" | "X"),
            parent: fields.get(1)?.parse().ok()?,
            group: fields.get(2)?.parse().ok()?,
            start_ticks: fields.get(19)?.parse().ok()?,
        })
    }

    /// The identity of the process in the boot `boot_id`.
    pub fn identity(&self, boot_id: &str) -> ProcessIdentity {
        ProcessIdentity {
            pid: self.pid,
            start_ticks: self.start_ticks,
            boot_id: boot_id.to_owned(),
        }
    }

    /// Value of the variable `name` in the environment that the process was started with. Also
    /// `None` where the environment can't be read. The call may never return, see [`environments`].
    pub fn variable(&self, name: &str) -> Option<String> {
        let environment = self.environment().ok()?;
        let mut entries = environment.split(|byte| *byte == 0);
        let value =
            entries.find_map(|entry| entry.strip_prefix(name.as_bytes())?.strip_prefix(b"="))?;
        String::from_utf8(value.to_vec()).ok()
    }

    /// Whether the process was started with `variable` (`NAME=value`) in its environment. False
    /// where the environment can't be read. The call may never return, see [`environments`].
    pub fn was_started_with(&self, variable: &str) -> bool {
        let environment = self.environment().unwrap_or_default();
        environment.split(|byte| *byte == 0).any(|entry| entry == variable.as_bytes())
    }

    /// The process itself can change the recorded address and size of its environment.
    fn environment(&self) -> io::Result<Vec<u8>> {
        untrusted_file::read(
            Path::new(&format!("/proc/{}/environ", self.pid)),
            MAX_ENVIRONMENT_BYTES,
        )
    }
}

impl PidFd {
    fn open(pid: u32) -> io::Result<Option<Self>> {
        // SAFETY: pidfd_open takes two integers and touches no memory of ours.
        let fd = unsafe { libc::syscall(libc::SYS_pidfd_open, pid as libc::pid_t, 0) };
        match Errno::result(fd) {
            // SAFETY: the kernel just returned this descriptor to us, and it has no other owner.
            // Descriptors fit an int.
            Ok(fd) => Ok(Some(Self(unsafe { OwnedFd::from_raw_fd(fd as RawFd) }))),
            // Kernels report EINVAL for a pid that belongs to a thread and leads no process.
            Err(Errno::ESRCH | Errno::EINVAL) => Ok(None),
            Err(errno) => Err(errno.into()),
        }
    }

    /// Sends `signal`; a process that has ended meanwhile is no error.
    pub fn signal(&self, signal: Signal) -> io::Result<()> {
        let fd = self.0.as_raw_fd();
        let no_info = std::ptr::null::<libc::siginfo_t>();
        // SAFETY: a null siginfo is allowed and means the same as kill(2); the descriptor is open
        // while `self` lives.
        let result = unsafe {
            libc::syscall(libc::SYS_pidfd_send_signal, fd, signal as libc::c_int, no_info, 0)
        };
        match Errno::result(result) {
            Ok(_) | Err(Errno::ESRCH) => Ok(()),
            Err(errno) => Err(errno.into()),
        }
    }

    /// Resolves when the process has ended. Cancel-safe.
    pub async fn ended(self) -> io::Result<()> {
        // SAFETY: the owned descriptor stays open and unchanged until the registration is dropped
        // with it.
        let registered = unsafe { AsyncFd::register_with_interest(self.0, Interest::READABLE)? };
        registered.readable().await.map(|_| ())
    }
}

/// Total memory of this machine, in bytes.
pub fn total_memory_bytes() -> io::Result<u64> {
    let text = std::fs::read_to_string("/proc/meminfo")?;
    let kibibytes = text
        .strip_prefix("MemTotal:")
        .and_then(|rest| rest.split_ascii_whitespace().next()?.parse().ok());
    kibibytes
        .map(|count: u64| count * 1024)
        .ok_or_else(|| io::Error::other("/proc/meminfo does not begin with a total"))
}

/// Starts `program shim --dir DIR` detached: in its own session and not as a child of the caller,
/// so that neither the caller's death nor a signal to the caller's process group reaches the shim.
/// `lock` becomes the shim's standard input and so stays locked until the shim releases it. The
/// shim's answer can be read from the returned pipe.
pub fn spawn_shim(program: &Path, dir: &Path, lock: File) -> io::Result<PipeReader> {
    let (reader, writer) = io::pipe()?;
    let mut command = command(program, &BTreeMap::new());
    command.arg0("task-agent").arg("shim").arg("--dir").arg(dir).current_dir("/");
    command.stdin(lock).stdout(writer).stderr(Stdio::null());
    let detach = || {
        nix::unistd::setsid()?;
        // SAFETY: between fork and exec there is one thread; the parent's branch only exits.
        match unsafe { nix::unistd::fork()? } {
            nix::unistd::ForkResult::Child => reset_for_exec(),
            // SAFETY: _exit is async-signal-safe and runs nothing of this process's clean-up.
            nix::unistd::ForkResult::Parent { .. } => unsafe { libc::_exit(0) },
        }
    };
    // SAFETY: `detach` only makes async-signal-safe system calls and allocates nothing.
    unsafe { command.pre_exec(detach) };
    // The intermediate child has ended already; collecting it does not block.
    command.spawn()?.wait()?;
    Ok(reader)
}

/// Starts a task's script under bash, confined, in its own process group, with exactly
/// `environment`. When the calling thread dies, and with it the reader of the task's output, the
/// task gets the signal that stops a ROS node cleanly.
pub fn spawn_task(
    script: &Path,
    directory: &Path,
    environment: &BTreeMap<String, String>,
    confinement: Confinement,
    output: PipeWriter,
    errors: PipeWriter,
) -> io::Result<u32> {
    let mut command = command(Path::new("/bin/bash"), environment);
    command.arg(script).process_group(0);
    command.stdin(Stdio::null()).stdout(output).stderr(errors);
    let directory = CString::new(directory.as_os_str().as_bytes())?;
    let parent = nix::unistd::getpid();
    let prepare = move || {
        reset_for_exec()?;
        confinement.enter()?;
        // The directory is entered with the task's rights: the task may have replaced it by a link
        // to a directory that only root may enter.
        nix::unistd::chdir(directory.as_c_str())?;
        // A change of user resets the parent-death signal, so the signal is set after the change.
        prctl::set_pdeathsig(Signal::SIGINT)?;
        // The parent died before the line above, so the signal would never be sent.
        if nix::unistd::getppid() == parent { Ok(()) } else { Err(Errno::ESRCH.into()) }
    };
    // SAFETY: `prepare` only makes async-signal-safe system calls and allocates nothing.
    unsafe { command.pre_exec(prepare) };
    Ok(command.spawn()?.id())
}

/// Starts a build script under bash, confined, in its own session, at a low priority (`nice`), so
/// that builds yield to more important processes.
pub fn spawn_build(
    script: &Path,
    directory: &Path,
    environment: &BTreeMap<String, String>,
    nice: i32,
    confinement: Confinement,
    output: PipeWriter,
) -> io::Result<tokio::process::Child> {
    let mut command = command(Path::new("/bin/bash"), environment);
    command.arg(script).current_dir(directory);
    command.stdin(Stdio::null()).stdout(output.try_clone()?).stderr(output);
    let prepare = move || {
        enter_session()?;
        // Niceness is optional: where the kernel refuses it, the build still runs. SAFETY: both
        // calls take integers only. The second is ioprio_set(this process, best effort, last).
        let _ = unsafe {
            libc::setpriority(libc::PRIO_PROCESS, 0, nice)
                | libc::syscall(libc::SYS_ioprio_set, 1, 0, (2 << 13) | 7) as libc::c_int
        };
        confinement.enter()
    };
    // SAFETY: `prepare` only makes async-signal-safe system calls and allocates nothing.
    unsafe { command.pre_exec(prepare) };
    tokio::process::Command::from(command).spawn()
}

/// Starts the robot's gate with exactly `environment`, in its own session.
pub fn spawn_gate(
    words: &[String],
    directory: &Path,
    environment: &BTreeMap<String, String>,
    output: PipeWriter,
) -> io::Result<tokio::process::Child> {
    let (program, arguments) = words.split_first().ok_or(io::ErrorKind::InvalidInput)?;
    let mut command = command(Path::new(program), environment);
    command.args(arguments).current_dir(directory);
    command.stdin(Stdio::null()).stdout(output.try_clone()?).stderr(output);
    // SAFETY: `enter_session` only makes async-signal-safe system calls and allocates nothing.
    unsafe { command.pre_exec(enter_session) };
    tokio::process::Command::from(command).spawn()
}

/// Starts `program graph`, confined, in its own session, `nice`, with at most `data_bytes` of
/// memory whatever its control group. The agent communicates with the program over its standard
/// input and output. The program ends when its standard input is closed.
pub fn spawn_graph(
    program: &Path,
    environment: &BTreeMap<String, String>,
    nice: i32,
    data_bytes: u64,
    confinement: Confinement,
) -> io::Result<tokio::process::Child> {
    let mut command = command(program, environment);
    command.arg0("task-agent").arg("graph").current_dir("/");
    command.stdin(Stdio::piped()).stdout(Stdio::piped());
    let prepare = move || {
        enter_session()?;
        // Niceness is optional: where the kernel refuses it, the program still runs. SAFETY: takes
        // integers only.
        let _ = unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, nice) };
        setrlimit(Resource::RLIMIT_DATA, data_bytes, data_bytes)?;
        setrlimit(Resource::RLIMIT_CORE, 0, 0)?;
        prctl::set_no_new_privs()?;
        confinement.enter()
    };
    // SAFETY: `prepare` only makes async-signal-safe system calls and allocates nothing.
    unsafe { command.pre_exec(prepare) };
    let mut command = tokio::process::Command::from(command);
    command.kill_on_drop(true).spawn()
}

/// Makes the caller the shim of the processes that it starts: orphans below the shim become its
/// children, signals meant for others do not end the shim, and [`next_child`] can wait for the end
/// of a child.
pub fn become_shim() -> io::Result<()> {
    // The process is already a session leader when `spawn_shim` started it.
    let _ = nix::unistd::setsid();
    let _ = prctl::set_name(c"taskd-shim");
    prctl::set_child_subreaper(true)?;
    for signal in [Signal::SIGHUP, Signal::SIGINT, Signal::SIGTERM, Signal::SIGPIPE] {
        // SAFETY: ignoring a signal installs no handler.
        unsafe { nix::sys::signal::signal(signal, SigHandler::SigIgn)? };
    }
    let mut blocked = SigSet::empty();
    blocked.add(Signal::SIGCHLD);
    Ok(nix::sys::signal::sigprocmask(SigmaskHow::SIG_BLOCK, Some(&blocked), None)?)
}

/// Collects orphans where the calling process is process 1, as in a container: orphans of its
/// namespace become its children, and no other process collects them. The program goes on in a
/// forked child (`None`). The original process stays behind: it collects every process that ends,
/// forwards signals to the child, and returns with the child's exit status. So the collection never
/// takes a wait away from the agent for a process that the agent has started. Call this function
/// before any other thread exists.
pub fn collect_orphans_as_init() -> io::Result<Option<ExitStatus>> {
    if std::process::id() != 1 {
        return Ok(None);
    }
    let mut signals = SigSet::empty();
    for signal in PASSED_ON.into_iter().chain([Signal::SIGCHLD]) {
        signals.add(signal);
    }
    // Process 1 receives no signal that it neither handles nor blocks.
    let before = signals.thread_swap_mask(SigmaskHow::SIG_BLOCK)?;
    // SAFETY: there is one thread, so the child may do whatever its parent might.
    match unsafe { nix::unistd::fork()? } {
        nix::unistd::ForkResult::Child => {
            before.thread_set_mask()?;
            Ok(None)
        }
        nix::unistd::ForkResult::Parent { child } => {
            collect_until_end_of(child, &signals).map(Some)
        }
    }
}

fn collect_until_end_of(child: Pid, signals: &SigSet) -> io::Result<ExitStatus> {
    loop {
        match waitpid(Pid::from_raw(-1), Some(WaitPidFlag::WNOHANG)) {
            Ok(WaitStatus::Exited(pid, code)) if pid == child => return Ok(ExitStatus::Code(code)),
            Ok(WaitStatus::Signaled(pid, signal, _)) if pid == child => {
                return Ok(ExitStatus::Signal(signal as i32));
            }
            Ok(WaitStatus::StillAlive) => {
                // SAFETY: all zeros is a siginfo.
                let mut told: libc::siginfo_t = unsafe { std::mem::zeroed() };
                // SAFETY: the set and the answer outlive the call.
                let number = unsafe { libc::sigwaitinfo(signals.as_ref(), &raw mut told) };
                // Signals from a terminal also reach the child directly.
                if let Ok(signal) = Signal::try_from(number)
                    && signal != Signal::SIGCHLD
                    && told.si_code != libc::SI_KERNEL
                {
                    let _ = nix::sys::signal::kill(child, signal);
                }
            }
            Ok(_) | Err(Errno::EINTR) => {}
            Err(errno) => return Err(errno.into()),
        }
    }
}

/// Replaces standard input and output by `/dev/null`, which releases the previous descriptors.
pub fn close_standard_streams() -> io::Result<()> {
    let null = File::options().read(true).write(true).open("/dev/null")?;
    nix::unistd::dup2_stdin(&null)?;
    nix::unistd::dup2_stdout(&null)?;
    Ok(())
}

/// Collects the next child that ends. SIGCHLD must be blocked, as [`become_shim`] leaves it.
pub fn next_child(timeout: Option<Duration>) -> io::Result<ChildEvent> {
    loop {
        match waitpid(Pid::from_raw(-1), Some(WaitPidFlag::WNOHANG)) {
            Ok(WaitStatus::Exited(pid, code)) => {
                return Ok(ChildEvent::Ended(number(pid), ExitStatus::Code(code)));
            }
            Ok(WaitStatus::Signaled(pid, signal, _)) => {
                return Ok(ChildEvent::Ended(number(pid), ExitStatus::Signal(signal as i32)));
            }
            Ok(WaitStatus::StillAlive) if !wait_for_sigchld(timeout)? => {
                return Ok(ChildEvent::TimedOut);
            }
            Ok(_) | Err(Errno::EINTR) => {}
            Err(Errno::ECHILD) => return Ok(ChildEvent::NoChildren),
            Err(errno) => return Err(errno.into()),
        }
    }
}

/// Waits until SIGCHLD is pending; false when `timeout` passed without one.
fn wait_for_sigchld(timeout: Option<Duration>) -> io::Result<bool> {
    let mut signals = SigSet::empty();
    signals.add(Signal::SIGCHLD);
    let limit = timeout.map(|timeout| libc::timespec {
        tv_sec: timeout.as_secs() as libc::time_t,
        tv_nsec: timeout.subsec_nanos() as libc::c_long,
    });
    let limit = limit.as_ref().map_or(std::ptr::null(), std::ptr::from_ref);
    // SAFETY: the set and the limit outlive the call, and a null siginfo or timeout is allowed.
    let result = unsafe { libc::sigtimedwait(signals.as_ref(), std::ptr::null_mut(), limit) };
    match Errno::result(result) {
        Ok(_) | Err(Errno::EINTR) => Ok(true),
        Err(Errno::EAGAIN) => Ok(false),
        Err(errno) => Err(errno.into()),
    }
}

#[expect(clippy::disallowed_methods, reason = "this module is where processes are started")]
fn command(program: &Path, environment: &BTreeMap<String, String>) -> std::process::Command {
    let mut command = std::process::Command::new(program);
    command.env_clear().envs(environment);
    command
}

/// Makes a child the leader of its own session and process group. An agent that was started by hand
/// has a terminal, and any process that shares the terminal could type there in the name of root.
fn enter_session() -> io::Result<()> {
    nix::unistd::setsid()?;
    reset_for_exec()
}

/// Gives a child the state that a login shell would give: default signal dispositions, no blocked
/// signals, no stray descriptors. SIGINT in particular is inherited as ignored from a shell's `&`,
/// and then a ROS node could not be stopped with SIGINT.
fn reset_for_exec() -> io::Result<()> {
    for signal in Signal::iterator() {
        if !matches!(signal, Signal::SIGKILL | Signal::SIGSTOP) {
            // SAFETY: the default disposition installs no handler.
            unsafe { nix::sys::signal::signal(signal, SigHandler::SigDfl)? };
        }
    }
    nix::sys::signal::sigprocmask(SigmaskHow::SIG_SETMASK, Some(&SigSet::empty()), None)?;
    // SAFETY: takes integers only. The descriptors stay open for `Command`'s own error pipe and
    // close at exec.
    let _ = unsafe {
        libc::syscall(libc::SYS_close_range, 3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC)
    };
    Ok(())
}

fn is_gone(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::NotFound || error.raw_os_error() == Some(libc::ESRCH)
}

fn number(pid: Pid) -> u32 {
    pid.as_raw().unsigned_abs()
}

impl AsFd for PidFd {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl ExitStatus {
    /// The exit code as a shell reports it: 128 plus the signal's number for a signal.
    pub fn as_shell_code(self) -> u8 {
        let code = match self {
            Self::Code(code) => code,
            Self::Signal(signal) => 128 + signal,
        };
        u8::try_from(code).unwrap_or(u8::MAX)
    }
}

impl From<std::process::ExitStatus> for ExitStatus {
    fn from(status: std::process::ExitStatus) -> Self {
        // A process that was waited for has either a code or a signal.
        status.code().map_or_else(|| Self::Signal(status.signal().unwrap_or_default()), Self::Code)
    }
}

impl std::fmt::Display for ExitStatus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Code(code) => write!(f, "exited with code {code}"),
            Self::Signal(signal) => match nix::sys::signal::Signal::try_from(*signal) {
                Ok(known) => write!(f, "killed by {known}"),
                Err(_) => write!(f, "killed by signal {signal}"),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identity_matches_this_process_but_not_an_earlier_one() {
        let own = ProcessIdentity::of(std::process::id()).expect("stat").expect("alive");
        assert!(own.is_alive());
        assert!(own.open().expect("pidfd").is_some());
        let reused = ProcessIdentity { start_ticks: own.start_ticks - 1, ..own.clone() };
        assert!(!reused.is_alive() && reused.open().expect("pidfd").is_none());
        let other_boot = ProcessIdentity { boot_id: "another".to_owned(), ..own };
        assert!(!other_boot.is_alive());
    }

    #[test]
    fn command_name_may_look_like_fields() {
        let line = b"42 (a) R 1 (b) S 7 8 9 0 -1 0 0 0 0 0 0 0 0 0 20 0 1 0 12345 0 0";
        let entry = ProcessEntry::parse(42, line).expect("parsed");
        assert_eq!((entry.parent, entry.group, entry.start_ticks), (7, 8, 12345));
        assert_eq!(ProcessEntry::parse(42, b"42 (a"), None);
    }

    #[test]
    fn process_table_holds_this_process_with_its_environment() {
        let own = std::process::id();
        let entry = ProcessEntry::all()
            .expect("table")
            .into_iter()
            .find(|entry| entry.pid == own)
            .expect("listed");
        let path = std::env::var("PATH").expect("set");
        assert!(entry.was_started_with(&format!("PATH={path}")));
        assert!(!entry.was_started_with("PATH="));
        assert_eq!((entry.variable("PATH"), entry.variable("PAT")), (Some(path), None));
    }

    #[tokio::test]
    async fn build_and_the_gate_lead_sessions_of_their_own() {
        let temp = tempfile::tempdir().expect("a directory");
        let script = temp.path().join("script");
        // Process group and session.
        std::fs::write(&script, "read -r line < /proc/$$/stat; set -- $line; echo $$ $5 $6")
            .expect("written");
        let environment = BTreeMap::new();
        let (mut built, output) = io::pipe().expect("a pipe");
        let confinement =
            Confinement::new(&script, None, &Default::default(), None).expect("confined");
        let build = spawn_build(&script, temp.path(), &environment, 0, confinement, output);
        let (mut said, output) = io::pipe().expect("a pipe");
        let words = ["/bin/bash".to_owned(), script.display().to_string()];
        let gate = spawn_gate(&words, temp.path(), &environment, output);
        for (child, said) in [(build, &mut built), (gate, &mut said)] {
            let mut child = child.expect("started");
            let pid = child.id().expect("not collected yet");
            assert!(child.wait().await.expect("collected").success());
            assert_eq!(io::read_to_string(said).expect("read"), format!("{pid} {pid} {pid}\n"));
        }
    }

    /// The kernel's `prctl_mm_map`: the address ranges that a process claims for its memory areas.
    #[repr(C)]
    struct PrctlMmMap {
        code_data_and_heap: [u64; 6],
        stack: u64,
        arguments: [u64; 2],
        environment: [u64; 2],
        auxiliary: u64,
        auxiliary_bytes: u32,
        executable: u32,
    }

    #[test]
    fn oversized_environment_counts_as_foreign() {
        let mut memory = vec![0; 64 << 20];
        memory[..9].copy_from_slice(b"LIE=told\0");
        let start = memory.as_ptr() as u64;
        let claim = |bytes: u64| PrctlMmMap {
            code_data_and_heap: [start, start + 1, start, start + 1, start, start],
            stack: start,
            arguments: [start; 2],
            environment: [start, start + bytes],
            auxiliary: 0,
            auxiliary_bytes: 0,
            executable: u32::MAX,
        };
        for (bytes, is_read) in [(MAX_ENVIRONMENT_BYTES, true), (64 << 20, false)] {
            let (mut said, says) = io::pipe().expect("a pipe");
            let claim = claim(bytes);
            // SAFETY: the child only makes system calls.
            let child = match unsafe { nix::unistd::fork() }.expect("forked") {
                nix::unistd::ForkResult::Parent { child } => child,
                // SAFETY: the claim and the answer are copies that outlive the calls.
                nix::unistd::ForkResult::Child => unsafe {
                    let size = size_of::<PrctlMmMap>();
                    let refused = libc::prctl(
                        libc::PR_SET_MM,
                        libc::PR_SET_MM_MAP,
                        &raw const claim,
                        size,
                        0,
                    );
                    let answer = [u8::from(refused == 0)];
                    libc::write(says.as_raw_fd(), answer.as_ptr().cast(), 1);
                    loop {
                        libc::pause();
                    }
                },
            };
            let mut answer = [0];
            io::Read::read_exact(&mut said, &mut answer).expect("said");
            let entry = ProcessEntry::of(number(child)).expect("stat").expect("alive");
            let found = (entry.was_started_with("LIE=told"), entry.variable("LIE").is_some());
            nix::sys::signal::kill(child, Signal::SIGKILL).expect("killed");
            waitpid(child, None).expect("collected");
            if answer == [0] {
                return eprintln!(
                    "unavailable: this kernel lets no process say where its environment lies"
                );
            }
            assert_eq!(found, (is_read, is_read), "{bytes} bytes");
        }
    }
}
