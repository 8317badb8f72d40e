//! The account of each task, where the agent is root: two user ids of the range in the settings,
//! one for the task's processes and one for its builds. So neither a neighbour nor an older version
//! that still runs has rights over either. The ids belong to the task as long as its directory
//! exists; afterwards they are the last to be given to another task. The groups are those of
//! `task_user`. The module writes no entry in the system's list of accounts.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::ops::RangeInclusive;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use task_proto::TaskName;

use crate::system::durable;
use crate::system::layout::DataDir;
use crate::system::task_user::TaskUser;

/// Directories where every account may leave files that outlive its task.
const PUBLIC_DIRECTORIES: [&str; 4] = ["/tmp", "/var/tmp", "/dev/shm", "/dev/mqueue"];
/// Number of user ids per task.
const PER_TASK: u32 = 2;

/// The accounts of a robot's tasks.
#[derive(Debug)]
pub struct Accounts {
    data: DataDir,
    /// The available user ids; `None`: all tasks share one account.
    range: Option<RangeInclusive<u32>>,
    /// Loaded when the first task asks for its accounts.
    table: Mutex<Option<AccountTable>>,
}

/// The accounts of a task and its builds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AccountPair {
    /// Account of the task's processes.
    pub run: TaskUser,
    /// Account of the task's builds.
    pub build: TaskUser,
}

/// Content of the file on disk: the first of each task's ids.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
struct AccountTable {
    tasks: BTreeMap<TaskName, u32>,
    /// First ids of tasks that were removed, the earliest removal first.
    #[serde(default)]
    former: Vec<(TaskName, u32)>,
}

impl Accounts {
    /// The accounts of the tasks in `data`, with ids of `range`.
    pub fn new(data: DataDir, range: Option<RangeInclusive<u32>>) -> Self {
        Self { data, range, table: Mutex::new(None) }
    }

    /// Whether each task has its own accounts.
    pub fn are_per_task(&self) -> bool {
        self.range.is_some()
    }

    /// The accounts of `task`, which belong to it from now on, also after a power cut. They have
    /// the groups of `base`.
    pub fn of(&self, task: &TaskName, base: &TaskUser) -> io::Result<AccountPair> {
        let Some(range) = &self.range else {
            return Ok(AccountPair { run: base.clone(), build: base.clone() });
        };
        let mut table = self.table.lock().unwrap_or_else(PoisonError::into_inner);
        let known = match &mut *table {
            Some(known) => known,
            None => table.insert(self.read(range)?),
        };
        let id = match known.tasks.get(task).filter(|id| has_pair(range, **id)) {
            Some(id) => *id,
            None => {
                let mut next = known.clone();
                let id = next.assign(task, range, &|id| self.is_free(id)).ok_or_else(|| {
                    let (first, last) = (range.start(), range.end());
                    io::Error::other(format!(
                        "task_uids: no two user ids from {first} to {last} are free"
                    ))
                })?;
                self.write(&next)?;
                *known = next;
                id
            }
        };
        Ok(AccountPair { run: base.with_id(id), build: base.with_id(id + 1) })
    }

    /// Records that `task` has no files left in the agent's directory.
    pub fn release(&self, task: &TaskName) -> io::Result<()> {
        let mut table = self.table.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(range) = &self.range else { return Ok(()) };
        let known = match &mut *table {
            Some(known) => known,
            None => table.insert(self.read(range)?),
        };
        let mut next = known.clone();
        let Some(id) = next.tasks.remove(task) else { return Ok(()) };
        next.former.push((task.clone(), id));
        self.write(&next)?;
        *known = next;
        Ok(())
    }

    /// The recorded ids. If the record is lost, they are recovered from the owners of home
    /// directories.
    fn read(&self, range: &RangeInclusive<u32>) -> io::Result<AccountTable> {
        let path = self.data.accounts();
        let mut table = match fs::read(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => AccountTable::default(),
            read => serde_json::from_slice(&read?).unwrap_or_else(|error| {
                tracing::error!(path = %path.display(), %error, "the account table is damaged; rebuilding it from the owners of home directories");
                AccountTable::default()
            }),
        };
        for task in self.data.task_names()? {
            let Ok(home) = fs::symlink_metadata(self.data.task(&task).home()) else { continue };
            let id = home.uid();
            let is_first = has_pair(range, id) && (id - range.start()).is_multiple_of(PER_TASK);
            let is_taken = table.tasks.values().any(|other| *other == id);
            if is_first && !is_taken {
                table.tasks.entry(task).or_insert(id);
            }
        }
        Ok(table)
    }

    fn write(&self, table: &AccountTable) -> io::Result<()> {
        durable::write(&self.data.accounts(), &serde_json::to_vec_pretty(table)?, 0o600)
    }

    /// Whether this id is unused: it has no account on the system, and owns no file in a public
    /// directory.
    fn is_free(&self, id: u32) -> bool {
        let text =
            |path: &str| String::from_utf8_lossy(&fs::read(path).unwrap_or_default()).into_owned();
        let is_listed = |path: &str| {
            let id = id.to_string();
            text(path).lines().any(|line| line.split(':').nth(2) == Some(id.as_str()))
        };
        !is_listed("/etc/passwd") && !is_listed("/etc/group") && !owns_public_files(id)
    }
}

impl AccountTable {
    /// Gives `task` the first id of a pair: the id that the task had before, else one that no task
    /// had, else the one that was released first.
    fn assign(
        &mut self,
        task: &TaskName,
        range: &RangeInclusive<u32>,
        is_free: &impl Fn(u32) -> bool,
    ) -> Option<u32> {
        self.tasks.remove(task);
        let had = self
            .former
            .iter()
            .find(|(name, id)| name == task && has_pair(range, *id))
            .map(|(_, id)| *id);
        let used: BTreeSet<u32> =
            self.tasks.values().copied().chain(self.former.iter().map(|(_, id)| *id)).collect();
        let overlaps = |id: u32| {
            used.contains(&id) || used.contains(&(id + 1)) || (id > 0 && used.contains(&(id - 1)))
        };
        let pair_is_free = |id: u32| is_free(id) && is_free(id + 1);
        let fresh = || {
            let mut pairs =
                range.clone().step_by(PER_TASK as usize).filter(|id| has_pair(range, *id));
            pairs.find(|id| !overlaps(*id) && pair_is_free(*id))
        };
        let again = || {
            let mut given_back = self.former.iter().map(|(_, id)| *id);
            given_back.find(|id| has_pair(range, *id) && pair_is_free(*id))
        };
        let id = had.or_else(fresh).or_else(again)?;
        self.former.retain(|(_, other)| *other != id);
        self.tasks.insert(task.clone(), id);
        Some(id)
    }
}

fn has_pair(range: &RangeInclusive<u32>, id: u32) -> bool {
    range.contains(&id) && range.contains(&id.saturating_add(1))
}

/// Whether this id owns a file in the public directories.
fn owns_public_files(id: u32) -> bool {
    let owns_in = |dir: &str| {
        let entries = fs::read_dir(Path::new(dir)).into_iter().flatten().flatten();
        entries
            .into_iter()
            .any(|entry| entry.metadata().is_ok_and(|about| about.uid() == id || about.gid() == id))
    };
    PUBLIC_DIRECTORIES.iter().any(|dir| owns_in(dir))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn base() -> TaskUser {
        TaskUser { name: "taskd-task".to_owned(), uid: 997, gid: 995, groups: vec![20, 44] }
    }

    fn name(text: &str) -> TaskName {
        text.parse().expect("valid")
    }

    fn accounts(dir: &Path, range: RangeInclusive<u32>) -> Accounts {
        Accounts::new(DataDir::new(dir).expect("a directory"), Some(range))
    }

    const RANGE: RangeInclusive<u32> = 3_000_000..=3_000_005;

    #[test]
    fn task_keeps_its_ids_over_restarts_with_the_groups_of_the_task_user() {
        let temp = tempfile::tempdir().expect("a directory");
        let first = accounts(temp.path(), RANGE).of(&name("a"), &base()).expect("assigned");
        let expected = TaskUser {
            name: "3000000".to_owned(),
            uid: 3_000_000,
            gid: 3_000_000,
            groups: vec![995, 20, 44],
        };
        assert_eq!(
            (&first.run, first.build.uid, first.build.gid),
            (&expected, 3_000_001, 3_000_001)
        );
        let again = accounts(temp.path(), RANGE);
        assert_eq!(again.of(&name("b"), &base()).expect("assigned").run.uid, 3_000_002);
        assert_eq!(again.of(&name("a"), &base()).expect("known"), first);
        assert_eq!(accounts(temp.path(), RANGE).of(&name("a"), &base()).expect("known"), first);
        // Another range: ids outside of it are given up.
        assert_eq!(
            accounts(temp.path(), 3_000_010..=3_000_011)
                .of(&name("a"), &base())
                .expect("known")
                .run
                .uid,
            3_000_010
        );
    }

    #[test]
    fn ids_of_removed_tasks_are_reused_last() {
        let temp = tempfile::tempdir().expect("a directory");
        let accounts = accounts(temp.path(), RANGE);
        let id =
            |task: &str| accounts.of(&name(task), &base()).map(|pair| pair.run.uid - RANGE.start());
        assert_eq!((id("a").expect("free"), id("b").expect("free")), (0, 2));
        accounts.release(&name("a")).expect("noted");
        assert_eq!(id("c").expect("free"), 4);
        assert_eq!(id("a").expect("its own"), 0);
        accounts.release(&name("b")).expect("noted");
        accounts.release(&name("a")).expect("noted");
        assert_eq!(id("d").expect("the longest gone"), 2);
        assert_eq!(id("e").expect("the last"), 0);
        let none = id("f").expect_err("all are taken").to_string();
        assert!(none.contains("task_uids") && none.contains("3000005"), "{none}");
    }

    #[test]
    fn lost_table_is_rebuilt_from_home_directories() {
        if !nix::unistd::geteuid().is_root() {
            return eprintln!("unavailable: only root can make another's directory");
        }
        let temp = tempfile::tempdir().expect("a directory");
        let data = DataDir::new(temp.path()).expect("a directory");
        let kept = accounts(temp.path(), RANGE);
        for task in ["a", "b"] {
            let pair = kept.of(&name(task), &base()).expect("assigned");
            pair.run.make_home(&data.task(&name(task)).home()).expect("made");
        }
        for damage in [None, Some("{")] {
            match damage {
                None => fs::remove_file(data.accounts()).expect("removed"),
                Some(text) => fs::write(data.accounts(), text).expect("damaged"),
            }
            let rebuilt = accounts(temp.path(), RANGE);
            assert_eq!(rebuilt.of(&name("c"), &base()).expect("assigned").run.uid, 3_000_004);
            assert_eq!(rebuilt.of(&name("b"), &base()).expect("known").run.uid, 3_000_002);
        }
    }

    #[test]
    fn without_a_range_all_tasks_share_one_account() {
        let temp = tempfile::tempdir().expect("a directory");
        let accounts = Accounts::new(DataDir::new(temp.path()).expect("a directory"), None);
        let pair = accounts.of(&name("a"), &base()).expect("given");
        assert_eq!((&pair.run, &pair.build), (&base(), &base()));
        assert!(!accounts.are_per_task() && !temp.path().join("accounts.json").exists());
    }
}
