//! Orders on tasks that robots have: start, stop, remove.

use task_proto::TaskName;
use task_proto::api::MatchedRobot;
use task_proto::selector::Selector;

use super::{ActionError, Actions, IdempotencyKey, TaskOrder};

impl Actions {
    /// Orders `task` started, stopped or removed on the robots that match and have it. The same key gives the same
    /// answer, and orders nothing twice. `online` is left false.
    pub async fn order_task(
        &self,
        key: &IdempotencyKey,
        order: TaskOrder,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Vec<MatchedRobot>, ActionError> {
        todo!()
    }

    /// Whom [`Actions::order_task`] would mean.
    pub async fn robots_with_task(
        &self,
        task: &TaskName,
        selector: &Selector,
    ) -> Result<Vec<MatchedRobot>, ActionError> {
        todo!()
    }
}
