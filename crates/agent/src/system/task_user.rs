//! The account that tasks take their groups from where the agent is root, found by name or number.
//! This module also gives accounts access to the agent's directories: to their own files, to the
//! path that leads there, and read access to the files that they run. It reads `/etc/passwd` and
//! `/etc/group` itself, because a static program can't load the system's name services. It never
//! creates an account.

use std::fs;
use std::io;
use std::os::fd::{AsFd, AsRawFd as _, OwnedFd};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{AtFlags, OFlag, openat};
use nix::sys::stat::{FileStat, Mode, SFlag, fstat};
use nix::unistd::{Gid, Uid, fchown, fchownat, setfsgid, setfsuid};
use serde::{Deserialize, Serialize};

/// The account that is used when the settings name none.
pub const DEFAULT_NAME: &str = "taskd-task";
/// Maximum depth of a tree that changes owner.
pub const MAX_DEPTH: usize = 256;
/// The call that sets the groups of one thread, with ids of 32 bits.
#[cfg(target_pointer_width = "64")]
const SETGROUPS: libc::c_long = libc::SYS_setgroups;
#[cfg(target_pointer_width = "32")]
const SETGROUPS: libc::c_long = libc::SYS_setgroups32;

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskUser {
    /// The account's name, or its number where it has no name.
    pub name: String,
    pub uid: u32,
    pub gid: u32,
    /// The supplementary groups: `dialout`, `video`, …
    pub groups: Vec<u32>,
}

/// Reasons why tasks can't run on this robot.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TaskUserError {
    /// There is no such account.
    #[error(
        "the agent runs as root, and the user {name:?} that tasks run as does not exist: create it (`useradd --system \
         {DEFAULT_NAME}`), or name another user by `task_user` in agent.toml (\"root\" gives tasks the whole \
         machine), and restart the agent"
    )]
    Missing { name: String },
    /// The account can't enter a directory above the agent's data directory.
    #[error(
        "tasks run as {user:?}, which may not enter {}, where the data directory {} lies: allow it to pass \
         (`chmod o+x {}`) or move the data directory, and restart the agent", dir.display(), data.display(), dir.display()
    )]
    NoAccess {
        user: String,
        /// The first directory that the account can't enter.
        dir: PathBuf,
        /// The agent's data directory.
        data: PathBuf,
    },
    /// Only root may run tasks under another account.
    #[error(
        "task_user is {name:?}, but the agent does not run as root and can't start anything as another user"
    )]
    NotRoot { name: String },
}

impl TaskUser {
    /// The account that `setting` names; `None`: builds and tasks run under the agent's own
    /// account.
    pub fn find(setting: Option<&str>) -> Result<Option<Self>, TaskUserError> {
        let text =
            |path: &str| fs::read(path).map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
        let passwd = text("/etc/passwd").unwrap_or_default();
        let group = text("/etc/group").unwrap_or_default();
        Self::choose(setting, nix::unistd::geteuid().as_raw(), &passwd, &group)
    }

    fn choose(
        setting: Option<&str>,
        own: u32,
        passwd: &str,
        group: &str,
    ) -> Result<Option<Self>, TaskUserError> {
        if setting.is_none() && own != 0 {
            return Ok(None);
        }
        let name = setting.unwrap_or(DEFAULT_NAME);
        let user = Self::look_up(name, passwd, group)
            .ok_or_else(|| TaskUserError::Missing { name: name.to_owned() })?;
        if user.uid == own {
            return Ok(None);
        }
        if own == 0 {
            Ok(Some(user))
        } else {
            Err(TaskUserError::NotRoot { name: name.to_owned() })
        }
    }

    fn look_up(name: &str, passwd: &str, group: &str) -> Option<Self> {
        let number: Option<u32> = name.parse().ok();
        let listed = passwd.lines().find_map(|line| {
            let mut fields = line.split(':');
            let (listed, _) = (fields.next()?, fields.next()?);
            let (uid, gid): (u32, u32) =
                (fields.next()?.parse().ok()?, fields.next()?.parse().ok()?);
            (listed == name || Some(uid) == number).then(|| (listed.to_owned(), uid, gid))
        });
        let (name, uid, gid) = listed.or_else(|| Some((name.to_owned(), number?, number?)))?;
        let is_member = |members: &str| members.split(',').any(|member| member == name);
        let in_groups = group.lines().filter_map(|line| {
            let mut fields = line.split(':').skip(2);
            let gid = fields.next()?.parse().ok()?;
            let members = fields.next()?;
            is_member(members).then_some(gid)
        });
        let groups = in_groups.filter(|other| *other != gid).collect();
        Some(Self { name, uid, gid, groups })
    }

    /// The account, if it can reach the data directory `data`. The agent opens that directory and
    /// its contents to its tasks. The directories above belong to the machine's administrator, so
    /// the agent does not open them.
    pub fn check_access(self, data: &Path) -> Result<Self, TaskUserError> {
        let data = std::path::absolute(data).unwrap_or_else(|_| data.to_owned());
        // An error that does not show here shows at the first start.
        let inaccessible = self.run_with_file_rights(|| {
            data.ancestors().skip(1).filter(|dir| is_inaccessible(dir)).last().map(Path::to_owned)
        });
        match inaccessible {
            Ok(Some(dir)) => Err(TaskUserError::NoAccess { user: self.name, dir, data }),
            Ok(None) | Err(_) => Ok(self),
        }
    }

    /// An account for one task, with the groups of this account, its own group included: the groups
    /// give access to hardware.
    pub fn with_id(&self, id: u32) -> Self {
        let groups = std::iter::once(self.gid).chain(self.groups.iter().copied()).collect();
        Self { name: id.to_string(), uid: id, gid: id, groups }
    }

    /// Lets the account into a directory that stays root's. Apart from root, no other account may
    /// enter.
    pub fn grant_entry(&self, dir: &Path) -> io::Result<()> {
        let flags = OFlag::O_RDONLY | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let opened = nix::fcntl::open(dir, flags, Mode::empty())?;
        fchown(&opened, Some(nix::unistd::geteuid()), Some(self.group()))?;
        Ok(nix::sys::stat::fchmod(&opened, Mode::S_IRWXU | Mode::S_IRGRP | Mode::S_IXGRP)?)
    }

    /// Lets the account pass through `dirs` without listing them.
    pub fn allow_traversal(&self, dirs: &[PathBuf]) -> io::Result<()> {
        for dir in dirs {
            let mode = fs::metadata(dir)?.permissions().mode();
            if mode & 0o001 == 0 {
                fs::set_permissions(dir, fs::Permissions::from_mode(mode & 0o7777 | 0o001))?;
            }
        }
        Ok(())
    }

    /// Makes the account the owner of an open file.
    pub fn chown(&self, file: impl AsFd) -> io::Result<()> {
        Ok(fchown(file, Some(self.user()), Some(self.group()))?)
    }

    /// Makes a home directory that only the account may enter.
    pub fn make_home(&self, dir: &Path) -> io::Result<()> {
        crate::system::durable::create_dir_all(dir)?;
        self.hand_over(dir)
    }

    /// Makes the account the owner of the tree at `dir`, with no access for others. `dir` itself
    /// comes last: a tree that was handed over in part is done again, and a tree that belongs to
    /// the account is not touched. Changes that a task made in its tree are the task's own affair,
    /// and no link in the tree is followed.
    pub fn hand_over(&self, dir: &Path) -> io::Result<()> {
        let flags = OFlag::O_RDONLY | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let opened = nix::fcntl::open(dir, flags, Mode::empty())?;
        if fstat(&opened)?.st_uid == self.uid {
            return Ok(());
        }
        each_below(&opened, 0, &mut |entry, stat| {
            // A file with a second name may belong to another account; packages have no such files.
            let is_sure = !is_kind(stat, SFlag::S_IFREG) || stat.st_nlink == 1;
            if is_sure { self.chown_entry(entry) } else { Ok(()) }
        })?;
        nix::sys::stat::fchmod(&opened, Mode::S_IRWXU)?;
        Ok(fchown(&opened, Some(self.user()), Some(self.group()))?)
    }

    /// Runs `work` with the account's rights to files and no others. `work` must not touch data
    /// that only the agent may see. A task may replace any file or directory by a link, so the
    /// agent must not read anything for the task that the task itself can't read.
    pub fn run_with_file_rights<T: Send>(&self, work: impl FnOnce() -> T + Send) -> io::Result<T> {
        // The thread ends with the work, so no rights need to be restored.
        std::thread::scope(|scope| {
            let working = scope.spawn(|| self.reduce_to_file_rights().map(|()| work()));
            working.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        })
    }

    /// Reduces the calling thread, and no other, to the account's rights to files and no
    /// capability. The thread's user id stays root's: otherwise every process of the account could
    /// end the agent by a signal to this thread.
    fn reduce_to_file_rights(&self) -> io::Result<()> {
        let groups: Vec<libc::gid_t> =
            std::iter::once(self.gid).chain(self.groups.iter().copied()).collect();
        // SAFETY: the list outlives the call. The C library's own call would change all threads.
        Errno::result(unsafe { libc::syscall(SETGROUPS, groups.len(), groups.as_ptr()) })?;
        // These calls return the previous id and report no failure; an invalid id changes nothing.
        setfsgid(self.group());
        setfsuid(self.user());
        let none = u32::MAX;
        let now = (self.user(), self.group());
        if (setfsuid(Uid::from_raw(none)), setfsgid(Gid::from_raw(none))) != now {
            return Err(io::Error::from(io::ErrorKind::PermissionDenied));
        }
        drop_capabilities()
    }

    fn chown_entry(&self, entry: &OwnedFd) -> io::Result<()> {
        Ok(fchownat(entry, "", Some(self.user()), Some(self.group()), AtFlags::AT_EMPTY_PATH)?)
    }

    fn user(&self) -> Uid {
        Uid::from_raw(self.uid)
    }

    fn group(&self) -> Gid {
        Gid::from_raw(self.gid)
    }
}

/// Whether the calling thread may not pass through the directory.
fn is_inaccessible(dir: &Path) -> bool {
    fs::metadata(dir.join(".")).is_err_and(|error| error.kind() == io::ErrorKind::PermissionDenied)
}

/// Returns the files that the account `uid` owns in the tree at `dir` to root: readable for
/// everybody, as they were for the account, and writable for none. Files of other accounts stay as
/// they are, and no link is followed. No process of the account may be left.
pub fn return_to_root(dir: &Path, uid: u32) -> io::Result<()> {
    let flags = OFlag::O_RDONLY | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
    let opened = match nix::fcntl::open(dir, flags, Mode::empty()) {
        Err(Errno::ENOENT) => return Ok(()),
        opened => opened?,
    };
    let return_entry = |entry: &OwnedFd, stat: &FileStat| {
        if stat.st_uid != uid {
            return Ok(());
        }
        if !is_kind(stat, SFlag::S_IFLNK) {
            // No other account had rights that the owner lacked; set-id bits go.
            let own = stat.st_mode & 0o700;
            let mode = own | (own & 0o500) >> 3 | (own & 0o500) >> 6;
            fs::set_permissions(by_descriptor(entry), fs::Permissions::from_mode(mode))?;
        }
        let root = (Some(nix::unistd::geteuid()), Some(nix::unistd::getegid()));
        Ok(fchownat(entry, "", root.0, root.1, AtFlags::AT_EMPTY_PATH)?)
    };
    each_below(&opened, 0, &mut |entry, stat| return_entry(entry, stat))?;
    return_entry(&opened, &fstat(&opened)?)
}

/// Runs `work` on each entry below `dir`, directories after their contents. `work` acts on the
/// examined file itself, even if another file takes its name in between.
fn each_below(
    dir: &OwnedFd,
    depth: usize,
    work: &mut impl FnMut(&OwnedFd, &FileStat) -> io::Result<()>,
) -> io::Result<()> {
    if depth > MAX_DEPTH {
        return Err(io::Error::other(format!(
            "a directory lies more than {MAX_DEPTH} levels deep"
        )));
    }
    for entry in fs::read_dir(by_descriptor(dir))? {
        let name = entry?.file_name();
        let flags = OFlag::O_PATH | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let entry = openat(dir, name.as_os_str(), flags, Mode::empty())?;
        let stat = fstat(&entry)?;
        if is_kind(&stat, SFlag::S_IFDIR) {
            each_below(&entry, depth + 1, work)?;
        }
        work(&entry, &stat)?;
    }
    Ok(())
}

fn by_descriptor(descriptor: &OwnedFd) -> PathBuf {
    format!("/proc/self/fd/{}", descriptor.as_raw_fd()).into()
}

/// Runs blocking `work` with the rights to files that `user` has, or with the agent's rights where
/// tasks run under the agent's account.
pub async fn do_as<T: Send + 'static>(
    user: Option<&TaskUser>,
    work: impl FnOnce() -> T + Send + 'static,
) -> io::Result<T> {
    let user = user.cloned();
    let working = tokio::task::spawn_blocking(move || match user {
        Some(user) => user.run_with_file_rights(work),
        None => Ok(work()),
    });
    working.await.map_err(io::Error::other).flatten()
}

/// Drops all capabilities of the calling thread, and of no other. Another user id for files removes
/// only the capabilities for file modes: the rest would still allow reading the `/proc` entries of
/// other processes.
fn drop_capabilities() -> io::Result<()> {
    /// The kernel's `_LINUX_CAPABILITY_VERSION_3`: two words for each set.
    const VERSION: u32 = 0x2008_0522;
    let header: [u32; 2] = [VERSION, 0];
    let none = [0_u32; 6];
    // SAFETY: both arrays have the kernel's layout (version and thread; three sets of two words)
    // and outlive the call.
    Errno::result(unsafe { libc::syscall(libc::SYS_capset, header.as_ptr(), none.as_ptr()) })?;
    Ok(())
}

fn is_kind(stat: &FileStat, kind: SFlag) -> bool {
    stat.st_mode & SFlag::S_IFMT.bits() == kind.bits()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PASSWD: &str =
        "root:x:0:0:root:/root:/bin/bash\nbroken line\ntaskd-task:x:997:995::/:/bin/false\n";
    const GROUP: &str = "dialout:x:20:alice,taskd-task\nvideo:x:44:taskd-task\nsudo:x:27:alice\ntaskd-task:x:995:\n";

    fn choose(setting: Option<&str>, own: u32) -> Result<Option<TaskUser>, TaskUserError> {
        TaskUser::choose(setting, own, PASSWD, GROUP)
    }

    #[test]
    fn root_uses_the_task_account_with_its_groups() {
        let user =
            TaskUser { name: DEFAULT_NAME.to_owned(), uid: 997, gid: 995, groups: vec![20, 44] };
        assert_eq!(choose(None, 0), Ok(Some(user.clone())));
        assert_eq!(choose(Some("997"), 0), Ok(Some(user)));
        let by_number =
            TaskUser { name: "4711".to_owned(), uid: 4711, gid: 4711, groups: Vec::new() };
        assert_eq!(choose(Some("4711"), 0), Ok(Some(by_number)));
    }

    #[test]
    fn root_must_be_explicit_and_a_missing_account_is_an_error() {
        assert_eq!(choose(Some("root"), 0), Ok(None));
        assert_eq!(choose(Some("0"), 0), Ok(None));
        let missing = TaskUser::choose(None, 0, "root:x:0:0::/:/bin/sh\n", "")
            .expect_err("refused")
            .to_string();
        assert!(
            missing.contains("useradd --system taskd-task") && missing.contains("task_user"),
            "{missing}"
        );
        assert!(choose(Some("tasks"), 0).expect_err("refused").to_string().contains("\"tasks\""));
    }

    #[test]
    fn work_with_file_rights_reads_only_the_files_of_the_account() {
        let temp = tempfile::tempdir().expect("temp dir");
        let own = temp.path().join("own");
        fs::write(&own, "text").expect("written");
        fs::set_permissions(&own, fs::Permissions::from_mode(0o600)).expect("for this user alone");
        let user = TaskUser { name: "4711".to_owned(), uid: 4711, gid: 4711, groups: Vec::new() };
        let kind = |path: &Path| fs::read(path).map(drop).map_err(|error| error.kind());
        let status = || fs::read_to_string("/proc/thread-self/status").expect("read");
        let read =
            user.run_with_file_rights(|| ([&own, Path::new("/etc/passwd")].map(kind), status()));
        if nix::unistd::geteuid().is_root() {
            let (kinds, status) = read.expect("the rights");
            assert_eq!(kinds, [Err(io::ErrorKind::PermissionDenied), Ok(())]);
            for set in ["CapInh", "CapPrm", "CapEff"] {
                assert!(status.contains(&format!("{set}:\t0000000000000000\n")), "{status}");
            }
        } else {
            assert!(read.is_err(), "only root may have another's rights");
        }
        assert!(fs::read(&own).is_ok());
    }

    #[test]
    fn inaccessible_directory_above_the_data_is_named() {
        if !nix::unistd::geteuid().is_root() {
            return eprintln!("unavailable: only root may take another's rights");
        }
        let temp = tempfile::tempdir().expect("temp dir");
        let (home, data) = (temp.path().join("home"), temp.path().join("home/agent/data"));
        fs::create_dir_all(&data).expect("made");
        let let_all = |dir: &Path, mode| {
            fs::set_permissions(dir, fs::Permissions::from_mode(mode)).expect("set")
        };
        let_all(temp.path(), 0o711);
        let_all(&home, 0o700);
        let_all(&data, 0o700);
        let user =
            || TaskUser { name: "4711".to_owned(), uid: 4711, gid: 4711, groups: Vec::new() };
        let refused = user().check_access(&data).expect_err("no access");
        assert!(
            matches!(&refused, TaskUserError::NoAccess { dir, .. } if *dir == home),
            "{refused}"
        );
        let chmod = format!("chmod o+x {}`", home.display());
        assert!(refused.to_string().contains(&chmod), "{refused}");
        let_all(&home, 0o711);
        assert_eq!(
            user().check_access(&data),
            Ok(user()),
            "the data directory itself is the agent's to open"
        );
    }

    #[test]
    fn agent_without_root_runs_tasks_under_its_own_account() {
        assert_eq!(choose(None, 1000), Ok(None));
        assert_eq!(choose(Some("1000"), 1000), Ok(None));
        assert!(matches!(choose(Some("root"), 1000), Err(TaskUserError::NotRoot { .. })));
    }
}
