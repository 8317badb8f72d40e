//! Finds all processes that a run has started, including those that tried to escape. Members are
//! all processes in the run's control group (only root can leave it), all processes with the run
//! directory in their environment (this survives `fork`, `setsid` and the shim's death), and all
//! descendants of the shim, which is their subreaper (this survives a cleared environment). The
//! module signals them and proves that none is left; it never signals the shim. Without control
//! groups, one kind of process is out of reach: one that clears its environment, locks it or makes
//! it endless, leaves its parent and then sees its shim killed.

use std::collections::HashSet;
use std::io;
use std::ops::Deref;
use std::path::{Path, PathBuf};
use std::time::Duration;

use nix::sys::signal::Signal;

use crate::process::cgroup::Cgroup;
use crate::process::program::{ProcessEntry, ProcessIdentity, environments};
use crate::system::clock::boot_id;

/// The variable that identifies a run's processes: the path of its run directory. No other run
/// shares this path, not even a run of the same deployment by a second agent on this machine.
pub const RUN_DIR_VARIABLE: &str = "TASKD_RUN_DIR";
/// The variable that names the deployment in every process of a task.
pub const ASSIGNMENT_VARIABLE: &str = "TASKD_ASSIGNMENT";
/// Maximum rounds of killing a set of processes that goes on forking, before the set counts as not
/// killable.
const MAX_ROUNDS: usize = 100;

/// The processes of one run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Containment {
    marker: String,
    shim: Option<ProcessIdentity>,
    cgroup: Option<Cgroup>,
}

/// Errors of killing a run's processes.
#[derive(Debug, thiserror::Error)]
pub enum ContainmentError {
    /// The process table could not be read, or a process could not be signalled.
    #[error("cannot read the process table")]
    Io(#[from] io::Error),
    /// Processes that SIGKILL did not end in time: they hang in the kernel.
    #[error("processes {pids:?} do not end, even after SIGKILL")]
    Survivors { pids: Vec<u32> },
}

/// Kills all members when it is dropped. Use it for processes that must not outlive the code that
/// waits for them.
#[derive(Debug)]
pub struct KillOnDrop(Containment);

impl Containment {
    /// The processes that were started for the directory `dir`, those below `shim`, and those in
    /// the control group with the directory `cgroup`.
    pub fn new(dir: &Path, shim: Option<ProcessIdentity>, cgroup: Option<PathBuf>) -> Self {
        let marker = format!("{RUN_DIR_VARIABLE}={}", dir.display());
        Self { marker, shim, cgroup: cgroup.map(Cgroup::at) }
    }

    /// The members that are alive now.
    pub fn members(&self) -> io::Result<Vec<ProcessIdentity>> {
        Ok(self.entries()?.1)
    }

    /// Sends `signal` to the members of process group `group`.
    pub fn signal_group(&self, group: u32, signal: Signal) -> io::Result<()> {
        let (table, members) = self.entries()?;
        let in_group: HashSet<u32> =
            table.iter().filter(|e| e.group == group).map(|e| e.pid).collect();
        signal_each(members.iter().filter(|member| in_group.contains(&member.pid)), signal)
    }

    /// Sends `signal` to all members.
    pub fn signal_all(&self, signal: Signal) -> io::Result<()> {
        signal_each(&self.members()?, signal)
    }

    /// Whether the kernel killed members because they had used up their memory.
    pub fn is_out_of_memory(&self) -> bool {
        self.cgroup.as_ref().is_some_and(Cgroup::is_out_of_memory)
    }

    /// Removes the control group. Call this only once no member is left.
    pub fn remove(&self) -> io::Result<()> {
        self.cgroup.as_ref().map_or(Ok(()), Cgroup::remove)
    }

    /// Kills all members: first those in the control group, together, then the others. The others
    /// are stopped first, until a look finds no new one, so that none forks between the look and
    /// the kill. Returns the killed processes; they may take a moment to be gone.
    pub fn kill(&self) -> io::Result<Vec<ProcessIdentity>> {
        if let Some(cgroup) = &self.cgroup {
            cgroup.kill()?;
        }
        let mut stopped = HashSet::new();
        for _ in 0..MAX_ROUNDS {
            let new: Vec<_> =
                self.members()?.into_iter().filter(|member| !stopped.contains(member)).collect();
            if new.is_empty() {
                break;
            }
            // The result does not matter: the SIGKILL below goes to all of them and gives the
            // error.
            let _ = signal_each(&new, Signal::SIGSTOP);
            stopped.extend(new);
        }
        let killed: Vec<_> = stopped.into_iter().collect();
        signal_each(&killed, Signal::SIGKILL)?;
        Ok(killed)
    }

    /// Kills all members and waits until they are gone. Afterwards no member is left, and the
    /// control group is removed.
    pub async fn end(&self, timeout: Duration) -> Result<(), ContainmentError> {
        let ended = tokio::time::timeout(timeout, async {
            loop {
                let killed = self.in_background(Self::kill).await?;
                if killed.is_empty() {
                    return Ok(());
                }
                for member in killed {
                    if let Some(handle) = member.open()? {
                        handle.ended().await?;
                    }
                }
            }
        });
        match ended.await {
            Ok(Ok(())) => Ok(self.in_background(Self::remove).await?),
            Ok(failed) => failed,
            Err(_) => {
                let pids = self
                    .in_background(Self::members)
                    .await?
                    .into_iter()
                    .map(|member| member.pid)
                    .collect();
                Err(ContainmentError::Survivors { pids })
            }
        }
    }

    /// Runs work that scans the whole process table on a thread that may block.
    pub async fn in_background<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Self) -> io::Result<T> + Send + 'static,
    ) -> io::Result<T> {
        let own = self.clone();
        tokio::task::spawn_blocking(move || work(&own)).await.map_err(io::Error::from).flatten()
    }

    fn entries(&self) -> io::Result<(Vec<ProcessEntry>, Vec<ProcessIdentity>)> {
        let boot_id = boot_id()?;
        let mut table = ProcessEntry::all()?;
        let below = match &self.shim {
            Some(shim) if shim.is_alive() => descendants(&table, shim.pid),
            _ => HashSet::new(),
        };
        let grouped = self.cgroup.as_ref().map_or(Ok(Vec::new()), grouped)?;
        let mut known: HashSet<u32> = grouped.iter().map(|entry| entry.pid).chain(below).collect();
        // Only the other processes need a look into their environment.
        let others = table
            .iter()
            .filter(|entry| !known.contains(&entry.pid) && !entry.is_zombie)
            .copied()
            .collect();
        let marker = self.marker.clone();
        let marked = environments::read_all(others, move |entry| entry.was_started_with(&marker));
        known
            .extend(marked.into_iter().filter(|(_, is_ours)| *is_ours).map(|(entry, _)| entry.pid));
        // The group's entries were read later than the table, so their pids are more current.
        table.retain(|entry| grouped.iter().all(|later| later.pid != entry.pid));
        table.extend(grouped);
        let is_member = |entry: &&ProcessEntry| !entry.is_zombie && known.contains(&entry.pid);
        let members =
            table.iter().filter(is_member).map(|entry| entry.identity(&boot_id)).collect();
        Ok((table, members))
    }
}

impl KillOnDrop {
    /// Kills all processes of `containment` when it is dropped.
    pub fn new(containment: Containment) -> Self {
        Self(containment)
    }
}

impl Deref for KillOnDrop {
    type Target = Containment;

    fn deref(&self) -> &Containment {
        &self.0
    }
}

impl Drop for KillOnDrop {
    fn drop(&mut self) {
        // A later start of the same run checks again.
        let _ = self.0.kill();
        let killed = self.0.clone();
        std::thread::spawn(move || killed.remove());
    }
}

/// The processes in a control group. A pid counts only if it is in the group both before and after
/// its entry is read, so a later process with the same pid is not mistaken for a member.
fn grouped(cgroup: &Cgroup) -> io::Result<Vec<ProcessEntry>> {
    for _ in 0..MAX_ROUNDS {
        let before = cgroup.pids()?;
        let read: Vec<_> =
            before.iter().filter_map(|pid| ProcessEntry::of(*pid).ok().flatten()).collect();
        let after: HashSet<u32> = cgroup.pids()?.into_iter().collect();
        let sure: Vec<_> = read.into_iter().filter(|entry| after.contains(&entry.pid)).collect();
        if !sure.is_empty() || after.is_empty() {
            return Ok(sure);
        }
    }
    Err(io::Error::other(format!(
        "the processes in {} change too quickly",
        cgroup.path().display()
    )))
}

/// Signals all processes, even if one of them can't be signalled, and then returns the last error.
/// A process that this one may not signal, such as a program that a task runs by sudo, is no error:
/// the others get the signal, a control group ends that process all the same, and
/// [`Containment::end`] names it if it lives on.
pub fn signal_each<'a>(
    members: impl IntoIterator<Item = &'a ProcessIdentity>,
    signal: Signal,
) -> io::Result<()> {
    let failed = members.into_iter().filter_map(|member| match member.signal(signal) {
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
            tracing::warn!(
                pid = member.pid,
                signal = signal.as_str(),
                "no permission to signal a process of a task"
            );
            None
        }
        signalled => signalled.err(),
    });
    failed.last().map_or(Ok(()), Err)
}

fn descendants(table: &[ProcessEntry], ancestor: u32) -> HashSet<u32> {
    let mut below = HashSet::new();
    let mut parents = vec![ancestor];
    while let Some(parent) = parents.pop() {
        let children = table.iter().filter(|entry| entry.parent == parent).map(|entry| entry.pid);
        parents.extend(children.filter(|pid| below.insert(*pid)));
    }
    below
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(pid: u32, parent: u32) -> ProcessEntry {
        ProcessEntry { pid, parent, group: pid, start_ticks: 0, is_zombie: false }
    }

    #[test]
    fn descendants_are_found_in_any_order_and_cycles_end() {
        let table = [entry(5, 4), entry(4, 2), entry(2, 1), entry(3, 1), entry(9, 9)];
        assert_eq!(descendants(&table, 2), HashSet::from([4, 5]));
        assert_eq!(descendants(&table, 9), HashSet::from([9]));
        assert_eq!(descendants(&table, 7), HashSet::new());
    }

    #[test]
    fn unused_directory_has_no_members() {
        let containment = Containment::new(
            Path::new("/nonexistent/run"),
            None,
            Some("/nonexistent/cgroup".into()),
        );
        assert_eq!(containment.members().expect("table"), []);
    }
}
