//! The ROS installations that a task builds and runs on: the ones a person configured, else what is in `/opt/ros`. It
//! finds and names them; sourcing them is the generated scripts' work. Nothing is ever written into an underlay.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

/// Where ROS installs itself.
pub const SYSTEM_ROOT: &str = "/opt/ros";

/// A setup file and the distribution it belongs to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Underlay {
    /// The file that bash sources: a `setup.bash`, or a Python virtual environment's `activate`.
    pub setup: PathBuf,
    /// The distribution, for example `jazzy`, where it can be told.
    pub distro: Option<String>,
}

/// What this robot has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Underlays {
    /// A person chose these; they are sourced in this order, all of them.
    Configured(Vec<Underlay>),
    /// Found by looking; a task uses one of them.
    Found(Vec<Underlay>),
}

/// A robot without what a task needs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UnderlayError {
    /// A configured file is not there.
    #[error("underlays: {} is not there", .0.display())]
    Missing(PathBuf),
    /// None of the distributions the task accepts is installed.
    #[error("requires.ros_distro: the task needs one of [{}], this robot has [{}]", wanted.join(", "), found.join(", "))]
    NoDistro {
        /// What the task accepts.
        wanted: Vec<String>,
        /// What the robot has.
        found: Vec<String>,
    },
}

impl Underlays {
    /// The `configured` setup files if there are any, else every distribution below `system_root`.
    pub fn find(configured: &[PathBuf], system_root: &Path) -> Self {
        let underlay = |setup: PathBuf| Underlay { distro: distro_of(&setup), setup };
        if !configured.is_empty() {
            return Self::Configured(configured.iter().cloned().map(underlay).collect());
        }
        let setups = children(system_root).into_iter().map(|dir| dir.join("setup.bash"));
        Self::Found(setups.filter(|setup| setup.is_file()).map(underlay).collect())
    }

    /// The distributions, sorted.
    pub fn distros(&self) -> Vec<String> {
        let (Self::Configured(underlays) | Self::Found(underlays)) = self;
        let mut distros: Vec<_> = underlays.iter().filter_map(|underlay| underlay.distro.clone()).collect();
        distros.sort();
        distros.dedup();
        distros
    }

    /// The setup files for a task that accepts the distributions `wanted` (none: any), in the order to source them.
    pub fn for_task(&self, wanted: &[String]) -> Result<Vec<PathBuf>, UnderlayError> {
        let accepted = |underlay: &&Underlay| underlay.distro.as_ref().is_some_and(|distro| wanted.contains(distro));
        let none = || UnderlayError::NoDistro { wanted: wanted.to_vec(), found: self.distros() };
        match self {
            Self::Configured(underlays) => {
                if let Some(missing) = underlays.iter().find(|underlay| !underlay.setup.is_file()) {
                    return Err(UnderlayError::Missing(missing.setup.clone()));
                }
                if !wanted.is_empty() && !underlays.iter().any(|underlay| accepted(&underlay)) {
                    return Err(none());
                }
                Ok(underlays.iter().map(|underlay| underlay.setup.clone()).collect())
            }
            // The names of distributions rise with the alphabet, so the last of several is the newest.
            Self::Found(underlays) if wanted.is_empty() => {
                Ok(underlays.last().map(|underlay| underlay.setup.clone()).into_iter().collect())
            }
            Self::Found(underlays) => {
                let chosen = underlays.iter().rfind(accepted).ok_or_else(none)?;
                Ok(vec![chosen.setup.clone()])
            }
        }
    }
}

/// The distribution a setup file belongs to: what its installation says, else the ROS wheels in its virtual environment
/// (which may well be called `ros`), else the directory's name below `ros`.
fn distro_of(setup: &Path) -> Option<String> {
    let dir = setup.parent()?;
    let said = fs::read_to_string(dir.join("share/ros_environment/environment/1.ros_distro.dsv")).ok();
    if let Some(distro) = said.as_deref().and_then(|text| text.trim().strip_prefix("set;ROS_DISTRO;")) {
        return Some(distro.to_owned());
    }
    let pythons = children(&dir.parent()?.join("lib"));
    let mut installed = pythons.iter().flat_map(|python| children(&python.join("site-packages")));
    if let Some(distro) = installed.find_map(|path| wheel_distro(path.file_name()?.to_str()?)) {
        return Some(distro);
    }
    let is_below_ros = dir.parent()?.file_name() == Some(OsStr::new("ros"));
    is_below_ros.then(|| dir.file_name()?.to_str().map(str::to_owned)).flatten()
}

/// `ros_kilted_rclpy-9.1.2.dist-info` is of `kilted`.
fn wheel_distro(name: &str) -> Option<String> {
    let (distro, rest) = name.strip_prefix("ros_")?.split_once("_rclpy-")?;
    rest.ends_with(".dist-info").then(|| distro.to_owned())
}

fn children(dir: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> = fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(path: PathBuf) -> PathBuf {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "").unwrap();
        path
    }

    #[test]
    fn the_newest_installed_distribution_is_used_unless_the_task_says_which() {
        let temp = tempfile::tempdir().unwrap();
        let root = temp.path().join("ros");
        let [humble, jazzy] = ["humble", "jazzy"].map(|distro| touch(root.join(distro).join("setup.bash")));
        fs::create_dir(root.join("removed")).unwrap();
        let underlays = Underlays::find(&[], &root);
        assert_eq!(underlays.distros(), ["humble", "jazzy"]);
        assert_eq!(underlays.for_task(&[]), Ok(vec![jazzy]));
        assert_eq!(underlays.for_task(&["humble".to_owned()]), Ok(vec![humble]));
        let text = underlays.for_task(&["kilted".to_owned()]).unwrap_err().to_string();
        assert!(text.contains("[kilted]") && text.contains("[humble, jazzy]"), "{text}");
    }

    #[test]
    fn a_virtual_environment_is_an_underlay_and_a_missing_file_is_named() {
        let temp = tempfile::tempdir().unwrap();
        // Its name must not be taken for the place where distributions are installed.
        let venv = temp.path().join("ros");
        let activate = touch(venv.join("bin/activate"));
        touch(venv.join("lib/python3.11/site-packages/ros_kilted_rclpy-9.1.2.dist-info/METADATA"));
        let underlays = Underlays::find(std::slice::from_ref(&activate), Path::new(SYSTEM_ROOT));
        assert_eq!(underlays.distros(), ["kilted"]);
        assert_eq!(underlays.for_task(&[]), Ok(vec![activate]));
        let gone = temp.path().join("gone/setup.bash");
        let missing = Underlays::find(std::slice::from_ref(&gone), Path::new(SYSTEM_ROOT));
        assert_eq!(missing.for_task(&[]), Err(UnderlayError::Missing(gone)));
    }

    #[test]
    fn no_ros_at_all_is_fine_for_a_task_that_asks_for_none() {
        let underlays = Underlays::find(&[], Path::new("/nonexistent"));
        assert_eq!(underlays.for_task(&[]), Ok(vec![]));
    }
}
