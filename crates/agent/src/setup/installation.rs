//! A ROS installation as tasks use it: the setup files to source and the contents of the
//! installation. Pure: the choice of an installation for a task, and the packages that a task would
//! miss. `underlay` finds installations, and `ros::probe` examines them.

use std::collections::BTreeSet;
use std::fmt;
use std::path::PathBuf;

/// The two systems called ROS.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum RosVersion {
    /// ROS with a master, `catkin` and `roslaunch`.
    Ros1,
    /// ROS with DDS, `colcon` and `ros2 launch`.
    Ros2,
}

/// Setup files that are sourced together, and the environment that they give a task.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Installation {
    /// The files that bash sources, in this order; empty where the whole installation is in the
    /// system's own directories.
    pub setups: Vec<PathBuf>,
    /// The distributions, for example `jazzy`, where they are known.
    pub distros: Vec<String>,
    /// The ROS versions of the distributions; empty where unknown.
    pub versions: Vec<RosVersion>,
    /// The installed packages; `None` where the installation was not examined, or the examination
    /// failed.
    pub packages: Option<BTreeSet<String>>,
    /// The middleware that the setup files choose.
    pub rmw: Option<String>,
}

/// A robot without the ROS that a task needs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoInstallation {
    /// There is no installation of this version.
    #[error("{0} (no {0} found{found})", found = alternatives(.1))]
    Version(RosVersion, Vec<String>),
    /// None of the distributions the task accepts is installed.
    #[error("ros_distro {} (it has {})", wanted.join(" or "), or_none(found))]
    Distro {
        /// The distributions that the task accepts.
        wanted: Vec<String>,
        /// The distributions of the robot.
        found: Vec<String>,
    },
}

/// Names of ROS packages that have no underscore and that no system package shares.
const PLAIN_NAMES: [&str; 6] = ["rclcpp", "rclpy", "ros2launch", "roscpp", "roslaunch", "rospy"];
/// The one name with an underscore that `rosdep` knows as a system package.
const SYSTEM_NAMES: [&str; 1] = ["onvif_zeep"];

impl Installation {
    /// Whether the installation is of `version`, or may be.
    fn may_be(&self, version: RosVersion) -> bool {
        self.versions.is_empty() || self.versions.contains(&version)
    }

    /// The packages of `needed` that are certainly missing. Only names that must be ROS packages
    /// are judged: other names are keys of `rosdep` for packages of the operating system or pip,
    /// which no index of ROS lists.
    pub fn missing_packages<'a>(
        &self,
        needed: impl IntoIterator<Item = &'a str>,
    ) -> BTreeSet<&'a str> {
        let Some(packages) = &self.packages else { return BTreeSet::new() };
        needed
            .into_iter()
            .filter(|name| is_ros_package(name) && !packages.contains(*name))
            .collect()
    }
}

/// Whether only a ROS package can be called `name`. Of 4,210 released ROS packages nine in ten have
/// an underscore; of 2,414 names of system packages one has.
pub fn is_ros_package(name: &str) -> bool {
    let plain =
        name.bytes().all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_');
    (plain && name.contains('_') && !SYSTEM_NAMES.contains(&name)) || PLAIN_NAMES.contains(&name)
}

/// The installation for a task that needs `version` (`None`: any version, or no ROS at all) of one
/// of `distros` (none: any). The best one is the last of `installations`.
pub fn choose<'a>(
    installations: &'a [Installation],
    version: Option<RosVersion>,
    distros: &[String],
) -> Result<Option<&'a Installation>, NoInstallation> {
    let mut of_version =
        installations.iter().filter(|found| version.is_none_or(|version| found.may_be(version)));
    if distros.is_empty() {
        return match (of_version.next_back(), version) {
            (None, Some(version)) => {
                Err(NoInstallation::Version(version, all_distros(installations)))
            }
            (found, _) => Ok(found),
        };
    }
    let accepted =
        of_version.rfind(|found| found.distros.iter().any(|distro| distros.contains(distro)));
    let none =
        || NoInstallation::Distro { wanted: distros.to_vec(), found: all_distros(installations) };
    accepted.map(Some).ok_or_else(none)
}

/// The distributions, sorted, each once.
pub fn all_distros(installations: &[Installation]) -> Vec<String> {
    let distros: BTreeSet<&String> =
        installations.iter().flat_map(|found| &found.distros).collect();
    distros.into_iter().cloned().collect()
}

fn or_none(found: &[String]) -> String {
    if found.is_empty() { "none".to_owned() } else { found.join(", ") }
}

fn alternatives(found: &[String]) -> String {
    if found.is_empty() { String::new() } else { format!(", only {}", found.join(", ")) }
}

impl fmt::Display for RosVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Ros1 => "ROS 1",
            Self::Ros2 => "ROS 2",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn installation(distro: &str, version: RosVersion) -> Installation {
        Installation {
            distros: vec![distro.to_owned()],
            versions: vec![version],
            ..Installation::default()
        }
    }

    #[test]
    fn task_gets_its_ros_version_among_several() {
        let all =
            [installation("noetic", RosVersion::Ros1), installation("humble", RosVersion::Ros2)];
        let distro = |version, wanted: &[&str]| {
            let wanted: Vec<String> = wanted.iter().map(|text| (*text).to_owned()).collect();
            choose(&all, version, &wanted).map(|found| found.map(|found| found.distros[0].clone()))
        };
        assert_eq!(distro(None, &[]), Ok(Some("humble".to_owned())));
        assert_eq!(distro(Some(RosVersion::Ros1), &[]), Ok(Some("noetic".to_owned())));
        assert_eq!(distro(None, &["noetic"]), Ok(Some("noetic".to_owned())));
        let text =
            distro(Some(RosVersion::Ros2), &["noetic"]).expect_err("another version").to_string();
        assert_eq!(text, "ros_distro noetic (it has humble, noetic)");
        let text = choose(&all[..1], Some(RosVersion::Ros2), &[]).expect_err("none").to_string();
        assert_eq!(text, "ROS 2 (no ROS 2 found, only noetic)");
        assert_eq!(choose(&[], None, &[]), Ok(None));
        let text = choose(&[], Some(RosVersion::Ros1), &[]).expect_err("none").to_string();
        assert_eq!(text, "ROS 1 (no ROS 1 found)");
        let unknown = [Installation::default()];
        assert_eq!(choose(&unknown, Some(RosVersion::Ros1), &[]), Ok(Some(&unknown[0])));
    }

    #[test]
    fn only_certainly_absent_packages_are_missing() {
        let needed = [
            "nav2_bringup",
            "rclpy",
            "std_msgs",
            "python3-numpy",
            "eigen",
            "xacro",
            "onvif_zeep",
            "libFoo_x",
        ];
        let mut found = installation("jazzy", RosVersion::Ros2);
        assert!(found.missing_packages(needed).is_empty(), "nobody has looked");
        found.packages = Some(["std_msgs".to_owned()].into());
        assert_eq!(found.missing_packages(needed), ["nav2_bringup", "rclpy"].into());
    }
}
