//! The program that takes part in the graph for the agent, and what it is kept in: an account
//! without rights, little memory, no capabilities, no way to more of them, nothing of the agent's
//! but two pipes.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use tokio::process::Child;

use crate::process::cgroup::{Cgroups, RunLimits};
use crate::process::confinement::Confinement;
use crate::process::program;
use crate::system::task_user::TaskUser;

/// The account that the program has where the robot has it.
pub const ACCOUNT: &str = "taskd-graph";
/// The memory it may have. Idle it takes 10 MB; a graph of thousands of nodes takes tens.
pub const MEMORY_BYTES: u64 = 256 << 20;
/// Its threads: a dozen belong to the DDS library.
const MAX_THREADS: u64 = 64;
/// Added to the agent's niceness: what strangers send must not keep the robot from its tasks.
const NICE: i32 = 5;
/// Who it is where there is no other account: `nobody`.
const NOBODY: u32 = 65_534;
/// The one variable of the agent's that it is given.
const LOG_VARIABLE: &str = "TASK_AGENT_LOG";

/// How the program is started.
#[derive(Debug, Clone)]
pub struct GraphProgram {
    path: PathBuf,
    account: Option<TaskUser>,
    /// Where groups are made, and the directory that its own is named for.
    group: Option<(Cgroups, PathBuf)>,
}

impl GraphProgram {
    /// The agent's own program, for the agent whose data is in `data` and whose tasks run as
    /// `task_user`.
    pub fn of_this_agent(
        data: &Path,
        cgroups: Option<Cgroups>,
        task_user: Option<&TaskUser>,
    ) -> Self {
        let group = cgroups.map(|cgroups| (cgroups, data.join("graph")));
        Self { path: "/proc/self/exe".into(), account: account(task_user), group }
    }

    /// The agent's program at `path`, with the rights that an agent's has, but without a control
    /// group.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into(), account: account(None), group: None }
    }

    pub(super) fn start(&self) -> io::Result<Child> {
        let limits = RunLimits {
            memory_bytes: Some(MEMORY_BYTES),
            cpu_weight: None,
            pids: Some(MAX_THREADS),
            filter_calls: true,
        };
        let group = self.group.as_ref().and_then(|(cgroups, dir)| {
            let made = cgroups.create(dir, &limits);
            made.inspect_err(|error| tracing::warn!(%error, "the ROS graph has no control group"))
                .ok()
        });
        // The threads are limited by the group alone: the account may have other processes.
        let limits = RunLimits { pids: None, ..limits };
        let confinement =
            Confinement::new(&self.path, group.as_ref(), &limits, self.account.as_ref())?;
        let environment: BTreeMap<_, _> = std::env::var(LOG_VARIABLE)
            .ok()
            .map(|value| (LOG_VARIABLE.to_owned(), value))
            .into_iter()
            .collect();
        program::spawn_graph(&self.path, &environment, NICE, MEMORY_BYTES, confinement)
    }

    /// Removes what was made for it, once it has ended.
    pub(super) async fn clean_up(&self) {
        let Some((cgroups, dir)) = self.group.clone() else { return };
        let removed = tokio::task::spawn_blocking(move || cgroups.group(&dir).remove()).await;
        if let Ok(Err(error)) = removed {
            tracing::debug!(%error, "the control group of the ROS graph stays");
        }
    }
}

/// Who the program is: never root. An agent that is not root has no choice.
fn account(task_user: Option<&TaskUser>) -> Option<TaskUser> {
    if !nix::unistd::geteuid().is_root() {
        return None;
    }
    let own = TaskUser::find(Some(ACCOUNT)).ok().flatten();
    let nobody =
        || TaskUser { name: NOBODY.to_string(), uid: NOBODY, gid: NOBODY, groups: Vec::new() };
    let user = own.or_else(|| task_user.cloned()).unwrap_or_else(nobody);
    // It opens no device.
    Some(TaskUser { groups: Vec::new(), ..user })
}
