//! Examines ROS installations: sources the setup files as a task would, under the same account, and
//! lists the packages that can be found then. Time and list sizes are limited; data that can't be
//! read stays unknown. This module chooses no installation.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::io::{self, PipeReader, Read as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::process::cgroup::RunLimits;
use crate::process::confinement::Confinement;
use crate::process::containment::{Containment, RUN_DIR_VARIABLE};
use crate::process::program::{self, ExitStatus};
use crate::setup::installation::{Installation, RosVersion};
use crate::setup::script;
use crate::system::durable;
use crate::system::task_user::{self, TaskUser};

/// Added to the agent's niceness.
const NICE: i32 = 10;
/// Maximum time for setup files; those of a large workspace on a slow card take seconds.
const SOURCING_TIMEOUT: Duration = Duration::from_secs(30);
/// Maximum time for the probe's processes to be gone.
const KILL_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum number of installations that are examined.
const MAX_INSTALLATIONS: usize = 16;
/// Maximum output of setup files.
const MAX_ANSWER_BYTES: u64 = 4 << 20;
/// Maximum number of directories that are visited, and of names that are kept.
const MAX_DIRECTORIES: usize = 10_000;
const MAX_PACKAGES: usize = 100_000;
/// Maximum depth of the search in a source workspace in `ROS_PACKAGE_PATH`.
const MAX_DEPTH: usize = 4;
/// The queried variables, in the order of [`Answer`]'s fields.
const VARIABLES: [&str; 7] = [
    "AMENT_PREFIX_PATH",
    "CMAKE_PREFIX_PATH",
    "ROS_PACKAGE_PATH",
    "VIRTUAL_ENV",
    "ROS_DISTRO",
    "ROS_VERSION",
    "RMW_IMPLEMENTATION",
];

/// `installations` with the packages that `user` can see in them. `dir` is for the probe alone.
pub async fn probe_installations(
    installations: Vec<Installation>,
    environment: &BTreeMap<String, String>,
    dir: &Path,
    user: Option<&TaskUser>,
) -> Vec<Installation> {
    let mut seen = Vec::new();
    for (number, mut installation) in installations.into_iter().enumerate() {
        if number < MAX_INSTALLATIONS {
            match source(&installation.setups, environment, dir, user).await {
                Ok(answer) => apply_answer(&mut installation, answer, user).await,
                Err(error) => {
                    tracing::warn!(setups = ?installation.setups, %error, "cannot examine this ROS installation");
                }
            }
        }
        seen.push(installation);
    }
    seen
}

/// The values of the variables after sourcing `setups`.
async fn source(
    setups: &[PathBuf],
    environment: &BTreeMap<String, String>,
    dir: &Path,
    user: Option<&TaskUser>,
) -> io::Result<Vec<String>> {
    durable::create_dir_all(dir)?;
    let dir = dir.canonicalize()?;
    let path = dir.join("survey.sh");
    durable::write(&path, script::probe_script(setups, &VARIABLES).as_bytes(), 0o755)?;
    let mut environment = environment.clone();
    environment.insert(RUN_DIR_VARIABLE.to_owned(), dir.display().to_string());
    if let Some(user) = user {
        let dirs: Vec<PathBuf> =
            dir.parent().into_iter().chain([dir.as_path()]).map(Path::to_owned).collect();
        user.allow_traversal(&dirs)?;
        environment.insert("HOME".to_owned(), dir.display().to_string());
        environment.extend(["USER", "LOGNAME"].map(|name| (name.to_owned(), user.name.clone())));
    }
    let containment = Containment::new(&dir, None, None);
    // An agent that was killed may have left a probe running.
    containment.end(KILL_TIMEOUT).await.map_err(io::Error::other)?;
    let (reader, writer) = io::pipe()?;
    let confinement = Confinement::new(&path, None, &RunLimits::default(), user)?;
    let mut child = program::spawn_build(&path, &dir, &environment, NICE, confinement, writer)?;
    let reading = tokio::task::spawn_blocking(move || read_answer(reader));
    let ended = tokio::time::timeout(SOURCING_TIMEOUT, child.wait()).await;
    containment.end(KILL_TIMEOUT).await.map_err(io::Error::other)?;
    let status = ExitStatus::from(ended.map_err(|_| io::Error::from(io::ErrorKind::TimedOut))??);
    if status != ExitStatus::Code(0) {
        return Err(io::Error::other(status.to_string()));
    }
    // A process that escaped may hold its end of the pipe open.
    tokio::time::timeout(KILL_TIMEOUT, reading)
        .await
        .map_err(|_| io::Error::from(io::ErrorKind::TimedOut))??
}

fn read_answer(answer: PipeReader) -> io::Result<Vec<String>> {
    let mut bytes = Vec::new();
    answer.take(MAX_ANSWER_BYTES).read_to_end(&mut bytes)?;
    let values: Vec<String> =
        bytes.split(|byte| *byte == 0).map(|value| String::from_utf8_lossy(value).into()).collect();
    // The last value is terminated too, which gives an empty text after it.
    if values.len() == VARIABLES.len() + 1 {
        Ok(values)
    } else {
        Err(io::Error::other("the answer is not complete"))
    }
}

async fn apply_answer(
    installation: &mut Installation,
    answer: Vec<String>,
    user: Option<&TaskUser>,
) {
    let value = |name: &str| {
        let at = VARIABLES.iter().position(|variable| *variable == name);
        at.and_then(|at| answer.get(at)).filter(|value| !value.is_empty()).cloned()
    };
    let paths =
        |name: &str| std::env::split_paths(&value(name).unwrap_or_default()).collect::<Vec<_>>();
    if installation.distros.is_empty() {
        installation.distros.extend(value("ROS_DISTRO").map(|distro| distro.to_ascii_lowercase()));
    }
    if installation.versions.is_empty() {
        installation.versions.extend(match value("ROS_VERSION").as_deref() {
            Some("1") => Some(RosVersion::Ros1),
            Some("2") => Some(RosVersion::Ros2),
            _ => None,
        });
    }
    installation.rmw = value("RMW_IMPLEMENTATION");
    let mut search_paths =
        SearchPaths { prefixes: paths("AMENT_PREFIX_PATH"), ..SearchPaths::default() };
    search_paths.prefixes.extend(paths("CMAKE_PREFIX_PATH"));
    search_paths.sources = paths("ROS_PACKAGE_PATH");
    if let Some(venv) = value("VIRTUAL_ENV").map(PathBuf::from) {
        search_paths
            .pythons
            .extend(children(&venv.join("lib")).map(|python| python.join("site-packages")));
        search_paths.prefixes.push(venv);
    }
    if installation.versions.contains(&RosVersion::Ros1) {
        // ROS 1 of the operating system, also below another installation.
        search_paths.prefixes.push("/usr".into());
        search_paths.pythons.push("/usr/lib/python3/dist-packages".into());
    }
    // A thread that panicked returns no packages.
    installation.packages = task_user::do_as(user, move || search_paths.packages()).await.ok();
}

/// Directories that contain packages.
#[derive(Default)]
struct SearchPaths {
    prefixes: Vec<PathBuf>,
    sources: Vec<PathBuf>,
    pythons: Vec<PathBuf>,
}

impl SearchPaths {
    /// All names that could refer to a package. The list is rather too long than too short: a
    /// missing name causes a refusal.
    fn packages(&self) -> BTreeSet<String> {
        let mut found = BTreeSet::new();
        for prefix in self.prefixes.iter().take(MAX_DIRECTORIES) {
            let share = prefix.join("share");
            let indexes = ["ament_index/resource_index/packages", "colcon-core/packages"];
            found.extend(
                indexes.iter().flat_map(|index| names(&share.join(index))).take(MAX_PACKAGES),
            );
            // catkin's devel spaces have only CMake files there.
            let is_package =
                |path: &PathBuf| path.join("package.xml").is_file() || path.join("cmake").is_dir();
            found.extend(
                children(&share)
                    .filter(is_package)
                    .filter_map(|path| name(&path))
                    .take(MAX_PACKAGES),
            );
        }
        for directory in &self.pythons {
            found.extend(names(directory).take(MAX_PACKAGES));
        }
        let mut rest = MAX_DIRECTORIES;
        for directory in &self.sources {
            sources(directory, MAX_DEPTH, &mut rest, &mut found);
        }
        found
    }
}

/// Adds the packages in the sources at and below `directory`.
fn sources(directory: &Path, depth: usize, rest: &mut usize, found: &mut BTreeSet<String>) {
    let Some(left) = rest.checked_sub(1) else { return };
    *rest = left;
    if directory.join("package.xml").is_file() {
        found.extend(name(directory));
    } else if depth > 0 {
        for child in children(directory).filter(|child| child.is_dir()) {
            sources(&child, depth - 1, rest, found);
        }
    }
}

fn children(directory: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    std::fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path())
}

fn names(directory: &Path) -> impl Iterator<Item = String> + use<> {
    children(directory).filter_map(|path| name(&path))
}

fn name(path: &Path) -> Option<String> {
    path.file_name().and_then(OsStr::to_str).map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(path: PathBuf, text: &str) {
        std::fs::create_dir_all(path.parent().expect("a parent")).expect("made");
        std::fs::write(path, text).expect("written");
    }

    fn system() -> BTreeMap<String, String> {
        [("PATH".to_owned(), "/usr/bin:/bin".to_owned())].into()
    }

    #[tokio::test]
    async fn packages_found_after_sourcing_are_listed() {
        let temp = tempfile::tempdir().expect("a directory");
        let root = temp.path();
        write(root.join("a/share/ament_index/resource_index/packages/nav_msgs"), "");
        write(root.join("b/share/vendor_lib/package.xml"), "");
        write(root.join("b/share/colcon-core/packages/plain_cmake"), "");
        write(root.join("b/share/doc/readme"), "");
        write(root.join("devel/share/made_here/cmake/made_hereConfig.cmake"), "");
        write(root.join("src/group/robot_driver/package.xml"), "");
        let at = root.display();
        let text = format!(
            "echo chatter; echo worse >&2; export AMENT_PREFIX_PATH={at}/a:{at}/b CMAKE_PREFIX_PATH={at}/devel \
             ROS_PACKAGE_PATH={at}/src ROS_DISTRO=Jazzy ROS_VERSION=2 RMW_IMPLEMENTATION=rmw_cyclonedds_cpp\n"
        );
        write(root.join("my setup.bash"), &text);
        let given =
            Installation { setups: vec![root.join("my setup.bash")], ..Installation::default() };
        let seen =
            probe_installations(vec![given], &system(), &root.join("survey"), None).await.remove(0);
        assert_eq!(
            (seen.distros, seen.versions),
            (vec!["jazzy".to_owned()], vec![RosVersion::Ros2])
        );
        assert_eq!(seen.rmw.as_deref(), Some("rmw_cyclonedds_cpp"));
        let packages: Vec<_> = seen.packages.expect("seen").into_iter().collect();
        assert_eq!(
            packages,
            ["made_here", "nav_msgs", "plain_cmake", "robot_driver", "vendor_lib"]
        );
    }

    #[tokio::test]
    async fn installation_that_fails_to_source_stays_unknown() {
        let temp = tempfile::tempdir().expect("a directory");
        write(temp.path().join("exits.bash"), "exit 3\n");
        for setup in ["exits.bash", "absent.bash"] {
            let given =
                Installation { setups: vec![temp.path().join(setup)], ..Installation::default() };
            let seen = probe_installations(
                vec![given.clone()],
                &system(),
                &temp.path().join("survey"),
                None,
            )
            .await;
            assert_eq!(seen, [given]);
        }
    }
}
