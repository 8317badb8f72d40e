//! The robot's ROS installations as last seen. They are found by the effective settings, and known
//! in more detail after a probe has run their setup files.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError};

use task_proto::messages::report::{FailureCode, RosFacts};
use task_proto::packages::manifest::TaskManifest;

use super::Robot;
use super::outcomes::permanent_failure;
use crate::process::run_dir::RunDir;
use crate::ros::probe;
use crate::setup::environment;
use crate::setup::installation::Installation;
use crate::setup::launch;
use crate::setup::underlay;
use crate::system::durable;
use crate::system::layout::VersionDir;
use crate::system::task_user::TaskUser;
use crate::task::plan::StepFailure;
use crate::task::run::ActiveRun;

/// The directory for the files of the ROS probe.
const PROBE_DIR: &str = "survey";

/// The variable with the directory for the nodes' own logs. The directory is emptied first: ROS
/// makes new files at each start and deletes none. If the deletion fails, the task still starts.
pub(super) async fn node_logs(
    version: &VersionDir,
    user: Option<&TaskUser>,
) -> [(String, String); 1] {
    let logs = version.node_logs();
    let user = user.cloned();
    let variable = ("ROS_LOG_DIR".to_owned(), logs.display().to_string());
    let empty = move || {
        durable::remove_dir_all(&logs)?;
        // The version's directory belongs to root, so a task user needs a log directory of its own.
        user.map_or(Ok(()), |user| user.make_home(&logs))
    };
    let emptied = tokio::task::spawn_blocking(empty).await;
    if let Err(error) = emptied.map_err(io::Error::from).flatten() {
        tracing::warn!(%error, "cannot delete the nodes' own log files");
    }
    [variable]
}

impl Robot {
    /// The ROS facts for tasks that are started now.
    pub(super) fn ros_facts(&self) -> Option<RosFacts> {
        self.ros_facts_in(&self.resolved().environment)
    }

    /// The ROS facts for tasks with this environment.
    pub(super) fn ros_facts_in(&self, environment: &BTreeMap<String, String>) -> Option<RosFacts> {
        environment::ros_facts(&self.installations(), environment)
    }

    /// The ROS facts of the run in the directory `dir`: a run stays in the domain that it was
    /// started in.
    pub(super) fn ros_facts_of(&self, dir: &Path) -> Option<RosFacts> {
        match RunDir::at(dir).spec() {
            Ok(Some(spec)) => self.ros_facts_in(&spec.environment),
            // The run was not started, or its specification is no longer readable.
            Ok(None) | Err(_) => self.ros_facts(),
        }
    }

    pub(super) fn installations(&self) -> Vec<Installation> {
        self.ros.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(super) fn setup_files(&self, manifest: &TaskManifest) -> Result<Vec<PathBuf>, StepFailure> {
        let version = launch::of(manifest).ros;
        let found =
            underlay::setup_files(&self.installations(), version, &manifest.requires.ros_distro);
        found.map_err(|error| permanent_failure(FailureCode::REQUIREMENTS_UNMET, &error))
    }

    /// The setup files for a run that is to be started. If one is missing, the installations are
    /// searched once more. For a run that was ready before, the failure is retried: the file may
    /// come back with a disk that is mounted late or a package that is being upgraded.
    pub(super) fn setup_files_of(
        &self,
        run: &ActiveRun,
        manifest: &TaskManifest,
    ) -> Result<Vec<PathBuf>, StepFailure> {
        let again = |_| {
            self.find_installations();
            self.setup_files(manifest)
        };
        let retry_after_ms = run.was_ever_ready().then_some(0);
        self.setup_files(manifest)
            .or_else(again)
            .map_err(|error| StepFailure { retry_after_ms, ..error })
    }

    /// Adopts the installations found by the effective settings, until a probe has inspected them.
    /// Tasks that were started already may have to be restarted before the probe runs.
    pub(super) fn find_installations(&self) {
        let found = self.resolved().installations();
        *self.ros.write().unwrap_or_else(PoisonError::into_inner) = found;
    }

    /// Probes the installations, and repeats the probe if the settings have changed meanwhile.
    pub(super) async fn probe_installations(&self) {
        let dir = self.data.root().join(PROBE_DIR);
        loop {
            let resolved = self.resolved();
            let found = resolved.installations();
            let seen = match &self.task_user {
                Ok(user) => {
                    probe::probe_installations(found, &resolved.environment, &dir, user.as_ref())
                        .await
                }
                // Setup files may belong to any user, so they are never sourced as root for want of
                // a task user.
                Err(_) => found,
            };
            // A change of the settings happens before its write to this field.
            let mut ros = self.ros.write().unwrap_or_else(PoisonError::into_inner);
            if Arc::ptr_eq(&resolved, &self.resolved()) {
                *ros = seen;
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use serde_json::json;
    use task_proto::desired::settings::RobotSettings;

    use super::super::tests::{robot, run_dir};
    use super::*;
    use crate::task::effects::Effects as _;

    fn setup(dir: &Path, name: &str, text: &str) -> (PathBuf, RobotSettings) {
        let path = dir.join(name);
        std::fs::write(&path, text).expect("written");
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).expect("readable");
        let settings = serde_json::from_value(json!({ "underlays": [path] })).expect("parses");
        (path, settings)
    }

    #[tokio::test]
    async fn node_log_directory_is_emptied_at_each_start() {
        let temp = tempfile::tempdir().expect("a directory");
        let digest = task_proto::Digest::of(b"manifest");
        let data = crate::system::layout::DataDir::new(temp.path()).expect("a directory");
        let version = data.task(&"talker".parse().expect("valid")).version(&digest);
        let [(name, place)] = node_logs(&version, None).await;
        assert_eq!(
            (name.as_str(), Path::new(&place)),
            ("ROS_LOG_DIR", version.node_logs().as_path())
        );
        std::fs::create_dir_all(version.node_logs().join("2026-11-22")).expect("made");
        std::fs::write(version.node_logs().join("2026-11-22/launch.log"), "long").expect("written");
        node_logs(&version, None).await;
        assert!(!version.node_logs().exists() && version.root().exists());
    }

    #[test]
    fn server_ros_settings_apply_before_a_probe() {
        let temp = tempfile::tempdir().expect("a directory");
        let (own, _) = setup(temp.path(), "own.bash", "");
        let (path, settings) = setup(temp.path(), "setup.bash", "");
        let robot = robot(temp.path(), "");
        robot.adopt(&settings);
        let setups = |robot: &Robot| {
            robot.installations().into_iter().flat_map(|found| found.setups).collect::<Vec<_>>()
        };
        assert_eq!(setups(&robot), [path]);
        assert!(robot.ros_facts().is_some(), "its graph can be watched");
        let stays = RobotSettings { ros_domain_id: Some(7), ..settings };
        robot.ros.write().expect("sound")[0].packages = Some(["rclpy".to_owned()].into());
        robot.adopt(&stays);
        assert!(
            robot.installations()[0].packages.is_some(),
            "the observation of unchanged files is still valid"
        );
        robot.adopt(&RobotSettings {
            underlays: Some(vec![own.to_str().expect("text").parse().expect("valid")]),
            ..stays
        });
        assert_eq!(setups(&robot), [own]);
    }

    #[test]
    fn run_keeps_its_ros_domain_after_a_settings_change() {
        let temp = tempfile::tempdir().expect("a directory");
        let (_, settings) = setup(temp.path(), "setup.bash", "");
        let robot = robot(temp.path(), "");
        let set = |id| robot.adopt(&RobotSettings { ros_domain_id: Some(id), ..settings.clone() });
        set(7);
        let run = run_dir(&temp.path().join("run"), robot.resolved().environment.clone());
        set(9);
        let domain = |facts: Option<RosFacts>| facts.and_then(|facts| facts.domain_id);
        assert_eq!(domain(robot.ros_facts_of(run.path())), Some(7));
        assert_eq!(domain(robot.ros_facts_of(&temp.path().join("none"))), Some(9));
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn probe_begun_under_old_settings_is_repeated() {
        let temp = tempfile::tempdir().expect("a directory");
        let begun = temp.path().join("begun");
        let go = temp.path().join("go");
        let waiting = format!(
            "touch {}\nuntil [ -e {} ]; do read -rt 0.05 _ <> <(:); done\n",
            begun.display(),
            go.display()
        );
        let (_, before) = setup(temp.path(), "before.bash", &waiting);
        let (path, after) =
            setup(temp.path(), "after.bash", "export ROS_DISTRO=jazzy ROS_VERSION=2\n");
        let uid = nix::unistd::geteuid();
        let robot = Arc::new(robot(temp.path(), &format!("task_user = \"{uid}\"\n")));
        robot.adopt(&before);
        let looking = tokio::spawn({
            let robot = robot.clone();
            async move { robot.probe_ros().await }
        });
        while !begun.exists() {
            tokio::task::yield_now().await;
        }
        robot.adopt(&after);
        std::fs::write(&go, "").expect("written");
        looking.await.expect("looked");
        let found = robot.installations();
        assert_eq!(found.last().map(|found| &found.setups), Some(&vec![path]));
        assert_eq!(found.last().map(|found| found.distros.clone()), Some(vec!["jazzy".to_owned()]));
    }
}
