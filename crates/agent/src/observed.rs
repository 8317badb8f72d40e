//! What is true on the robot, whatever the ledger says: processes and what lies on the disk. Plain values, filled by the
//! effects and read by the plan.

use task_proto::Digest;
use task_proto::id::Labels;
use task_proto::manifest::{Requires, TaskManifest};

use crate::process::ExitStatus;

/// What is on the disk of one version, and which versions there are.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Prepared {
    /// The version's manifest, once it was pulled and verified.
    pub manifest: Option<TaskManifest>,
    /// Its content is unpacked.
    pub content: bool,
    /// It is built, or needs no build.
    pub built: bool,
    /// Every version of the task that has a directory.
    pub versions: Vec<Digest>,
}

/// What became of a process that the ledger knows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ProcessState {
    /// The ledger knows none.
    None,
    /// It lives.
    Alive {
        /// Its id.
        pid: u32,
    },
    /// It can't be told now.
    Unknown,
    /// It was about to be started, and was not.
    NeverStarted,
    /// It ended.
    Ended(Exit),
}

/// How a process ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exit {
    /// With which code or signal; `None` when the process and its shim were gone without a word.
    pub status: Option<ExitStatus>,
    /// The last lines of its output.
    pub last_lines: String,
}

/// What a package may require of the robot.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RobotFacts {
    /// The processor architecture.
    pub arch: String,
    /// The labels the server holds; `None` until it has said.
    pub labels: Option<Labels>,
    /// ROS distributions found.
    pub ros_distros: Vec<String>,
}

impl RobotFacts {
    /// What `requires` asks for and this robot lacks, each as a sentence part; empty when it has all.
    pub fn lacks(&self, requires: &Requires) -> Vec<String> {
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
        if !requires.ros_distro.is_empty() && !self.ros_distros.iter().any(|have| requires.ros_distro.contains(have)) {
            let have = if self.ros_distros.is_empty() { "none".to_owned() } else { self.ros_distros.join(", ") };
            lacks.push(format!("ros_distro {} (it has {have})", requires.ros_distro.join(" or ")));
        }
        lacks
    }
}

impl Exit {
    /// Whether it ended as a program does that is content.
    pub fn is_success(&self) -> bool {
        self.status == Some(ExitStatus::Code(0))
    }

    /// The end in words, with the last lines of output.
    pub fn text(&self) -> String {
        let end = match self.status {
            Some(status) => status.to_string(),
            None => "gone without an exit status".to_owned(),
        };
        if self.last_lines.trim().is_empty() {
            format!("the process ended ({end}) and wrote nothing")
        } else {
            format!("the process ended ({end}); its last lines:\n{}", self.last_lines.trim_end())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_lacking_is_listed_by_the_packages_keys() {
        let robot = RobotFacts {
            arch: "x86_64".to_owned(),
            labels: Some([("base".parse().expect("valid"), "husky".parse().expect("valid"))].into()),
            ros_distros: vec!["jazzy".to_owned()],
        };
        let mut requires = Requires::default();
        assert_eq!(robot.lacks(&requires), Vec::<String>::new());
        requires.labels.insert("base".parse().expect("valid"), "turtlebot".parse().expect("valid"));
        requires.arch = vec!["aarch64".to_owned()];
        requires.ros_distro = vec!["humble".to_owned(), "iron".to_owned()];
        assert_eq!(
            robot.lacks(&requires),
            [
                "label base=turtlebot (it has base=husky)",
                "arch aarch64 (it is x86_64)",
                "ros_distro humble or iron (it has jazzy)"
            ]
        );
        requires = Requires { ros_distro: vec!["jazzy".to_owned()], ..Requires::default() };
        assert!(robot.lacks(&requires).is_empty());
    }
}
