//! Control groups, version 2: one for each run and each build. All processes of the run stay in its
//! group, share its limits and can be killed together. This module owns the choice of the place,
//! the limits' files and the removal; it never decides which processes may run. Where a machine has
//! no writable hierarchy, no groups are made and the caller does without them.
//!
//! ```text
//! <place>/taskd/            no processes of its own, so that its children can have limits
//! <place>/taskd/shims/      the shims of all runs, not ended with an agent
//! <place>/taskd/<key>/      one run or build
//! ```
//!
//! The place is the hierarchy's root for an agent that runs as root on the machine itself: there no
//! service manager's restart of the agent touches the groups. Any other agent has only the part of
//! the hierarchy that was delegated to it: the place is beside its own group, or else below it.

use std::fs::{self, File};
use std::io::{self, Write as _};
use std::os::fd::AsRawFd as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::unistd::{AccessFlags, access};
use serde::{Deserialize, Serialize};
use task_proto::Digest;

/// Directory that holds all groups.
const BASE: &str = "taskd";
/// Group of the shims.
const SHIMS: &str = "shims";
/// Group that an agent moves to when it must not be in the group that it divides.
const AGENT: &str = "taskd-agent";
/// The controllers that limits need.
const CONTROLLERS: [&str; 3] = ["cpu", "memory", "pids"];
/// Maximum attempts to make a directory that a concurrent removal keeps taking away.
const MAKE_TRIES: usize = 10;
/// Maximum number of groups below a run's group that are visited: a task may make some where it
/// runs as the agent's own user.
const MAX_NESTED: usize = 1000;
/// Maximum time for which a removal waits for the last process to be gone.
const REMOVE_TIMEOUT: Duration = Duration::from_secs(2);

/// Resource limits of one run; `None` means unlimited.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunLimits {
    /// Memory of all processes of the run together, without any swap.
    #[serde(default)]
    pub memory_bytes: Option<u64>,
    /// The run's share of the processors when they are scarce; 100 is the default of every group.
    #[serde(default)]
    pub cpu_weight: Option<u32>,
    /// Maximum number of processes and threads.
    #[serde(default)]
    pub pids: Option<u64>,
    /// Whether the system calls are denied that only an administrator needs.
    #[serde(default)]
    pub filter_calls: bool,
}

/// The directory in which groups are made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cgroups {
    base: PathBuf,
    isolates: bool,
}

/// The group of one run or build. The group may have been removed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cgroup(PathBuf);

impl Cgroups {
    /// The place that this process may use, if there is one. The place is tested by making and
    /// removing a group.
    pub fn find() -> Option<Self> {
        let mount = Mount::find(&fs::read_to_string("/proc/self/mountinfo").ok()?)?;
        let own = own_path(&fs::read_to_string("/proc/self/cgroup").ok()?)?;
        let on_machine = mount.is_whole() && nix::unistd::geteuid().is_root();
        let found: Vec<_> =
            mount.places(&own, on_machine).iter().filter_map(|place| Self::at(place)).collect();
        // A later place is better only if it isolates and an earlier one does not.
        let best = found.iter().find(|cgroups| cgroups.isolates).or(found.first());
        best.cloned()
    }

    /// The place below the group at `parent`, if groups can be made there and processes brought
    /// into them.
    fn at(parent: &Path) -> Option<Self> {
        access(&parent.join("cgroup.procs"), AccessFlags::W_OK).ok()?;
        let base = parent.join(BASE);
        let probe = format!("probe-{}", std::process::id());
        let tried = || {
            let group = make(&base, &probe)?;
            let isolates =
                ["memory.max", "pids.max"].iter().all(|file| group.0.join(file).exists());
            group.remove().map(|()| isolates)
        };
        let isolates = tried().ok()?;
        let isolates = isolates || (leave(parent) && tried().ok()?);
        Some(Self { base, isolates })
    }

    /// Whether runs can be given memory and process limits of their own. False where the hierarchy
    /// has no such controllers: such groups can end a run reliably, but keep no run from starving
    /// its neighbours.
    pub fn isolates(&self) -> bool {
        self.isolates
    }

    /// The group of the run or build with the directory `dir`; no other directory has the same
    /// group.
    pub fn group(&self, dir: &Path) -> Cgroup {
        Cgroup(self.base.join(name(dir)))
    }

    /// Makes that group. The limits apply as far as there are controllers for them.
    pub fn create(&self, dir: &Path, limits: &RunLimits) -> io::Result<Cgroup> {
        let group = make(&self.base, &name(dir))?;
        match group.limit(limits) {
            Ok(()) => Ok(group),
            Err(error) => {
                // The group is empty, and the caller needs the earlier error, not one from this
                // removal.
                let _ = group.remove();
                Err(error)
            }
        }
    }
}

impl Cgroup {
    /// The group in the directory `path`.
    pub fn at(path: PathBuf) -> Self {
        Self(path)
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The file by which a process enters the group: a process that writes `0` is added.
    pub fn entrance(&self) -> io::Result<File> {
        File::options().write(true).open(self.0.join("cgroup.procs"))
    }

    /// Moves the calling process to a group beside the run's group, so that ending runs or agents
    /// does not end it.
    pub fn enter_shims(&self) -> io::Result<()> {
        let base = self.0.parent().ok_or(io::ErrorKind::NotFound)?;
        make(base, SHIMS)?.entrance()?.write_all(b"0")
    }

    /// The processes in the group and in the groups below it; none if the group is gone.
    pub fn pids(&self) -> io::Result<Vec<u32>> {
        let mut pids = Vec::new();
        for dir in self.nested()? {
            match fs::read_to_string(dir.join("cgroup.procs")) {
                // A process that the caller may not see is listed as 0.
                Ok(text) => {
                    pids.extend(
                        text.lines()
                            .filter_map(|line| line.parse::<u32>().ok())
                            .filter(|pid| *pid != 0),
                    );
                }
                Err(error) if is_gone(&error) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(pids)
    }

    /// Kills all processes in the group, also those that are being forked right now. Kernels before
    /// 5.14 can't: nothing happens.
    pub fn kill(&self) -> io::Result<()> {
        match write(&self.0.join("cgroup.kill"), "1") {
            Err(error) if is_gone(&error) => Ok(()),
            killed => killed,
        }
    }

    /// Whether the kernel enforces a memory limit on the group.
    pub fn limits_memory(&self) -> bool {
        self.0.join("memory.max").exists()
    }

    /// Whether the kernel enforces a limit on the number of processes in the group.
    pub fn limits_pids(&self) -> bool {
        self.0.join("pids.max").exists()
    }

    /// Whether the kernel has killed processes of the group because memory ran out.
    pub fn is_out_of_memory(&self) -> bool {
        let events = fs::read_to_string(self.0.join("memory.events")).unwrap_or_default();
        events
            .lines()
            .filter_map(|line| line.strip_prefix("oom_kill "))
            .any(|count| count.trim() != "0")
    }

    /// Removes the group once its last process is gone, and its parent directories if they hold no
    /// other group. Succeeds if the group does not exist.
    pub fn remove(&self) -> io::Result<()> {
        let deadline = Instant::now() + REMOVE_TIMEOUT;
        for dir in self.nested()?.iter().rev() {
            loop {
                match fs::remove_dir(dir) {
                    Err(error)
                        if error.raw_os_error() == Some(libc::EBUSY)
                            && Instant::now() < deadline =>
                    {
                        wait_for_event(dir)?;
                    }
                    Err(error) if !is_gone(&error) => return Err(error),
                    _ => break,
                }
            }
        }
        if let Some(base) = self.0.parent() {
            // The directories stay while they hold other runs.
            let _ = fs::remove_dir(base.join(SHIMS)).and_then(|()| fs::remove_dir(base));
        }
        Ok(())
    }

    fn limit(&self, limits: &RunLimits) -> io::Result<()> {
        let set = |file: &str, value: String| match write(&self.0.join(file), &value) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
            written => written,
        };
        let or_max = |value: Option<u64>| value.map_or("max".to_owned(), |value| value.to_string());
        set("memory.max", or_max(limits.memory_bytes))?;
        set("memory.swap.max", limits.memory_bytes.map_or("max", |_| "0").to_owned())?;
        // A task with only some of its processes left is of no use.
        set("memory.oom.group", "1".to_owned())?;
        set("cpu.weight", limits.cpu_weight.unwrap_or(100).to_string())?;
        set("pids.max", or_max(limits.pids))
    }

    /// The group and the groups below it, each after its parent.
    fn nested(&self) -> io::Result<Vec<PathBuf>> {
        let mut dirs = vec![self.0.clone()];
        let mut next = 0;
        while let Some(dir) = dirs.get(next).cloned() {
            next += 1;
            let listing = match fs::read_dir(&dir) {
                Err(error) if is_gone(&error) => continue,
                listing => listing?,
            };
            let below =
                listing.flatten().filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
            dirs.extend(below.map(|entry| entry.path()));
            if dirs.len() > MAX_NESTED {
                return Err(io::Error::other(format!(
                    "more than {MAX_NESTED} groups below {}",
                    self.0.display()
                )));
            }
        }
        Ok(dirs)
    }
}

/// Capability of control groups on this machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Capability {
    /// They end runs reliably and keep them from starving their neighbours.
    Isolates,
    /// They end runs reliably, but do not isolate them.
    Counts,
    /// There are no control groups.
    Nothing,
}

/// The capability that an agent with sufficient rights would find. This function tests nothing, so
/// it changes nothing.
pub fn capability() -> Capability {
    let table = fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
    let Some(mount) = Mount::find(&table) else { return Capability::Nothing };
    let controllers =
        fs::read_to_string(mount.point.join("cgroup.controllers")).unwrap_or_default();
    let has = |name| controllers.split_whitespace().any(|controller| controller == name);
    if has("memory") && has("pids") { Capability::Isolates } else { Capability::Counts }
}

/// Mount point of the hierarchy and the mounted part of it.
struct Mount {
    point: PathBuf,
    root: PathBuf,
}

impl Mount {
    fn find(mount_table: &str) -> Option<Self> {
        mount_table.lines().find_map(|line| {
            let (fields, kind) = line.split_once(" - ")?;
            let mut fields = fields.split(' ').skip(3);
            let root = PathBuf::from(fields.next()?);
            let point = PathBuf::from(fields.next()?);
            kind.starts_with("cgroup2 ").then_some(Self { point, root })
        })
    }

    /// Whether the mount begins at the root of the machine's hierarchy, which is the one group that
    /// has no type.
    fn is_whole(&self) -> bool {
        self.root == Path::new("/") && !self.point.join("cgroup.type").exists()
    }

    /// Directories where a process in the group `own` may make groups, the best first.
    fn places(&self, own: &Path, on_machine: bool) -> Vec<PathBuf> {
        if on_machine {
            return vec![self.point.clone()];
        }
        let Ok(below) = own.strip_prefix(&self.root) else { return Vec::new() };
        let own = self.point.join(below);
        let beside =
            own.parent().filter(|parent| own != self.point && parent.starts_with(&self.point));
        beside.map(Path::to_owned).into_iter().chain([own.clone()]).collect()
    }
}

/// The group of a process, from its `/proc/<pid>/cgroup`; `None` where the group lies outside the
/// process's view of the hierarchy.
fn own_path(text: &str) -> Option<PathBuf> {
    let path = text.lines().find_map(|line| line.strip_prefix("0::"))?;
    (!path.split('/').any(|part| part == "..")).then(|| PathBuf::from(path))
}

fn name(dir: &Path) -> String {
    let digest = Digest::of(dir.as_os_str().as_encoded_bytes());
    format!("run-{}", &digest.hex()[..16])
}

/// Makes a group below `base`. A concurrent removal may take `base` away at any moment until the
/// group exists.
fn make(base: &Path, name: &str) -> io::Result<Cgroup> {
    let group = base.join(name);
    for _ in 0..MAKE_TRIES {
        make_dir(base)?;
        for dir in base.parent().into_iter().chain([base]) {
            enable_controllers(dir);
        }
        match make_dir(&group) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            made => return made.map(|()| Cgroup(group)),
        }
    }
    Err(io::Error::other(format!(
        "{} was removed {MAKE_TRIES} times while a group was made in it",
        base.display()
    )))
}

fn make_dir(path: &Path) -> io::Result<()> {
    match fs::create_dir(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        made => made,
    }
}

/// Enables the controllers for the groups in `dir`, as far as `dir` has them itself. A refused
/// controller shows later in the files that the groups have.
fn enable_controllers(dir: &Path) {
    for controller in CONTROLLERS {
        let _ = write(&dir.join("cgroup.subtree_control"), &format!("+{controller}"));
    }
}

/// Moves this process out of the group that it is to divide, if that group is a container's
/// outermost one and holds no other process: a group with limits for its children must have no
/// processes. Under a service manager the agent does not leave its group: otherwise it could not be
/// started a second time.
fn leave(group: &Path) -> bool {
    let alone = Cgroup(group.to_owned()).pids().is_ok_and(|pids| pids == [std::process::id()]);
    let outermost = !group.parent().is_some_and(|parent| parent.join("cgroup.procs").exists());
    let left = || {
        make_dir(&group.join(AGENT))
            .and_then(|()| Cgroup(group.join(AGENT)).entrance()?.write_all(b"0"))
    };
    alone && outermost && left().is_ok()
}

/// Waits briefly until something changes in the group at `dir`.
fn wait_for_event(dir: &Path) -> io::Result<()> {
    let events = match File::open(dir.join("cgroup.events")) {
        Err(error) if is_gone(&error) => return Ok(()),
        opened => opened?,
    };
    let mut poll = libc::pollfd { fd: events.as_raw_fd(), events: libc::POLLPRI, revents: 0 };
    // SAFETY: the one entry outlives the call, and its descriptor is open.
    match Errno::result(unsafe { libc::poll(&raw mut poll, 1, 50) }) {
        Ok(_) | Err(Errno::EINTR) => Ok(()),
        Err(errno) => Err(errno.into()),
    }
}

/// Writes the text with one call and creates no file: these files belong to the kernel.
fn write(path: &Path, text: &str) -> io::Result<()> {
    File::options().write(true).open(path)?.write_all(text.as_bytes())
}

fn is_gone(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::NotFound || error.raw_os_error() == Some(libc::ENODEV)
}

#[cfg(test)]
mod tests {
    use super::*;

    const HYBRID: &str = "32 25 0:28 / /sys/fs/cgroup/memory rw,relatime - cgroup cgroup rw,memory\n\
                          35 25 0:30 / /sys/fs/cgroup/unified rw,relatime shared:9 - cgroup2 cgroup2 rw\n";

    #[test]
    fn mount_is_found_in_every_layout() {
        let hybrid = Mount::find(HYBRID).expect("found");
        assert_eq!(hybrid.point, Path::new("/sys/fs/cgroup/unified"));
        let unified =
            Mount::find("30 23 0:26 / /sys/fs/cgroup rw - cgroup2 cgroup2 rw,nsdelegate\n")
                .expect("found");
        assert_eq!(unified.point, Path::new("/sys/fs/cgroup"));
        assert!(
            Mount::find("32 25 0:28 / /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory\n")
                .is_none()
        );
    }

    #[test]
    fn delegated_agent_uses_its_own_group_and_root_the_whole_machine() {
        let mount = Mount::find(HYBRID).expect("found");
        let own = own_path("4:memory:/x\n0::/system.slice/robot.service/agent\n").expect("found");
        let service = Path::new("/sys/fs/cgroup/unified/system.slice/robot.service");
        assert_eq!(mount.places(&own, false), [service.to_owned(), service.join("agent")]);
        assert_eq!(mount.places(&own, true), [PathBuf::from("/sys/fs/cgroup/unified")]);
        assert_eq!(mount.places(Path::new("/"), false), [PathBuf::from("/sys/fs/cgroup/unified/")]);
        assert_eq!(own_path("0::/../other.service\n"), None);
        assert_eq!(own_path("4:memory:/x\n"), None);
    }

    #[test]
    fn each_directory_has_its_own_group() {
        assert_eq!(name(Path::new("/a/run/1")), name(Path::new("/a/run/1")));
        assert_ne!(name(Path::new("/a/run/1")), name(Path::new("/a/run/2")));
        assert_eq!(name(Path::new("/a")).len(), 20);
    }

    #[test]
    fn missing_group_is_empty_and_can_be_killed_and_removed() {
        let gone = Cgroup::at(PathBuf::from("/nonexistent/taskd/run-1"));
        assert_eq!(gone.pids().expect("none"), Vec::<u32>::new());
        assert!(gone.kill().is_ok() && gone.remove().is_ok() && !gone.is_out_of_memory());
    }
}
