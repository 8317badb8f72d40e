//! Read access to the robot's ROS graph, for the modules that answer questions about the graph and
//! collect the nodes' log messages.

use std::collections::BTreeMap;

use task_proto::TaskName;
use task_proto::desired::PackageRef;
use task_proto::messages::report::{Failure, RosFacts};

use super::Robot;
use super::runs::other_runs;
use crate::install::fetch;
use crate::ros::graph::Graph;
use crate::setup::installation::RosVersion;
use crate::setup::launch;

impl Robot {
    /// The graph, opened if necessary, once discovery can show its participants.
    pub async fn graph(&self) -> Result<Graph, Failure> {
        self.graph.open_after_discovery(self.ros_facts().as_ref()).await
    }

    /// Joins the ROS 2 graph in `facts` while this version runs, so that the log messages of its
    /// nodes are kept even if the package promises nothing about them.
    pub(super) fn open_graph(&self, package: &PackageRef, facts: Option<&RosFacts>) {
        let Some(manifest) = fetch::stored_manifest(&self.data, package) else { return };
        let is_ros_2 = match launch::of(&manifest).ros {
            Some(version) => version == RosVersion::Ros2,
            // An install tree lists its dependencies; other programs need no ROS.
            None => !manifest.exec_depends.is_empty(),
        };
        if let Some(facts) = facts.filter(|facts| is_ros_2 && facts.domain_id.is_some()).cloned() {
            let graph = self.graph.clone();
            // A failure to open the graph has been logged; the task runs all the same.
            tokio::spawn(async move { graph.open(Some(&facts)).await.is_ok() });
        }
    }

    /// The process ids of each task with live processes.
    pub async fn task_pids(&self) -> BTreeMap<TaskName, Vec<u32>> {
        let mut processes = BTreeMap::new();
        for task in self.data.task_names().unwrap_or_default() {
            let mut pids = Vec::new();
            for run in other_runs(&self.data.task(&task).run(), None) {
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
