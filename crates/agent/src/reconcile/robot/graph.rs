//! The robot's ROS graph, for those who only look: whoever answers questions about it and listens
//! to what nodes say.

use std::collections::BTreeMap;

use task_proto::TaskName;
use task_proto::desired::PackageRef;
use task_proto::report::{Failure, RosFacts};

use super::Robot;
use super::runs::other_runs;
use crate::install::fetch;
use crate::ros::graph::Graph;
use crate::setup::installation::RosVersion;
use crate::setup::launch;

impl Robot {
    /// The graph, opened if need be, once it can show who is there.
    pub async fn graph(&self) -> Result<Graph, Failure> {
        self.graph.settled(self.ros_facts().as_ref()).await
    }

    /// Takes part in the graph that `facts` say while this version runs, if it is one of ROS 2, so
    /// that what its nodes say is kept also where the package promises nothing about them.
    pub(super) fn listen_to(&self, package: &PackageRef, facts: Option<&RosFacts>) {
        let Some(manifest) = fetch::stored_manifest(&self.data, package) else { return };
        let is_ros_2 = match launch::of(&manifest).ros {
            Some(version) => version == RosVersion::Ros2,
            // An install tree names what it needs; other programs need nothing of ROS.
            None => !manifest.exec_depends.is_empty(),
        };
        if let Some(facts) = facts.filter(|facts| is_ros_2 && facts.domain_id.is_some()).cloned() {
            let graph = self.graph.clone();
            // A graph that can't be opened has been logged; the task runs all the same.
            tokio::spawn(async move { graph.open(Some(&facts)).await.is_ok() });
        }
    }

    /// The processes of each task that has any.
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
