//! How a run is to be run, as the ledger keeps it: the package's manifest need not be there any
//! more.

use serde::{Deserialize, Serialize};
use task_proto::manifest::{OnBoot, Restart, TaskKind, TaskManifest};

/// What of a task manifest matters while the task runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunRules {
    /// Service or job.
    pub kind: TaskKind,
    /// What a reboot does.
    pub on_boot: OnBoot,
    /// When a process that ended is started again.
    pub restart: Restart,
    /// Whether an interrupted job may be started again.
    pub idempotent: bool,
    /// Seconds between the signals of a stop.
    pub stop_timeout_s: u32,
    /// Seconds that all must hold before it is ready.
    pub hold_s: u32,
    /// Seconds in which a process must get ready, and for how long it may be degraded.
    pub ready_timeout_s: u32,
    /// Seconds a job may run.
    #[serde(default)]
    pub deadline_s: Option<u32>,
    /// Whether files are to be brought back once it is over.
    #[serde(default)]
    pub has_outputs: bool,
}

impl From<&TaskManifest> for RunRules {
    fn from(manifest: &TaskManifest) -> Self {
        Self {
            kind: manifest.run.kind,
            on_boot: manifest.run.on_boot,
            restart: manifest.run.restart,
            idempotent: manifest.run.idempotent,
            stop_timeout_s: manifest.run.stop_timeout_s,
            hold_s: manifest.ready.hold_s,
            ready_timeout_s: manifest.ready.timeout_s,
            deadline_s: manifest.run.deadline_s,
            has_outputs: !manifest.outputs.paths.is_empty(),
        }
    }
}
