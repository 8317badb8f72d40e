//! The environments of builds, tasks and the gate, with the variables that name the robot and the
//! task. A running process keeps the environment of its start.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::PoisonError;

use task_proto::DeploymentId;
use task_proto::desired::{PackageRef, RobotDescription};
use task_proto::messages::report::FailureCode;

use super::Robot;
use super::outcomes::retryable_failure;
use crate::setup::environment;
use crate::system::task_user::TaskUser;
use crate::task::plan::StepFailure;

impl Robot {
    /// Adopts the name and labels that the server holds. Processes that are started from now on get
    /// them.
    pub(super) fn describe(&self, robot: &RobotDescription) {
        self.description.write().unwrap_or_else(PoisonError::into_inner).clone_from(robot);
    }

    /// The environment of every program that is started for this robot.
    pub(super) fn robot_environment(&self) -> BTreeMap<String, String> {
        let mut environment = self.resolved().environment.clone();
        let description = self.description.read().unwrap_or_else(PoisonError::into_inner);
        environment.extend(environment::robot_variables(&self.robot, &description));
        environment
    }

    /// The environment of a build or run of `package` as `user` with the home directory `home`.
    /// Also makes the task's directories reachable for `user`.
    pub(super) fn environment_of(
        &self,
        package: &PackageRef,
        deployment: &DeploymentId,
        user: Option<&TaskUser>,
        home: &Path,
    ) -> Result<BTreeMap<String, String>, StepFailure> {
        let task = &package.name;
        let mut environment = self.robot_environment();
        environment.extend(environment::task_variables(task, &package.version, deployment));
        if let Some(user) = user {
            let opened = user
                .make_home(home)
                .and_then(|()| user.allow_traversal(&self.data.path_dirs(task)));
            opened.map_err(|error| retryable_failure(FailureCode::IO_ERROR, &error, 0))?;
            environment.insert("HOME".to_owned(), home.display().to_string());
            environment
                .extend(["USER", "LOGNAME"].map(|name| (name.to_owned(), user.name.clone())));
        }
        Ok(environment)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use task_proto::desired::BlobRef;

    use super::super::tests::robot;
    use super::*;

    #[test]
    fn build_and_run_name_the_robot_and_the_task_of_their_start() {
        let temp = tempfile::tempdir().expect("a directory");
        let robot = robot(temp.path(), "");
        let (name, version) = ("talker".parse(), "1.0.0".parse());
        let blob = BlobRef::of(b"1");
        let package = PackageRef {
            name: name.expect("valid"),
            version: version.expect("valid"),
            manifest: blob,
            config: blob,
            content: blob,
        };
        let deployment = DeploymentId::random();
        let environment = || {
            robot.environment_of(&package, &deployment, None, temp.path()).expect("an environment")
        };
        let before = environment();
        assert_eq!(before["TASKD_ROBOT"], before["TASKD_ROBOT_ID"], "an earlier server's order");
        let description = json!({ "name": "atlas", "labels": { "site": "lab" } });
        robot.describe(&serde_json::from_value(description).expect("parses"));
        let after = environment();
        let named = ["ROBOT", "TASK", "VERSION", "LABEL_SITE", "DEPLOYMENT"]
            .map(|name| &*after[&format!("TASKD_{name}")]);
        assert_eq!(named, ["atlas", "talker", "1.0.0", "lab", deployment.as_str()]);
        assert_eq!(after["TASKD_ROBOT_ID"], before["TASKD_ROBOT_ID"]);
    }
}
