//! Decides about the output files of ended runs. Pure, like the plan.
//!
//! The ledger records the end of a run before its files are uploaded, so a job never runs again for
//! the sake of its files. A job's end is reported once its files are uploaded or given up.

use task_proto::manifest::TaskKind;

use super::{Next, Situation, Step, record, transition};
use crate::task::ledger::{ActiveRun, Collection, TaskRecord};

/// How long the upload is attempted, within one boot of the robot.
const GIVE_UP_MS: u64 = 24 * 60 * 60 * 1000;
/// The maximum number of ended runs that wait for their upload; beyond this the oldest is given up.
const MAX_WAITING: usize = 4;

/// The next step of the upload of ended runs' files.
pub fn collect(s: &Situation<'_>) -> Next {
    let Some(collection) =
        s.record.collections.first().filter(|_| s.desired.is_some() && !s.deleting)
    else {
        return Next::Rest { until_ms: None };
    };
    let give_up_ms = collection.since_ms + GIVE_UP_MS;
    if s.now_ms >= give_up_ms || s.record.collections.len() > MAX_WAITING {
        return record(transition::gave_up_files(s, collection));
    }
    if s.now_ms < collection.retry_at_ms {
        return Next::Rest { until_ms: Some(collection.retry_at_ms.min(give_up_ms)) };
    }
    Next::Act(Step::Collect(Box::new(collection.clone())))
}

/// Whether a job's files still lie where a process of `run` would write. A service does not wait
/// for its last files.
pub(super) fn occupies(record: &TaskRecord, run: &ActiveRun) -> bool {
    let is_in_the_way =
        |files: &Collection| files.package == run.package && files.kind == TaskKind::Job;
    record.collections.iter().any(is_in_the_way)
}

impl Collection {
    /// The output files of `run`, which is over.
    pub fn of(run: &ActiveRun, now_ms: u64) -> Self {
        Self {
            deployment: run.deployment.clone(),
            run: run.run,
            package: run.package.clone(),
            kind: run.rules.kind,
            since_ms: now_ms,
            attempts: 0,
            retry_at_ms: 0,
            failure: None,
        }
    }
}
