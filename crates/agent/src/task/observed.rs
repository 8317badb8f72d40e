//! The observed state of the robot, independent of the ledger: processes, their health on the ROS
//! graph, and the files on the disk. Plain values, filled by the effects and read by the plan.
//! Times are milliseconds since boot.

use std::collections::BTreeSet;

use task_proto::Digest;
use task_proto::ids::Labels;
use task_proto::messages::report::{Failure, FailureCode};
use task_proto::packages::manifest::{TaskKind, TaskManifest};
use task_proto::size::format_bytes;

use crate::process::program::ExitStatus;
use crate::setup::installation::{self, Installation};
use crate::setup::launch;

/// The files of one version on the disk, and the list of the task's versions.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Prepared {
    /// The version's manifest, once pulled and verified.
    pub manifest: Option<TaskManifest>,
    /// Whether the content is unpacked.
    pub content: bool,
    /// Whether the version is built or needs no build.
    pub built: bool,
    /// Every version of the task that has a directory.
    pub versions: Vec<Digest>,
    /// Whether this robot may run the version, by the signatures known so far.
    pub signatures: SignatureVerdict,
}

impl Prepared {
    /// Service or job, once the manifest is there.
    pub fn kind(&self) -> Option<TaskKind> {
        self.manifest.as_ref().map(|manifest| manifest.run.kind)
    }
}

/// The verdict on the signatures on the disk.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum SignatureVerdict {
    /// There are no signatures, or not enough.
    #[default]
    Insufficient,
    /// The version may keep running; new work needs a newer list of publishers.
    Stale,
    /// The version may run. On a robot that trusts its server alone, every version may.
    Sufficient,
}

/// The facts by which a robot decides whether a package is trusted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TrustFacts {
    /// Changes whenever the verdict on a package may have changed.
    pub epoch: u64,
    /// Whether the list of publishers has expired, so that no new work begins.
    pub list_expired: bool,
    /// Why the newest list of publishers was rejected, if it was.
    pub refused_list: Option<String>,
}

/// The observed state of a process in the ledger.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ProcessState {
    /// The ledger has no process.
    None,
    Alive {
        pid: u32,
    },
    /// The state cannot be determined now.
    Unknown,
    /// The process was about to be started and was not.
    NeverStarted,
    Ended(Exit),
}

/// How a process ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exit {
    /// The exit code or signal; `None` when the process and its shim disappeared without a status.
    pub status: Option<ExitStatus>,
    /// The memory limit, if the process was killed for exceeding it.
    pub out_of_memory_bytes: Option<u64>,
    /// The last lines of the process's output.
    pub last_lines: String,
}

/// The health of a run with a live process: the ROS graph compared with the promises in `[ready]`
/// of its package.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Health {
    #[default]
    Unknown,
    Holds {
        /// The time since which all promises have held without a break.
        since_ms: u64,
    },
    /// A requirement is missing and may still appear.
    Missing(Missing),
    /// A failure that waiting does not mend: `node_name_taken`, `parameter_rejected`,
    /// `lifecycle_failed`. Occurs only before the run was ready.
    Refused(Failure),
}

/// A promised part of the graph that is absent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Missing {
    /// The time since which something has been missing without a break.
    pub since_ms: u64,
    /// The failure code for a task that was ready before: `node_vanished`, `node_inactive`,
    /// `topic_silent`, `service_lost`, `graph_unavailable`.
    pub code: FailureCode,
    /// The absence, as a sentence without its end: "`/mapper` did not appear".
    pub what: String,
    /// The parts that are present instead: "on the graph: `/lidar`, `/odom`". May be empty.
    pub seen: String,
    /// Whether the run itself lacks something, so that a restart may help. False if a stranger on
    /// the graph is the cause, or if the agent sees nothing.
    pub is_own_fault: bool,
}

/// Facts about the robot that a package may require.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RobotFacts {
    pub arch: String,
    /// The labels that the server holds; `None` until the server has sent them.
    pub labels: Option<Labels>,
    /// The ROS installations, the best last; `None` while they still have to be inspected.
    pub installations: Option<Vec<Installation>>,
    /// Why there is no user to run tasks as, if there is none.
    pub no_task_user: Option<String>,
}

impl RobotFacts {
    /// Whether we must know this robot's ROS to decide if `manifest` can run here.
    pub fn needs_ros_facts(manifest: &TaskManifest) -> bool {
        launch::of(manifest).ros.is_some()
            || !manifest.requires.ros_distro.is_empty()
            || !manifest.exec_depends.is_empty()
    }

    /// The unmet requirements of `manifest`, each as a sentence part. Empty if the robot meets all
    /// requirements that can be checked.
    pub fn lacks(&self, manifest: &TaskManifest) -> Vec<String> {
        let requires = &manifest.requires;
        let mut lacks = Vec::new();
        for (key, value) in &requires.labels {
            match self.labels.as_ref().and_then(|labels| labels.get(key)) {
                Some(have) if have == value => {}
                Some(have) => lacks.push(format!("label {key}={value} (it has {key}={have})")),
                None => lacks.push(format!("label {key}={value}")),
            }
        }
        if !requires.arch.is_empty() && !requires.arch.contains(&self.arch) {
            lacks.push(format!("arch {} (it is {})", requires.arch.join(" or "), self.arch));
        }
        let Some(installations) = &self.installations else { return lacks };
        let launcher = launch::of(manifest);
        let lacks_of = |chosen: &Installation| -> Vec<String> {
            let needed = manifest.exec_depends.iter().map(String::as_str).chain(launcher.package);
            chosen
                .missing_packages(needed)
                .into_iter()
                .map(|name| format!("ROS package {name}"))
                .collect()
        };
        lacks.extend(
            match installation::choose(installations, launcher.ros, &requires.ros_distro) {
                Ok(Some(chosen)) => lacks_of(chosen),
                Ok(None) => lacks_of(&Installation {
                    packages: Some(BTreeSet::new()),
                    ..Installation::default()
                }),
                Err(error) => vec![error.to_string()],
            },
        );
        lacks
    }
}

impl Missing {
    /// The failure of a task that was ready before.
    pub fn failure(&self) -> Failure {
        Failure::new(self.code.clone(), self.sentence(""))
    }

    /// The failure of a task that was not ready within its timeout.
    pub fn timeout_failure(&self, timeout_s: u32) -> Failure {
        Failure::new(FailureCode::NOT_READY, self.sentence(&format!(" within {timeout_s} s")))
    }

    fn sentence(&self, when: &str) -> String {
        let (what, seen) = (&self.what, &self.seen);
        if seen.is_empty() { format!("{what}{when}") } else { format!("{what}{when}; {seen}") }
    }
}

impl Exit {
    /// Whether the process exited with code 0.
    pub fn is_success(&self) -> bool {
        self.status == Some(ExitStatus::Code(0))
    }

    /// The failure that describes this exit, with the last lines of output.
    pub fn failure(&self) -> Failure {
        let (code, end) = match (self.out_of_memory_bytes, self.status) {
            (Some(limit), _) => {
                let end =
                    format!("killed: it exceeded its memory limit of {}", format_bytes(limit));
                (FailureCode::OUT_OF_MEMORY, end)
            }
            (None, Some(status)) => (FailureCode::PROCESS_EXITED, status.to_string()),
            (None, None) => (FailureCode::PROCESS_EXITED, "gone without an exit status".to_owned()),
        };
        Failure::new(code, self.text(&end))
    }

    fn text(&self, end: &str) -> String {
        if self.last_lines.trim().is_empty() {
            format!("the process ended ({end}) without output")
        } else {
            format!("the process ended ({end}); its last lines:\n{}", self.last_lines.trim_end())
        }
    }
}

#[cfg(test)]
mod tests {
    use task_proto::packages::manifest::Requires;

    use super::*;
    use crate::setup::installation::RosVersion;

    fn manifest(tool: &str, exec_depends: &[&str]) -> TaskManifest {
        serde_json::from_value(serde_json::json!({
            "name": "talker", "version": "1.0.0", "build": {"tool": tool}, "run": {"exec": ["true"]},
            "exec_depends": exec_depends,
            "content": {"tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0},
        }))
        .expect("manifest")
    }

    fn robot(installations: Vec<Installation>) -> RobotFacts {
        let installations = Some(installations);
        RobotFacts {
            arch: "x86_64".to_owned(),
            labels: Some(Labels::new()),
            installations,
            no_task_user: None,
        }
    }

    fn jazzy() -> Installation {
        Installation {
            distros: vec!["jazzy".to_owned()],
            versions: vec![RosVersion::Ros2],
            packages: Some(["std_msgs".to_owned()].into()),
            ..Installation::default()
        }
    }

    #[test]
    fn missing_failure_names_present_nodes() {
        let mut missing = Missing {
            is_own_fault: true,
            since_ms: 0,
            code: FailureCode::NODE_VANISHED,
            what: "`/mapper` did not appear".to_owned(),
            seen: "on the graph: `/lidar`, `/odom`".to_owned(),
        };
        let failure = missing.timeout_failure(30);
        assert_eq!(
            failure.to_string(),
            "not_ready: `/mapper` did not appear within 30 s; on the graph: `/lidar`, `/odom`"
        );
        missing.seen.clear();
        assert_eq!(missing.failure().to_string(), "node_vanished: `/mapper` did not appear");
    }

    #[test]
    fn unmet_requirements_are_listed_by_manifest_key() {
        let mut robot = robot(vec![jazzy()]);
        robot.labels =
            Some([("base".parse().expect("valid"), "husky".parse().expect("valid"))].into());
        let mut manifest =
            manifest("colcon", &["std_msgs", "nav2_bringup", "python3-numpy", "slam_toolbox"]);
        manifest
            .requires
            .labels
            .insert("base".parse().expect("valid"), "turtlebot".parse().expect("valid"));
        manifest.requires.arch = vec!["aarch64".to_owned()];
        assert_eq!(
            robot.lacks(&manifest),
            [
                "label base=turtlebot (it has base=husky)",
                "arch aarch64 (it is x86_64)",
                "ROS package nav2_bringup",
                "ROS package slam_toolbox",
            ]
        );
        manifest.requires =
            Requires { ros_distro: vec!["humble".to_owned()], ..Requires::default() };
        assert_eq!(robot.lacks(&manifest), ["ros_distro humble (it has jazzy)"]);
        manifest.requires.ros_distro = vec!["jazzy".to_owned()];
        manifest.exec_depends.truncate(1);
        assert!(robot.lacks(&manifest).is_empty());
    }

    #[test]
    fn robot_without_ros_lacks_it_for_ros_packages_only() {
        let robot = robot(Vec::new());
        assert_eq!(robot.lacks(&manifest("colcon", &["rclpy"])), ["ROS 2 (no ROS 2 found)"]);
        assert_eq!(robot.lacks(&manifest("catkin", &["rospy"])), ["ROS 1 (no ROS 1 found)"]);
        assert_eq!(
            robot.lacks(&manifest("none", &["nav_msgs", "ffmpeg"])),
            ["ROS package nav_msgs"]
        );
        assert!(robot.lacks(&manifest("none", &["ffmpeg"])).is_empty());
        assert!(!RobotFacts::needs_ros_facts(&manifest("none", &[])));
        assert!(RobotFacts::needs_ros_facts(&manifest("colcon", &[])));
    }
}
