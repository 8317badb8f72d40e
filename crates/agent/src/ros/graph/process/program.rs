//! The program that takes part in the graph for the agent, and its confinement: an account without
//! rights, little memory, no capabilities, no way to gain more rights, and nothing of the agent's
//! but two pipes.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use tokio::process::Child;

use crate::process::cgroup::{Cgroups, RunLimits};
use crate::process::confinement::Confinement;
use crate::process::program;
use crate::system::task_user::TaskUser;

/// The program's account, if the robot has it.
pub const ACCOUNT: &str = "taskd-graph";
/// The program's memory limit. An idle program takes 10 MB; a graph of thousands of nodes takes
/// tens.
pub const MEMORY_BYTES: u64 = 256 << 20;
/// Maximum number of threads: a dozen belong to the DDS library.
const MAX_THREADS: u64 = 64;
/// Added to the agent's niceness: data from untrusted senders must not slow down the robot's tasks.
const NICE: i32 = 5;
/// Id of the user `nobody`, for robots without another account.
const NOBODY: u32 = 65_534;
/// The only variables that the program gets from the agent: filter and form of its log.
const LOG_VARIABLES: [&str; 3] = ["TASK_AGENT_LOG", "TASK_AGENT_LOG_FORMAT", "JOURNAL_STREAM"];

/// Settings for starting the program.
#[derive(Debug, Clone)]
pub struct GraphProgram {
    path: PathBuf,
    account: Option<TaskUser>,
    /// Parent of the program's control group, and the directory that its group is named for.
    group: Option<(Cgroups, PathBuf)>,
}

impl GraphProgram {
    /// The agent's own program, for the agent with the data in `data` and with tasks that run as
    /// `task_user`.
    pub fn of_this_agent(
        data: &Path,
        cgroups: Option<Cgroups>,
        task_user: Option<&TaskUser>,
    ) -> Self {
        let group = cgroups.map(|cgroups| (cgroups, data.join("graph")));
        Self { path: "/proc/self/exe".into(), account: account(task_user), group }
    }

    /// The agent's program at `path`, with the same rights as for an agent, but without a control
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
        // Only the group limits the threads: the account may have other processes.
        let limits = RunLimits { pids: None, ..limits };
        let confinement =
            Confinement::new(&self.path, group.as_ref(), &limits, self.account.as_ref())?;
        let environment: BTreeMap<_, _> = LOG_VARIABLES
            .iter()
            .filter_map(|name| Some(((*name).to_owned(), std::env::var(name).ok()?)))
            .collect();
        program::spawn_graph(&self.path, &environment, NICE, MEMORY_BYTES, confinement)
    }

    /// Removes the program's control group, once the program has ended.
    pub(super) async fn clean_up(&self) {
        let Some((cgroups, dir)) = self.group.clone() else { return };
        let removed = tokio::task::spawn_blocking(move || cgroups.group(&dir).remove()).await;
        if let Ok(Err(error)) = removed {
            tracing::debug!(%error, "the control group of the ROS graph stays");
        }
    }
}

/// The program's account: never root. An agent that is not root has no choice.
fn account(task_user: Option<&TaskUser>) -> Option<TaskUser> {
    if !nix::unistd::geteuid().is_root() {
        return None;
    }
    let own = TaskUser::find(Some(ACCOUNT)).ok().flatten();
    let nobody =
        || TaskUser { name: NOBODY.to_string(), uid: NOBODY, gid: NOBODY, groups: Vec::new() };
    let user = own.or_else(|| task_user.cloned()).unwrap_or_else(nobody);
    // The program opens no device.
    Some(TaskUser { groups: Vec::new(), ..user })
}
