//! Builds a package with the build tool its manifest names: in a bash of its own, out of the way of
//! everything else, within limits of time, memory, processes and output, and gone without a trace
//! of processes when it ends. A build begins with empty `build` and `install` directories, so one
//! that was interrupted is simply done again.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File};
use std::io::{self, PipeReader, Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use task_proto::manifest::BuildTool;
use task_proto::report::FailureCode;
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

/// How long the processes of a build may take to be gone.
const KILL_TIMEOUT: Duration = Duration::from_secs(10);
/// How long the rest of the output may take once no known process of the build is left.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(5);
/// The end of the output that goes into a failure's text, which a report cuts at 4096 characters.
const TAIL_BYTES: usize = 3500;
/// Added to the agent's niceness.
const NICE: i32 = 10;
/// The longest `package.xml` that is looked at.
const MAX_PACKAGE_XML_BYTES: u64 = 1024 * 1024;

/// What to build, and with what.
#[derive(Debug, Clone)]
pub struct BuildOrder {
    /// The build tool.
    pub tool: BuildTool,
    /// Where `src` is and `build` and `install` go.
    pub version: VersionDir,
    /// The setup files to source first.
    pub underlays: Vec<PathBuf>,
    /// The whole environment.
    pub environment: BTreeMap<String, String>,
    /// Where the output goes; what an earlier build wrote there is replaced.
    pub log: PathBuf,
    /// What it may use.
    pub limits: BuildLimits,
    /// Whom it runs as; `None`: whoever the agent is.
    pub user: Option<TaskUser>,
    /// Where it gets its control group.
    pub cgroups: Option<Cgroups>,
}

/// What a build may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BuildLimits {
    /// The time it may take.
    pub timeout: Duration,
    /// The memory all of it may have; without a control group the data that each of its processes
    /// may have. `None` does not limit it.
    pub memory_bytes: Option<u64>,
    /// The processes and threads it may have.
    pub pids: Option<u64>,
    /// Whether system calls are denied that only an administrator needs.
    pub filter_calls: bool,
    /// The output that is kept.
    pub log_bytes: u64,
}

/// What a build said: all that was kept is in a file, its end is here.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Output {
    /// The file.
    pub log: PathBuf,
    /// The end of it.
    pub tail: String,
}

/// Why there is no build.
#[derive(Debug, thiserror::Error)]
pub enum BuildError {
    /// The caller no longer wanted it.
    #[error("the build was cancelled")]
    Cancelled,
    /// It took too long.
    #[error("the build did not end within {} s; {output}", timeout.as_secs())]
    TimedOut {
        /// The time it had.
        timeout: Duration,
        /// What it said.
        output: Output,
    },
    /// The build tool failed, or is not there.
    #[error("the build {status}; {output}")]
    Failed {
        /// How it ended.
        status: ExitStatus,
        /// What it said.
        output: Output,
    },
    /// It used more memory than it may.
    #[error("the build used more than the {limit_mb} MiB of memory it may; {output}")]
    OutOfMemory {
        /// What it may use.
        limit_mb: u64,
        /// What it said.
        output: Output,
    },
    /// The build tool was content, but the package is not there.
    #[error("the build tool succeeded without installing {missing}; {output}")]
    NotInstalled {
        /// What should be there.
        missing: String,
        /// What it said.
        output: Output,
    },
    /// Processes of the build could not be ended.
    #[error(transparent)]
    Containment(#[from] ContainmentError),
    /// The disk or the system refused something.
    #[error("cannot use {}", path.display())]
    Io {
        /// On what.
        path: PathBuf,
        /// What it said.
        source: io::Error,
    },
}

impl BuildError {
    /// The code that a report gives; `None` for a build that was cancelled, which is no failure.
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
    /// Half an hour, and three quarters of this machine's memory, so that a build alone can't drive
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

/// Builds `order`; at once done when there is nothing to build. When it returns, no process of the
/// build is left and what was installed is on the disk.
pub async fn build(order: &BuildOrder, cancel: &CancellationToken) -> Result<(), BuildError> {
    let Some(text) = script::build_script(order.tool, &order.version, &order.underlays) else {
        return Ok(());
    };
    let root = order.version.root();
    let cgroup = order.cgroups.as_ref().map(|cgroups| cgroups.group(root).path().to_owned());
    let guard = KillOnDrop::new(Containment::new(root, None, cgroup));
    // An agent that was killed leaves its build running.
    guard.end(KILL_TIMEOUT).await?;
    prepare(order, &text)?;
    let Ran { status, tail, out_of_memory } = run(order, &guard, cancel).await?;
    let output =
        Output { log: order.log.clone(), tail: String::from_utf8_lossy(&tail).trim().to_owned() };
    match (status, order.limits.memory_bytes.filter(|_| out_of_memory)) {
        (Some(ExitStatus::Code(0)), _) => {}
        (Some(_), Some(limit)) => {
            return Err(BuildError::OutOfMemory { limit_mb: limit >> 20, output });
        }
        (Some(status), None) => return Err(BuildError::Failed { status, output }),
        (None, _) if cancel.is_cancelled() => return Err(BuildError::Cancelled),
        (None, _) => return Err(BuildError::TimedOut { timeout: order.limits.timeout, output }),
    }
    let version = order.version.clone();
    let missing = task_user::do_as(order.user.as_ref(), move || missing_package(&version))
        .await
        .map_err(failed(root))?;
    if let Some(missing) = missing {
        return Err(BuildError::NotInstalled { missing, output });
    }
    let (version, user) = (order.version.clone(), order.user.clone());
    let finishing = tokio::task::spawn_blocking(move || {
        // What was built is for every account to run and for none to change.
        let made = user.iter().flat_map(|user| made(&version).map(|tree| (tree, user.uid)));
        made.into_iter().try_for_each(|(tree, uid)| task_user::take_back(&tree, uid))?;
        durable::sync_file_system(version.root())
    });
    finishing.await.unwrap_or_else(|error| Err(error.into())).map_err(failed(root))
}

/// What a build writes into.
fn made(version: &VersionDir) -> [PathBuf; 3] {
    [version.build(), version.install(), version.root().join("log")]
}

fn prepare(order: &BuildOrder, script: &str) -> Result<(), BuildError> {
    let root = order.version.root();
    for tree in made(&order.version) {
        durable::remove_dir_all(&tree).map_err(failed(&tree))?;
        // The rest of the version is read-only to its build.
        order.user.as_ref().map_or(Ok(()), |user| user.make_home(&tree)).map_err(failed(&tree))?;
    }
    if let Some(logs) = order.log.parent() {
        durable::create_dir_all(logs).map_err(failed(logs))?;
    }
    let path = script_path(order);
    durable::write(&path, script.as_bytes(), 0o755).map_err(failed(&path))?;
    order.user.as_ref().map_or(Ok(()), |user| user.admit(root)).map_err(failed(root))
}

fn script_path(order: &BuildOrder) -> PathBuf {
    order.version.root().join("build.sh")
}

/// What became of a build.
struct Ran {
    /// How it ended, or `None` when it was ended here.
    status: Option<ExitStatus>,
    /// The end of its output.
    tail: Vec<u8>,
    out_of_memory: bool,
}

async fn run(
    order: &BuildOrder,
    containment: &Containment,
    cancel: &CancellationToken,
) -> Result<Ran, BuildError> {
    let (root, script) = (order.version.root(), script_path(order));
    let mut environment = order.environment.clone();
    environment.insert(RUN_DIR_VARIABLE.to_owned(), root.display().to_string());
    let log = File::create(&order.log).map_err(failed(&order.log))?;
    let (reader, writer) = io::pipe().map_err(failed(&script))?;
    let BuildLimits { memory_bytes, pids, filter_calls, .. } = order.limits;
    let limits = RunLimits { memory_bytes, cpu_weight: None, pids, filter_calls };
    let cgroup = order.cgroups.as_ref().map(|cgroups| cgroups.create(root, &limits)).transpose();
    let cgroup = cgroup.map_err(failed(root))?;
    let confined = Confinement::new(&script, cgroup.as_ref(), &limits, order.user.as_ref())
        .map_err(failed(&script))?;
    order.user.as_ref().map_or(Ok(()), |user| user.own(&writer)).map_err(failed(&script))?;
    let mut child = program::spawn_build(&script, root, &environment, NICE, confined, writer)
        .map_err(failed(&script))?;
    let log_bytes = order.limits.log_bytes;
    let copying = tokio::task::spawn_blocking(move || copy_output(reader, log, log_bytes));
    let status = tokio::select! {
        status = child.wait() => Some(status.map_err(failed(&script))?),
        () = cancel.cancelled() => None,
        () = tokio::time::sleep(order.limits.timeout) => None,
    };
    let (status, out_of_memory) = (status.map(ExitStatus::from), containment.is_out_of_memory());
    // The output ends when the last process that could write any has.
    containment.end(KILL_TIMEOUT).await?;
    let Ok(copied) = tokio::time::timeout(DRAIN_TIMEOUT, copying).await else {
        // One that cleared its environment got away and holds the output open.
        return Ok(Ran {
            status,
            tail: b"a process of the build got away and still writes".to_vec(),
            out_of_memory,
        });
    };
    let tail = copied.map_err(|error| failed(&order.log)(error.into()))?;
    Ok(Ran { status, tail, out_of_memory })
}

/// Copies the first `limit` bytes of `output` into `log`, reads on to its end, and returns its last
/// bytes.
fn copy_output(mut output: PipeReader, mut log: File, limit: u64) -> Vec<u8> {
    let (mut room, mut tail) = (limit, VecDeque::with_capacity(TAIL_BYTES));
    let mut buffer = vec![0; 16 * 1024];
    loop {
        let count = match output.read(&mut buffer) {
            Ok(0) => return tail.into(),
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(_) => return tail.into(),
        };
        let kept = count.min(usize::try_from(room).unwrap_or(usize::MAX));
        // A full disk fails the build by itself; the log is not what it fails for.
        room = if log.write_all(&buffer[..kept]).is_ok() { room - kept as u64 } else { 0 };
        tail.extend(&buffer[count.saturating_sub(TAIL_BYTES)..count]);
        tail.drain(..tail.len().saturating_sub(TAIL_BYTES));
    }
}

/// The package that should have been installed and was not. Build tools skip what they don't
/// recognise and succeed. The build may have left links anywhere: only the account that it ran
/// under looks.
fn missing_package(version: &VersionDir) -> Option<String> {
    let installed = version.install();
    if let Some(name) = package_name(&version.src().join("package.xml")) {
        let there = installed.join(&name).is_dir() || installed.join("share").join(&name).is_dir();
        return (!there).then(|| format!("install/{name}"));
    }
    let holds_package = |entry: fs::DirEntry| entry.path().is_dir();
    let any = fs::read_dir(&installed).is_ok_and(|entries| entries.flatten().any(holds_package));
    (!any).then(|| {
        "anything: there is no package.xml in the package, or none the build tool accepts"
            .to_owned()
    })
}

/// The name in a `package.xml`. It was checked when the package was pushed, so looking for the
/// element is enough. The build may have put anything in its place: what is no plain file is not
/// read.
fn package_name(path: &Path) -> Option<String> {
    let text = String::from_utf8(untrusted_file::read(path, MAX_PACKAGE_XML_BYTES).ok()?).ok()?;
    // Each piece but the first begins in a comment.
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
    fn the_log_is_limited_and_the_tail_is_the_end() {
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
    fn a_package_name_is_read_and_an_odd_one_is_not_followed() {
        let temp = tempfile::tempdir().unwrap();
        let path = temp.path().join("package.xml");
        fs::write(&path, "<package format=\"3\">\n  <name> talker </name></package>").unwrap();
        assert_eq!(package_name(&path).as_deref(), Some("talker"));
        fs::write(&path, "<name>../../etc</name>").unwrap();
        assert_eq!(package_name(&path), None);
    }
}
