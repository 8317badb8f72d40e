//! The form of a run in the ledger and in its run directory. Agents before and after this one read
//! it, so its fields stay; it decides nothing.

use serde::{Deserialize, Serialize};
use task_proto::DeploymentId;
use task_proto::desired::PackageRef;

use super::{ActiveRun, End, Milestone, PendingStop, ProcessRecord, RunRules, RunState};

/// A run as it is written.
#[derive(Serialize, Deserialize)]
pub(super) struct RunRecord {
    deployment: DeploymentId,
    run: u64,
    package: PackageRef,
    rules: RunRules,
    process: Option<StoredProcess>,
    restarts: u32,
    restarts_in_a_row: u32,
    retry_at_ms: u64,
    first_start_ms: u64,
    ever_ready: bool,
    #[serde(default)]
    admitted: bool,
    #[serde(default)]
    ever_started: bool,
    end: Option<End>,
}

/// A process as it is written.
#[derive(Serialize, Deserialize)]
struct StoredProcess {
    dir: String,
    boot_id: String,
    started_ms: u64,
    pid: Option<u32>,
    ready: bool,
    #[serde(default)]
    condemned: Option<PendingStop>,
}

impl From<RunRecord> for ActiveRun {
    fn from(stored: RunRecord) -> Self {
        let state = match (stored.process, stored.end) {
            // A process that may live comes first: its end is observed again.
            (Some(process), _) => process.into(),
            (None, Some(end)) => RunState::Over(end),
            (None, None) => RunState::Waiting,
        };
        let reached = match (stored.ever_ready, stored.ever_started) {
            // The first agents recorded readiness alone.
            (true, _) => Milestone::Ready,
            (false, true) => Milestone::Started,
            (false, false) => Milestone::None,
        };
        Self {
            deployment: stored.deployment,
            run: stored.run,
            package: stored.package,
            rules: stored.rules,
            state,
            reached,
            admitted: stored.admitted,
            restarts: stored.restarts,
            restarts_in_a_row: stored.restarts_in_a_row,
            retry_at_ms: stored.retry_at_ms,
            first_start_ms: stored.first_start_ms,
        }
    }
}

impl From<ActiveRun> for RunRecord {
    fn from(run: ActiveRun) -> Self {
        let (process, end) = match run.state {
            RunState::Waiting => (None, None),
            RunState::Starting(process) => (Some(StoredProcess::of(process, false, None)), None),
            RunState::Up(process) => (Some(StoredProcess::of(process, true, None)), None),
            RunState::Stopping { process, was_ready, pending_stop } => {
                (Some(StoredProcess::of(process, was_ready, Some(pending_stop))), None)
            }
            RunState::Over(end) => (None, Some(end)),
        };
        Self {
            deployment: run.deployment,
            run: run.run,
            package: run.package,
            rules: run.rules,
            process,
            restarts: run.restarts,
            restarts_in_a_row: run.restarts_in_a_row,
            retry_at_ms: run.retry_at_ms,
            first_start_ms: run.first_start_ms,
            ever_ready: run.reached == Milestone::Ready,
            admitted: run.admitted,
            ever_started: run.reached >= Milestone::Started,
            end,
        }
    }
}

impl From<StoredProcess> for RunState {
    fn from(stored: StoredProcess) -> Self {
        let StoredProcess { dir, boot_id, started_ms, pid, ready: was_ready, condemned } = stored;
        let process = ProcessRecord { dir, boot_id, started_ms, pid };
        match condemned {
            Some(pending_stop) => Self::Stopping { process, was_ready, pending_stop },
            None if was_ready => Self::Up(process),
            None => Self::Starting(process),
        }
    }
}

impl StoredProcess {
    fn of(process: ProcessRecord, ready: bool, condemned: Option<PendingStop>) -> Self {
        let ProcessRecord { dir, boot_id, started_ms, pid } = process;
        Self { dir, boot_id, started_ms, pid, ready, condemned }
    }
}
