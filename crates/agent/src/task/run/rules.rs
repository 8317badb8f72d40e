//! The rules of a run, as stored in the ledger: the package's manifest may be gone by then.

use serde::{Deserialize, Serialize};
use task_proto::packages::manifest::{OnBoot, Restart, TaskKind, TaskManifest};

/// The parts of a task manifest that matter while the task runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunRules {
    pub kind: TaskKind,
    /// The effect of a reboot.
    pub on_boot: OnBoot,
    /// When a process that ended is restarted.
    pub restart: Restart,
    /// Whether an interrupted job may be started again.
    pub idempotent: bool,
    /// Seconds between the signals of a stop.
    pub stop_timeout_s: u32,
    /// Seconds that all conditions must hold before the run is ready.
    pub hold_s: u32,
    /// Seconds in which a process must become ready, and for which it may stay degraded.
    pub ready_timeout_s: u32,
    /// Seconds a job may run.
    #[serde(default)]
    pub deadline_s: Option<u32>,
    /// Whether output files are uploaded once the run is over.
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
