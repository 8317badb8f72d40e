//! The confinement that a build or a task enters between fork and exec: control group, limits,
//! account, and system-call filter. A [`Confinement`] is prepared before the fork, where look-ups
//! are allowed; entering it makes system calls only. This module never starts a process.

use std::ffi::CString;
use std::fs::{self, File};
use std::io;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use nix::errno::Errno;
use nix::fcntl::{OFlag, open};
use nix::sys::prctl;
use nix::sys::resource::{Resource, setrlimit};
use nix::sys::stat::Mode;
use nix::unistd::{AccessFlags, Gid, Uid, access};

use crate::process::call_filter::CallFilter;
use crate::process::cgroup::{Cgroup, RunLimits};
use crate::system::task_user::TaskUser;

/// OOM score adjustment of tasks: when the machine runs out of memory, tasks are killed before
/// other processes.
const TASK_OOM_SCORE: &std::ffi::CStr = c"300";
/// OOM score adjustment of an agent that is root, and of its shims: they are killed after other
/// processes.
const AGENT_OOM_SCORE: i32 = -900;
/// Upper bound for capability numbers of any kernel.
const LAST_CAPABILITY: libc::c_ulong = 63;

/// The confinement that a process enters before it becomes a build or a task.
#[derive(Debug)]
pub struct Confinement {
    cgroup: Option<File>,
    data_bytes: Option<u64>,
    user_processes: Option<u64>,
    user: Option<Account>,
    calls: Option<CallFilter>,
    script: CString,
}

#[derive(Debug)]
struct Account {
    uid: Uid,
    gid: Gid,
    groups: Vec<libc::gid_t>,
}

impl Confinement {
    /// The confinement of the process that runs `script`. Limits that `cgroup` can't enforce are
    /// approximated: memory by a limit on each process, the number of processes by a limit on all
    /// processes of the account.
    pub fn new(
        script: &Path,
        cgroup: Option<&Cgroup>,
        limits: &RunLimits,
        user: Option<&TaskUser>,
    ) -> io::Result<Self> {
        let keeps_memory = cgroup.is_some_and(Cgroup::limits_memory);
        let keeps_pids = cgroup.is_some_and(Cgroup::limits_pids);
        let user_processes = match limits.pids.filter(|_| !keeps_pids) {
            // The kernel counts all threads of the account, so the current threads are added.
            Some(pids) => Some(pids.saturating_add(threads_of(
                user.map_or(nix::unistd::getuid().as_raw(), |user| user.uid),
            )?)),
            None => None,
        };
        let account = |user: &TaskUser| Account {
            uid: Uid::from_raw(user.uid),
            gid: Gid::from_raw(user.gid),
            groups: std::iter::once(user.gid).chain(user.groups.iter().copied()).collect(),
        };
        Ok(Self {
            cgroup: cgroup.map(Cgroup::entrance).transpose()?,
            data_bytes: limits.memory_bytes.filter(|_| !keeps_memory),
            user_processes,
            user: user.map(account),
            calls: limits.filter_calls.then(CallFilter::of_tasks).flatten(),
            script: CString::new(script.as_os_str().as_bytes())?,
        })
    }

    /// Puts the calling process into the confinement. This runs between fork and exec, so it makes
    /// system calls only.
    pub fn enter(&self) -> io::Result<()> {
        if let Some(cgroup) = &self.cgroup {
            nix::unistd::write(cgroup, b"0")?;
        }
        // The score only sets the order of killing; without it all processes are equal.
        if let Ok(file) =
            open(c"/proc/self/oom_score_adj", OFlag::O_WRONLY | OFlag::O_CLOEXEC, Mode::empty())
        {
            let _ = nix::unistd::write(&file, TASK_OOM_SCORE.to_bytes());
        }
        if let Some(bytes) = self.data_bytes {
            // The address space is not limited: programs with many threads or large mapped files
            // use far more of it than of memory.
            setrlimit(Resource::RLIMIT_DATA, bytes, bytes)?;
        }
        if let Some(count) = self.user_processes {
            setrlimit(Resource::RLIMIT_NPROC, count, count)?;
        }
        if let Some(user) = &self.user {
            user.switch_account()?;
        }
        access(self.script.as_c_str(), AccessFlags::R_OK)?;
        self.calls.as_ref().map_or(Ok(()), CallFilter::install)
    }
}

impl Account {
    /// Gives up root permanently: no capability is left, and no executed program can regain one.
    fn switch_account(&self) -> io::Result<()> {
        prctl::set_no_new_privs()?;
        for capability in 0..=LAST_CAPABILITY {
            // SAFETY: takes integers only.
            match Errno::result(unsafe { libc::prctl(libc::PR_CAPBSET_DROP, capability, 0, 0, 0) })
            {
                Ok(_) => {}
                // EINVAL: past the last capability that this kernel knows. EPERM: the agent may not
                // drop capabilities, and then the settings above keep any from being regained.
                Err(Errno::EINVAL | Errno::EPERM) => break,
                Err(errno) => return Err(errno.into()),
            }
        }
        // SAFETY: the list outlives the call.
        Errno::result(unsafe { libc::setgroups(self.groups.len(), self.groups.as_ptr()) })?;
        nix::unistd::setresgid(self.gid, self.gid, self.gid)?;
        Ok(nix::unistd::setresuid(self.uid, self.uid, self.uid)?)
    }
}

/// Prevents other processes of this account from inspecting this process.
pub fn hide_this_process() {
    let _ = prctl::set_dumpable(false);
}

/// Protects the data of an agent that is root from other processes, and makes the agent the last
/// candidate when memory runs out. Shims inherit the OOM score and call this function for the data.
pub fn protect_this_process() {
    if !nix::unistd::geteuid().is_root() {
        // Tasks run as the same user: they could read the identity's file as well.
        return;
    }
    let _ = prctl::set_dumpable(false);
    let path = "/proc/self/oom_score_adj";
    let now: Option<i32> = fs::read_to_string(path).ok().and_then(|text| text.trim().parse().ok());
    if now.is_some_and(|now| now > AGENT_OOM_SCORE) {
        // A container may forbid it.
        let _ = fs::write(path, AGENT_OOM_SCORE.to_string());
    }
}

/// The threads of all processes of this user.
fn threads_of(uid: u32) -> io::Result<u64> {
    let mut threads = 0;
    for process in fs::read_dir("/proc")?.flatten() {
        let owned = process.metadata().is_ok_and(|data| data.uid() == uid);
        if owned && process.file_name().as_encoded_bytes().iter().all(u8::is_ascii_digit) {
            threads +=
                fs::read_dir(process.path().join("task")).map_or(0, |tasks| tasks.count() as u64);
        }
    }
    Ok(threads)
}
