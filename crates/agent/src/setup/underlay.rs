//! The ROS installations that a task builds and runs on: the configured ones, or else those in
//! `/opt/ros` and the ROS 1 of the operating system. This module finds and names them; the
//! generated scripts source them. It never writes into an underlay.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use crate::setup::installation::{Installation, NoInstallation, RosVersion, choose};

/// Name of the distribution where ROS 1 comes with the operating system: the system's own name, in
/// lower case. Debian and Ubuntu have `catkin` and `roslaunch` in `/usr`, without a setup file.
const SYSTEM_DISTRO: &str = "debian";

/// Directories that are searched for installations.
#[derive(Debug, Clone)]
pub struct SearchPaths {
    /// Installation directory of ROS, with a subdirectory for each distribution.
    pub distros: PathBuf,
    /// Directory of the operating system's programs.
    pub system: PathBuf,
}

/// Reasons why a task has no setup files.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UnderlayError {
    /// A configured file does not exist.
    #[error("underlays, workspace: {} does not exist", .0.display())]
    Missing(PathBuf),
    /// The robot lacks the required ROS.
    #[error("this robot does not meet the requirements of the task: {0}")]
    NotInstalled(NoInstallation),
}

impl SearchPaths {
    /// The directories of this machine.
    pub fn of_this_machine() -> Self {
        Self { distros: "/opt/ros".into(), system: "/usr".into() }
    }
}

/// The installations that tasks can use, the best last: the `configured` setup files, which are
/// sourced all together, or else every installation found, ROS 2 after ROS 1 and newer after older
/// (the names of distributions rise with the alphabet).
pub fn find(configured: &[PathBuf], paths: &SearchPaths) -> Vec<Installation> {
    let mut found: Vec<Installation> = Vec::new();
    if ["catkin", "roslaunch"]
        .iter()
        .any(|name| paths.system.join("share").join(name).join("package.xml").is_file())
    {
        let distros = vec![SYSTEM_DISTRO.to_owned()];
        found.push(Installation {
            distros,
            versions: vec![RosVersion::Ros1],
            ..Installation::default()
        });
    }
    if !configured.is_empty() {
        found.push(combine(configured));
        return found;
    }
    let setups = children(&paths.distros).into_iter().map(|dir| dir.join("setup.bash"));
    found.extend(setups.filter(|setup| setup.is_file()).map(|setup| combine(&[setup])));
    // Stable: installations of one version stay in the order of their names, the system's first.
    found.sort_by(|one, other| one.versions.cmp(&other.versions));
    found
}

/// The installations that tasks can use on this machine, by the effective settings.
pub fn by_settings(underlays: &[PathBuf], workspace: Option<&Path>) -> Vec<Installation> {
    let found = find(underlays, &SearchPaths::of_this_machine());
    match workspace {
        Some(workspace) => with_workspace(found, workspace),
        None => found,
    }
}

/// The `found` installations with the configured `workspace` on top of each installation of the
/// same ROS, or alone where there is none.
pub fn with_workspace(mut found: Vec<Installation>, workspace: &Path) -> Vec<Installation> {
    let devel = workspace.join("devel/setup.bash");
    let setup = if devel.is_file() { devel } else { workspace.join("install/setup.bash") };
    let is_ros_1 =
        setup.parent().is_some_and(|dir| dir.ends_with("devel") || dir.join(".catkin").exists());
    let version = if is_ros_1 { RosVersion::Ros1 } else { RosVersion::Ros2 };
    let fits = |installation: &&mut Installation| {
        installation.versions.is_empty() || installation.versions.contains(&version)
    };
    let mut below = found.iter_mut().filter(fits).peekable();
    if below.peek().is_none() {
        found.push(Installation {
            versions: vec![version],
            setups: vec![setup],
            ..Installation::default()
        });
        return found;
    }
    below.for_each(|installation| installation.setups.push(setup.clone()));
    found
}

/// The setup files for a task that needs `version` (`None`: any) of one of `distros` (none: any),
/// in the order to source them.
pub fn setup_files(
    installations: &[Installation],
    version: Option<RosVersion>,
    distros: &[String],
) -> Result<Vec<PathBuf>, UnderlayError> {
    let chosen = choose(installations, version, distros).map_err(UnderlayError::NotInstalled)?;
    let setups = chosen.map(|found| found.setups.clone()).unwrap_or_default();
    match setups.iter().find(|setup| !setup.is_file()) {
        Some(missing) => Err(UnderlayError::Missing(missing.clone())),
        None => Ok(setups),
    }
}

fn combine(setups: &[PathBuf]) -> Installation {
    let mut versions: Vec<_> = setups.iter().filter_map(|setup| version_of(setup)).collect();
    versions.sort();
    versions.dedup();
    Installation {
        distros: setups.iter().filter_map(|setup| distro_of(setup)).collect(),
        versions,
        setups: setups.to_vec(),
        ..Installation::default()
    }
}

/// The ROS version of a setup file; `None` for a workspace on top of another, which does not state
/// its version.
fn version_of(setup: &Path) -> Option<RosVersion> {
    let dir = setup.parent()?;
    if dir.join(".catkin").exists() {
        return Some(RosVersion::Ros1);
    }
    let holds_ros_2 = dir.join("share/ament_index").is_dir() || wheels_of(dir).is_some();
    // In the directory of distributions, every distribution that catkin did not make is ROS 2.
    (holds_ros_2 || is_below_ros(dir)).then_some(RosVersion::Ros2)
}

/// The distribution of a setup file: from its installation, else from the ROS wheels in its virtual
/// environment (which may well be called `ros`), else the directory's name below `ros`.
fn distro_of(setup: &Path) -> Option<String> {
    let dir = setup.parent()?;
    let declared =
        fs::read_to_string(dir.join("share/ros_environment/environment/1.ros_distro.dsv")).ok();
    if let Some(distro) =
        declared.as_deref().and_then(|text| text.trim().strip_prefix("set;ROS_DISTRO;"))
    {
        return Some(distro.to_owned());
    }
    wheels_of(dir).or_else(|| {
        is_below_ros(dir).then(|| dir.file_name()?.to_str().map(str::to_owned)).flatten()
    })
}

/// The distribution of the ROS wheels in the virtual environment with its programs in `bin`.
fn wheels_of(bin: &Path) -> Option<String> {
    let pythons = children(&bin.parent()?.join("lib"));
    let mut installed = pythons.iter().flat_map(|python| children(&python.join("site-packages")));
    installed.find_map(|path| wheel_distro(path.file_name()?.to_str()?))
}

fn is_below_ros(dir: &Path) -> bool {
    dir.parent().and_then(Path::file_name) == Some(OsStr::new("ros")) && !dir.ends_with("bin")
}

/// `ros_kilted_rclpy-9.1.2.dist-info` is of `kilted`.
fn wheel_distro(name: &str) -> Option<String> {
    let (distro, rest) = name.strip_prefix("ros_")?.split_once("_rclpy-")?;
    rest.ends_with(".dist-info").then(|| distro.to_owned())
}

fn children(dir: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> =
        fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::setup::installation::all_distros;

    fn touch(path: PathBuf) -> PathBuf {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "").unwrap();
        path
    }

    fn paths(root: &Path) -> SearchPaths {
        SearchPaths { distros: root.join("opt/ros"), system: root.join("usr") }
    }

    #[test]
    fn newest_distribution_is_used_unless_the_task_names_one() {
        let temp = tempfile::tempdir().unwrap();
        let paths = paths(temp.path());
        let [humble, jazzy] =
            ["humble", "jazzy"].map(|distro| touch(paths.distros.join(distro).join("setup.bash")));
        // This name comes last in the alphabet, but the distribution is ROS 1.
        let noetic = touch(paths.distros.join("noetic/setup.bash"));
        touch(paths.distros.join("noetic/.catkin"));
        fs::create_dir(paths.distros.join("removed")).unwrap();
        let found = find(&[], &paths);
        assert_eq!(all_distros(&found), ["humble", "jazzy", "noetic"]);
        assert_eq!(setup_files(&found, None, &[]), Ok(vec![jazzy.clone()]));
        assert_eq!(setup_files(&found, Some(RosVersion::Ros2), &[]), Ok(vec![jazzy]));
        assert_eq!(setup_files(&found, Some(RosVersion::Ros1), &[]), Ok(vec![noetic]));
        assert_eq!(setup_files(&found, None, &["humble".to_owned()]), Ok(vec![humble]));
        let text = setup_files(&found, None, &["kilted".to_owned()]).unwrap_err().to_string();
        assert!(text.contains("kilted") && text.contains("humble, jazzy"), "{text}");
    }

    #[test]
    fn virtual_environment_is_an_underlay_and_a_missing_file_is_named() {
        let temp = tempfile::tempdir().unwrap();
        // This name must not be mistaken for the directory where distributions are installed.
        let venv = temp.path().join("ros");
        let activate = touch(venv.join("bin/activate"));
        touch(venv.join("lib/python3.11/site-packages/ros_kilted_rclpy-9.1.2.dist-info/METADATA"));
        let found = find(std::slice::from_ref(&activate), &paths(temp.path()));
        assert_eq!(
            (all_distros(&found), &found[0].versions),
            (vec!["kilted".to_owned()], &vec![RosVersion::Ros2])
        );
        assert_eq!(setup_files(&found, None, &[]), Ok(vec![activate]));
        let gone = temp.path().join("gone/setup.bash");
        let found = find(std::slice::from_ref(&gone), &paths(temp.path()));
        assert_eq!(setup_files(&found, None, &[]), Err(UnderlayError::Missing(gone)));
    }

    #[test]
    fn ros_1_of_the_operating_system_needs_no_setup_file() {
        let temp = tempfile::tempdir().unwrap();
        let paths = paths(temp.path());
        assert_eq!(setup_files(&find(&[], &paths), None, &[]), Ok(vec![]));
        touch(paths.system.join("share/roslaunch/package.xml"));
        let found = find(&[], &paths);
        assert_eq!((all_distros(&found), found.len()), (vec!["debian".to_owned()], 1));
        assert_eq!(setup_files(&found, Some(RosVersion::Ros1), &["debian".to_owned()]), Ok(vec![]));
        // It stays usable beside a configured ROS 2.
        let jazzy = touch(paths.distros.join("jazzy/setup.bash"));
        let found = find(std::slice::from_ref(&jazzy), &paths);
        assert_eq!(setup_files(&found, Some(RosVersion::Ros1), &[]), Ok(vec![]));
        assert_eq!(setup_files(&found, Some(RosVersion::Ros2), &[]), Ok(vec![jazzy]));
    }

    #[test]
    fn workspace_overlays_the_ros_version_it_was_built_with() {
        let dir = tempfile::tempdir().unwrap();
        let installed = |setup: &str, version| Installation {
            versions: vec![version],
            setups: vec![setup.into()],
            ..Installation::default()
        };
        let found = vec![
            installed("/opt/ros/noetic/setup.bash", RosVersion::Ros1),
            installed("/j", RosVersion::Ros2),
        ];
        let setups =
            |found: &[Installation]| found.iter().map(|one| one.setups.clone()).collect::<Vec<_>>();
        let install = dir.path().join("install/setup.bash");
        let on_ros_2 = with_workspace(found.clone(), dir.path());
        assert_eq!(
            setups(&on_ros_2),
            [vec!["/opt/ros/noetic/setup.bash".into()], vec!["/j".into(), install.clone()]]
        );
        assert_eq!(
            setup_files(&on_ros_2, Some(RosVersion::Ros2), &[]),
            Err(UnderlayError::Missing("/j".into())),
            "the missing file is named"
        );
        assert_eq!(setups(&with_workspace(Vec::new(), dir.path())), [[install]]);
        let devel = dir.path().join("devel/setup.bash");
        fs::create_dir(devel.parent().unwrap()).unwrap();
        fs::write(&devel, "").unwrap();
        let on_ros_1 = with_workspace(found, dir.path());
        assert_eq!(
            setups(&on_ros_1),
            [vec!["/opt/ros/noetic/setup.bash".into(), devel], vec!["/j".into()]]
        );
    }
}
