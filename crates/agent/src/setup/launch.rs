//! Launchers of tasks: `ros2 launch`, ROS 1's `roslaunch`, or a command from the package. Each
//! launcher gives a [`Launch`] with all data that scripts and stops need. Pure.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use task_proto::packages::manifest::{BuildTool, TaskManifest};

use crate::setup::installation::RosVersion;

/// The way a task is started, and the constraints for a stop.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Launch {
    /// The command and its arguments, as they reach the program: nothing in them is shell.
    pub command: Vec<String>,
    /// The processes that get the SIGINT with which a stop begins.
    pub interrupt: Interrupt,
    /// The ROS version that the launcher requires.
    pub ros: Option<RosVersion>,
    /// The ROS package that contains the launcher.
    pub package: Option<&'static str>,
}

/// The processes that get the SIGINT with which a stop begins.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interrupt {
    /// The whole process group, like Ctrl-C in a terminal: a shell script does not forward signals.
    #[default]
    Group,
    /// The first process alone, which ends its children in its own order. Without a terminal
    /// `ros2 launch` sends each node a SIGINT of its own; a second one would interrupt the node's
    /// clean-up.
    Leader,
}

/// The launcher of a manifest.
pub fn of(manifest: &TaskManifest) -> Launch {
    let run = &manifest.run;
    let tool = manifest.build.tool;
    let mut launch = match (&run.launch, &run.exec) {
        (Some(file), _) if tool == BuildTool::Catkin => roslaunch(file, &run.args),
        (Some(file), _) => ros2_launch(file, &run.args),
        (None, command) => exec(command.as_deref().unwrap_or_default()),
    };
    // The build tool comes with its ROS, whatever the launcher.
    launch.ros = launch.ros.or(match tool {
        BuildTool::Colcon => Some(RosVersion::Ros2),
        BuildTool::Catkin => Some(RosVersion::Ros1),
        BuildTool::None => None,
    });
    launch
}

fn ros2_launch(file: &[String; 2], arguments: &BTreeMap<String, String>) -> Launch {
    let command = words(&["ros2", "launch"], file, arguments);
    Launch {
        command,
        interrupt: Interrupt::Leader,
        ros: Some(RosVersion::Ros2),
        package: Some("ros2launch"),
    }
}

/// `roslaunch` puts the master and each node in a session of its own and ends them in that order; a
/// signal to the group would miss them.
fn roslaunch(file: &[String; 2], arguments: &BTreeMap<String, String>) -> Launch {
    let command = words(&["roslaunch"], file, arguments);
    Launch {
        command,
        interrupt: Interrupt::Leader,
        ros: Some(RosVersion::Ros1),
        package: Some("roslaunch"),
    }
}

fn exec(command: &[String]) -> Launch {
    Launch { command: command.to_vec(), interrupt: Interrupt::Group, ros: None, package: None }
}

fn words(
    launcher: &[&str],
    file: &[String; 2],
    arguments: &BTreeMap<String, String>,
) -> Vec<String> {
    let arguments = arguments.iter().map(|(name, value)| format!("{name}:={value}"));
    launcher
        .iter()
        .map(|word| (*word).to_owned())
        .chain(file.iter().cloned())
        .chain(arguments)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest(tool: &str, run: serde_json::Value) -> TaskManifest {
        serde_json::from_value(serde_json::json!({
            "name": "talker", "version": "1.0.0", "build": {"tool": tool}, "run": run,
            "content": {"tar_digest": task_proto::Digest::of(b""), "tar_size": 0, "entries": 0},
        }))
        .expect("manifest")
    }

    #[test]
    fn each_launcher_has_its_command_and_interrupt_target() {
        let run = serde_json::json!({
            "launch": ["base", "base.launch"], "args": {"frame": "a b", "map": "x:=y"},
        });
        let of = |tool, run: &serde_json::Value| {
            let launch = super::of(&manifest(tool, run.clone()));
            (launch.command.join("|"), launch.interrupt, launch.ros)
        };
        let leader = Interrupt::Leader;
        let group = Interrupt::Group;
        let arguments = "base|base.launch|frame:=a b|map:=x:=y";
        assert_eq!(
            of("colcon", &run),
            (format!("ros2|launch|{arguments}"), leader, Some(RosVersion::Ros2))
        );
        assert_eq!(
            of("none", &run),
            (format!("ros2|launch|{arguments}"), leader, Some(RosVersion::Ros2))
        );
        assert_eq!(
            of("catkin", &run),
            (format!("roslaunch|{arguments}"), leader, Some(RosVersion::Ros1))
        );
        let run = serde_json::json!({"exec": ["./start.sh", "a b"]});
        assert_eq!(of("none", &run), ("./start.sh|a b".to_owned(), group, None));
        assert_eq!(of("catkin", &run).2, Some(RosVersion::Ros1));
    }
}
