//! Builds a package with the build tool that its manifest names. The build runs in its own bash at
//! low priority, with limits on time, memory, processes and output, and leaves no processes behind.
//! Each build starts with empty `build` and `install` directories, so an interrupted build is
//! simply repeated.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File};
use std::io::{self, PipeReader, Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use task_proto::messages::report::FailureCode;
use task_proto::packages::manifest::BuildTool;
use task_proto::size::format_bytes;
use tokio_util::sync::CancellationToken;

use crate::process::cgroup::{Cgroups, RunLimits};
use crate::process::confinement::Confinement;
use crate::process::containment::{Containment, ContainmentError, KillOnDrop, RUN_DIR_VARIABLE};
use crate::process::program::{self, ExitStatus};
use crate::setup::script;
use crate::system::durable;
use crate::system::layout::VersionDir;
use crate::system::task_user::{self, TaskUser};
use crate::system::untrusted_file;

/// Longest time for the processes of a build to end.
const KILL_TIMEOUT: Duration = Duration::from_secs(10);
/// Longest time for the remaining output after the last known process of the build has ended.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(5);
/// Length of the output's tail in the text of a failure. A report cuts that text at 4096
/// characters.
const TAIL_BYTES: usize = 3500;
/// Added to the agent's niceness.
const NICE: i32 = 10;
/// Largest `package.xml` that is read.
const MAX_PACKAGE_XML_BYTES: u64 = 1024 * 1024;

/// A build: tool, place, environment and limits.
#[derive(Debug, Clone)]
pub struct BuildSpec {
    pub tool: BuildTool,
    /// The version's directory, with `src`; `build` and `install` are created there.
    pub version: VersionDir,
    /// Setup files that are sourced first.
    pub underlays: Vec<PathBuf>,
    /// The complete environment; the agent's own is not inherited.
    pub environment: BTreeMap<String, String>,
    /// Log file of the output. A new build replaces the log of an earlier one.
    pub log: PathBuf,
    /// Limits of the build.
    pub limits: BuildLimits,
    /// Account that the build runs as; `None` is the agent's own account.
    pub user: Option<TaskUser>,
    /// Parent of the build's control group.
    pub cgroups: Option<Cgroups>,
}

/// Limits of a build.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BuildLimits {
    pub timeout: Duration,
    /// Memory limit of the whole build; without a control group, the limit on the data of each
    /// process. `None` is unlimited.
    pub memory_bytes: Option<u64>,
    /// Most processes and threads.
    pub pids: Option<u64>,
    /// Whether to deny system calls that only an administrator needs.
    pub filter_calls: bool,
    /// Most bytes of output that the log keeps.
    pub log_bytes: u64,
}

/// Output of a build: the log file, and the tail in memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Output {
    pub log: PathBuf,
    /// The last bytes of the output.
    pub tail: String,
}

/// Reasons why a build has no result.
#[derive(Debug, thiserror::Error)]
pub enum BuildError {
    /// The caller cancelled the build.
    #[error("the build was cancelled")]
    Cancelled,
    /// The build exceeded its time limit.
    #[error("the build did not end within {} s; {output}", timeout.as_secs())]
    TimedOut {
        timeout: Duration,
        /// Output of the build.
        output: Output,
    },
    /// The build tool failed or is missing.
    #[error("the build {status}; {output}")]
    Failed {
        status: ExitStatus,
        /// Output of the build.
        output: Output,
    },
    /// The build exceeded its memory limit.
    #[error("the build exceeded the memory limit of {}; {output}", format_bytes(*limit_bytes))]
    OutOfMemory {
        limit_bytes: u64,
        /// Output of the build.
        output: Output,
    },
    /// The build tool succeeded, but the package is not installed.
    #[error("the build tool succeeded without installing {missing}; {output}")]
    NotInstalled {
        missing: String,
        /// Output of the build.
        output: Output,
    },
    /// Some processes of the build could not be ended.
    #[error(transparent)]
    Containment(#[from] ContainmentError),
    /// The disk or the operating system returned an error.
    #[error("cannot use {}", path.display())]
    Io {
        /// The path in use.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
}

impl BuildError {
    /// The failure code in a report. `None` for a cancelled build, which is not a failure.
    pub fn code(&self) -> Option<FailureCode> {
        match self {
            Self::Cancelled => None,
            Self::TimedOut { .. } => Some(FailureCode::DEADLINE_EXCEEDED),
            Self::Failed { .. } | Self::NotInstalled { .. } => Some(FailureCode::BUILD_FAILED),
            Self::OutOfMemory { .. } => Some(FailureCode::OUT_OF_MEMORY),
            Self::Containment(_) | Self::Io { .. } => Some(FailureCode::IO_ERROR),
        }
    }
}

impl BuildLimits {
    /// Half an hour and three quarters of this machine's memory, so that a build alone can't drive
    /// a robot into the out-of-memory killer.
    pub fn of_this_machine() -> Self {
        let memory_bytes = program::total_memory_bytes().ok().map(|total| total / 4 * 3);
        Self {
            timeout: Duration::from_secs(30 * 60),
            memory_bytes,
            pids: None,
            filter_calls: false,
            log_bytes: 8 * 1024 * 1024,
        }
    }
}

impl std::fmt::Display for Output {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "the end of {}:\n{}", self.log.display(), self.tail)
    }
}

/// Builds `spec`; returns at once if the package needs no build. On return, all processes of the
/// build have ended and the installed files are on the disk.
pub async fn build(spec: &BuildSpec, cancel: &CancellationToken) -> Result<(), BuildError> {
    let Some(text) = script::build_script(spec.tool, &spec.version, &spec.underlays) else {
        return Ok(());
    };
    let root = spec.version.root();
    let cgroup = spec.cgroups.as_ref().map(|cgroups| cgroups.group(root).path().to_owned());
    let guard = KillOnDrop::new(Containment::new(root, None, cgroup));
    // If an agent was killed, its build is still running.
    guard.end(KILL_TIMEOUT).await?;
    prepare(spec, &text)?;
    let BuildRun { status, tail, out_of_memory } = run(spec, &guard, cancel).await?;
    let output =
        Output { log: spec.log.clone(), tail: String::from_utf8_lossy(&tail).trim().to_owned() };
    match (status, spec.limits.memory_bytes.filter(|_| out_of_memory)) {
        (Some(ExitStatus::Code(0)), _) => {}
        (Some(_), Some(limit)) => {
            return Err(BuildError::OutOfMemory { limit_bytes: limit, output });
        }
        (Some(status), None) => return Err(BuildError::Failed { status, output }),
        (None, _) if cancel.is_cancelled() => return Err(BuildError::Cancelled),
        (None, _) => return Err(BuildError::TimedOut { timeout: spec.limits.timeout, output }),
    }
    let version = spec.version.clone();
    let missing = task_user::do_as(spec.user.as_ref(), move || missing_package(&version))
        .await
        .map_err(failed(root))?;
    if let Some(missing) = missing {
        return Err(BuildError::NotInstalled { missing, output });
    }
    let version = spec.version.clone();
    let user = spec.user.clone();
    let finishing = tokio::task::spawn_blocking(move || {
        // All accounts may run the built files, and none may change them.
        let trees =
            user.iter().flat_map(|user| build_outputs(&version).map(|tree| (tree, user.uid)));
        trees.into_iter().try_for_each(|(tree, uid)| task_user::return_to_root(&tree, uid))?;
        durable::sync_file_system(version.root())
    });
    finishing.await.unwrap_or_else(|error| Err(error.into())).map_err(failed(root))
}

/// Directories that a build writes.
fn build_outputs(version: &VersionDir) -> [PathBuf; 3] {
    [version.build(), version.install(), version.root().join("log")]
}

fn prepare(spec: &BuildSpec, script: &str) -> Result<(), BuildError> {
    let root = spec.version.root();
    for tree in build_outputs(&spec.version) {
        durable::remove_dir_all(&tree).map_err(failed(&tree))?;
        // The rest of the version is read-only for the build.
        spec.user.as_ref().map_or(Ok(()), |user| user.make_home(&tree)).map_err(failed(&tree))?;
    }
    if let Some(logs) = spec.log.parent() {
        durable::create_dir_all(logs).map_err(failed(logs))?;
    }
    let path = script_path(spec);
    durable::write(&path, script.as_bytes(), 0o755).map_err(failed(&path))?;
    spec.user.as_ref().map_or(Ok(()), |user| user.grant_entry(root)).map_err(failed(root))
}

fn script_path(spec: &BuildSpec) -> PathBuf {
    spec.version.root().join("build.sh")
}

/// Result of the build's process.
struct BuildRun {
    /// Exit status, or `None` if we ended the process.
    status: Option<ExitStatus>,
    /// The last bytes of the output.
    tail: Vec<u8>,
    out_of_memory: bool,
}

async fn run(
    spec: &BuildSpec,
    containment: &Containment,
    cancel: &CancellationToken,
) -> Result<BuildRun, BuildError> {
    let root = spec.version.root();
    let script = script_path(spec);
    let mut environment = spec.environment.clone();
    environment.insert(RUN_DIR_VARIABLE.to_owned(), root.display().to_string());
    let log = File::create(&spec.log).map_err(failed(&spec.log))?;
    let (reader, writer) = io::pipe().map_err(failed(&script))?;
    let BuildLimits { memory_bytes, pids, filter_calls, .. } = spec.limits;
    let limits = RunLimits { memory_bytes, cpu_weight: None, pids, filter_calls };
    let cgroup = spec.cgroups.as_ref().map(|cgroups| cgroups.create(root, &limits)).transpose();
    let cgroup = cgroup.map_err(failed(root))?;
    let confined = Confinement::new(&script, cgroup.as_ref(), &limits, spec.user.as_ref())
        .map_err(failed(&script))?;
    spec.user.as_ref().map_or(Ok(()), |user| user.chown(&writer)).map_err(failed(&script))?;
    let mut child = program::spawn_build(&script, root, &environment, NICE, confined, writer)
        .map_err(failed(&script))?;
    let log_bytes = spec.limits.log_bytes;
    let copying = tokio::task::spawn_blocking(move || copy_output(reader, log, log_bytes));
    let status = tokio::select! {
        status = child.wait() => Some(status.map_err(failed(&script))?),
        () = cancel.cancelled() => None,
        () = tokio::time::sleep(spec.limits.timeout) => None,
    };
    let status = status.map(ExitStatus::from);
    let out_of_memory = containment.is_out_of_memory();
    // The output ends with the last process that holds the pipe.
    containment.end(KILL_TIMEOUT).await?;
    let Ok(copied) = tokio::time::timeout(DRAIN_TIMEOUT, copying).await else {
        // A process that cleared its environment has escaped and holds the output open.
        return Ok(BuildRun {
            status,
            tail: b"a process of the build escaped and is still writing".to_vec(),
            out_of_memory,
        });
    };
    let tail = copied.map_err(|error| failed(&spec.log)(error.into()))?;
    Ok(BuildRun { status, tail, out_of_memory })
}

/// Copies the first `limit` bytes of `output` into `log`, reads `output` to its end, and returns
/// the last bytes.
fn copy_output(mut output: PipeReader, mut log: File, limit: u64) -> Vec<u8> {
    let mut room = limit;
    let mut tail = VecDeque::with_capacity(TAIL_BYTES);
    let mut buffer = vec![0; 16 * 1024];
    loop {
        let count = match output.read(&mut buffer) {
            Ok(0) => return tail.into(),
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(_) => return tail.into(),
        };
        let kept = count.min(usize::try_from(room).unwrap_or(usize::MAX));
        // On a full disk the build fails by itself. A failed write of the log must not fail the
        // build.
        room = if log.write_all(&buffer[..kept]).is_ok() { room - kept as u64 } else { 0 };
        tail.extend(&buffer[count.saturating_sub(TAIL_BYTES)..count]);
        tail.drain(..tail.len().saturating_sub(TAIL_BYTES));
    }
}

/// Returns the package that the build should have installed and did not. Build tools skip packages
/// that they don't recognise, and succeed. The build may have left links anywhere, so this check
/// runs under the build's own account.
fn missing_package(version: &VersionDir) -> Option<String> {
    let installed = version.install();
    if let Some(name) = package_name(&version.src().join("package.xml")) {
        let there = installed.join(&name).is_dir() || installed.join("share").join(&name).is_dir();
        return (!there).then(|| format!("install/{name}"));
    }
    let holds_package = |entry: fs::DirEntry| entry.path().is_dir();
    let any = fs::read_dir(&installed).is_ok_and(|entries| entries.flatten().any(holds_package));
    (!any)
        .then(|| "anything: the package has no package.xml that the build tool accepts".to_owned())
}

/// Reads the name in a `package.xml`. The push already checked the file, so searching for the
/// element is enough. The build may have replaced the file, so only a regular file is read.
fn package_name(path: &Path) -> Option<String> {
    let text = String::from_utf8(untrusted_file::read(path, MAX_PACKAGE_XML_BYTES).ok()?).ok()?;
    // Each piece after the first begins inside a comment.
    let mut pieces = text.split("<!--");
    let mut plain = pieces.next()?.to_owned();
    for piece in pieces {
        plain.push_str(piece.split_once("-->")?.1);
    }
    let (_, rest) = plain.split_once("<name>")?;
    let (name, _) = rest.split_once("</name>")?;
    let name = name.trim();
    let is_plain = !name.is_empty()
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"_-".contains(&byte));
    is_plain.then(|| name.to_owned())
}

fn failed(path: &Path) -> impl Fn(io::Error) -> BuildError {
    let path = path.to_owned();
    move |source| BuildError::Io { path: path.clone(), source }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_is_limited_and_the_tail_is_the_end() {
        let temp = tempfile::tempdir().unwrap();
        let path = temp.path().join("build.log");
        let (reader, mut writer) = io::pipe().unwrap();
        let writing = std::thread::spawn(move || {
            for line in 0..10_000 {
                writeln!(writer, "line {line}").unwrap();
            }
        });
        let tail = copy_output(reader, File::create(&path).unwrap(), 100);
        writing.join().unwrap();
        assert_eq!(fs::metadata(&path).unwrap().len(), 100);
        assert_eq!(tail.len(), TAIL_BYTES);
        assert!(tail.ends_with(b"line 9998\nline 9999\n"));
    }

    #[test]
    fn package_name_is_read_and_a_malformed_one_is_ignored() {
        let temp = tempfile::tempdir().unwrap();
        let path = temp.path().join("package.xml");
        fs::write(&path, "<package format=\"3\">\n  <name> talker </name></package>").unwrap();
        assert_eq!(package_name(&path).as_deref(), Some("talker"));
        fs::write(&path, "<name>../../etc</name>").unwrap();
        assert_eq!(package_name(&path), None);
    }
}
