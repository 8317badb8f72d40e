//! The form of a task's record in the ledger. Agents before and after this one read it, so its
//! fields stay; it decides nothing.

use serde::{Deserialize, Serialize};
use task_proto::desired::{DesiredTask, PackageRef};
use task_proto::messages::report::Phase;

use super::{FinishedRun, GateRecord, LostFiles, OutputUpload, Preparation, TaskRecord};
use crate::task::run::ActiveRun;

/// A task's record as it is written.
#[derive(Serialize, Deserialize)]
pub(super) struct StoredTask {
    order: DesiredTask,
    preparation: Preparation,
    active: Option<ActiveRun>,
    #[serde(default)]
    fallback: Option<ActiveRun>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    restoring: Option<Preparation>,
    previous: Option<PackageRef>,
    finished: Vec<FinishedRun>,
    #[serde(default)]
    collections: Vec<OutputUpload>,
    #[serde(default)]
    lost: Option<LostFiles>,
    #[serde(default)]
    gate: Option<GateRecord>,
    #[serde(default)]
    starts: u64,
    /// Written for earlier agents and for people: it follows from the other fields.
    phase: Phase,
    phase_since_ms: u64,
}

impl From<StoredTask> for TaskRecord {
    fn from(stored: StoredTask) -> Self {
        Self {
            order: stored.order,
            preparation: stored.preparation,
            active: stored.active,
            fallback: stored.fallback,
            restoring: stored.restoring,
            previous: stored.previous,
            finished: stored.finished,
            collections: stored.collections,
            lost: stored.lost,
            gate: stored.gate,
            starts: stored.starts,
            phase_since_ms: stored.phase_since_ms,
        }
    }
}

impl From<TaskRecord> for StoredTask {
    fn from(record: TaskRecord) -> Self {
        Self {
            phase: record.phase(),
            order: record.order,
            preparation: record.preparation,
            active: record.active,
            fallback: record.fallback,
            restoring: record.restoring,
            previous: record.previous,
            finished: record.finished,
            collections: record.collections,
            lost: record.lost,
            gate: record.gate,
            starts: record.starts,
            phase_since_ms: record.phase_since_ms,
        }
    }
}
