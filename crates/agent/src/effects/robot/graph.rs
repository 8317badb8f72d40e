//! The robot's ROS graph, for those who only look: whoever answers questions about it and listens to what nodes say.

use std::collections::BTreeMap;

use task_proto::TaskName;
use task_proto::report::Failure;

use super::Robot;
use crate::graph::Graph;

impl Robot {
    /// The graph, opened if need be, once it can show who is there.
    pub async fn graph(&self) -> Result<Graph, Failure> {
        self.graph.settled(self.ros_facts().as_ref()).await
    }

    /// The processes of each task that has any.
    pub async fn task_pids(&self) -> BTreeMap<TaskName, Vec<u32>> {
        let mut processes = BTreeMap::new();
        for task in self.data.task_names().unwrap_or_default() {
            let mut pids = Vec::new();
            for run in super::other_runs(&self.data.task(&task).run(), None) {
                // A run directory without a run has no processes.
                pids.extend(self.supervisor.pids(&run).await.unwrap_or_default());
            }
            if !pids.is_empty() {
                processes.insert(task, pids);
            }
        }
        processes
    }
}
