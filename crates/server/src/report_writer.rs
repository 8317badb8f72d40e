//! The one writer of reports: a bounded queue, emptied in batches, each one transaction. A caller's future resolves when
//! its report is stored.

use task_proto::RobotId;
use task_proto::api::ReportReply;
use task_proto::report::Report;
use tokio::task::JoinHandle;

use crate::changes::Changes;
use crate::clock::Clock;
use crate::store::Store;

/// Where reports are handed in. Clones feed the same writer; it ends when the last is dropped.
#[derive(Debug, Clone)]
pub struct ReportWriter;

/// Why a report was not stored. The robot keeps it and sends it again.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// No such robot, or no longer.
    #[error("there is no robot {0}")]
    RobotNotFound(RobotId),
    /// The queue is full, or the server is stopping.
    #[error("reports can't be taken now")]
    Busy,
    /// The database did not take it.
    #[error("the report could not be stored")]
    NotStored,
}

impl ReportWriter {
    /// Starts the writer. The task ends, after all that was handed in, when the last clone is dropped.
    pub fn start(store: Store, clock: Clock, changes: Changes) -> (Self, JoinHandle<()>) {
        todo!()
    }

    /// Stores `report`, whose `robot_id` the caller has authenticated. Resolves after the commit.
    pub async fn submit(&self, report: Report) -> Result<ReportReply, ReportError> {
        todo!()
    }
}
