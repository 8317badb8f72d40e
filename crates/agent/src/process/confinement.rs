//! What a build or a task is put into between fork and exec: its control group, its limits, its
//! account, its filter of system calls. [`Confinement`] is made ready before the fork, by whoever
//! may look things up; entering it makes system calls only. It never starts anything.

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

/// How much sooner than others a task is killed when the whole machine is out of memory.
const TASK_OOM_SCORE: &std::ffi::CStr = c"300";
/// How much later an agent that is root is, and its shims.
const AGENT_OOM_SCORE: i32 = -900;
/// The highest capability a kernel could know.
const LAST_CAPABILITY: libc::c_ulong = 63;

/// What a process enters before it becomes a build or a task.
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
    /// The confinement of what runs `script`. Limits that `cgroup` can't keep are kept as well as
    /// can be otherwise: the memory for each process by itself, the processes by a limit on all of
    /// the account's.
    pub fn new(
        script: &Path,
        cgroup: Option<&Cgroup>,
        limits: &RunLimits,
        user: Option<&TaskUser>,
    ) -> io::Result<Self> {
        let keeps_memory = cgroup.is_some_and(Cgroup::limits_memory);
        let keeps_pids = cgroup.is_some_and(Cgroup::limits_pids);
        let user_processes = match limits.pids.filter(|_| !keeps_pids) {
            // The kernel counts all that runs under the account, so what runs now is added.
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

    /// Puts the calling process into it. Only system calls: it is called between fork and exec.
    pub fn enter(&self) -> io::Result<()> {
        if let Some(cgroup) = &self.cgroup {
            nix::unistd::write(cgroup, b"0")?;
        }
        // It only says who goes first; where it can't be said all are equal.
        if let Ok(file) =
            open(c"/proc/self/oom_score_adj", OFlag::O_WRONLY | OFlag::O_CLOEXEC, Mode::empty())
        {
            let _ = nix::unistd::write(&file, TASK_OOM_SCORE.to_bytes());
        }
        if let Some(bytes) = self.data_bytes {
            // Not the address space, of which programs with many threads or large files mapped have
            // far more than memory.
            setrlimit(Resource::RLIMIT_DATA, bytes, bytes)?;
        }
        if let Some(count) = self.user_processes {
            setrlimit(Resource::RLIMIT_NPROC, count, count)?;
        }
        if let Some(user) = &self.user {
            user.become_it()?;
        }
        access(self.script.as_c_str(), AccessFlags::R_OK)?;
        self.calls.as_ref().map_or(Ok(()), CallFilter::install)
    }
}

impl Account {
    /// Gives up root for good: no capability is left or can be had, whatever is executed.
    fn become_it(&self) -> io::Result<()> {
        prctl::set_no_new_privs()?;
        for capability in 0..=LAST_CAPABILITY {
            // SAFETY: takes integers only.
            match Errno::result(unsafe { libc::prctl(libc::PR_CAPBSET_DROP, capability, 0, 0, 0) })
            {
                Ok(_) => {}
                // Beyond the last one that this kernel knows; or the agent lacks the power to give
                // up powers, and then what is set above keeps any from being had again.
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

/// Lets no other process of this account look into this one.
pub fn hide_this_process() {
    let _ = prctl::set_dumpable(false);
}

/// Keeps what an agent that is root knows to itself, and lets it be the last to go when memory runs
/// out. The shims inherit the second and call this for the first.
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
