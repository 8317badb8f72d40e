//! Outputs of tasks: the files that `[outputs]` names, as one OCI artifact per run in a
//! repository of the robot's own. Pushed by the robot, read by operators with any OCI client.

use serde::{Deserialize, Serialize};

use crate::desired::BlobRef;
use crate::ids::OutputPath;
use crate::packages::oci::{Descriptor, ImageManifest, MANIFEST_TYPE};
use crate::{DeploymentId, RepositoryName, RobotId, Tag, TaskName, Version};

/// `artifactType` of an output.
pub const OUTPUT_TYPE: &str = "application/vnd.taskd.output.v1";
/// Media type of an output's config: an [`OutputSet`] as JSON.
pub const OUTPUT_CONFIG_TYPE: &str = "application/vnd.taskd.output.config.v1+json";
/// Media type of each of an output's layers: one file.
pub const FILE_TYPE: &str = "application/octet-stream";
/// The most files of one run.
pub const MAX_FILES: usize = 256;

/// The files of one run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OutputSet {
    /// The robot that ran the task.
    pub robot_id: RobotId,
    /// The task's name.
    pub task: TaskName,
    /// The task's version.
    pub version: Version,
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// Number of the run within the deployment.
    pub run: u64,
    /// The files, sorted by path; at most [`MAX_FILES`].
    pub files: Vec<OutputFile>,
}

/// One file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OutputFile {
    /// Path below the directory that the task ran in.
    pub path: OutputPath,
    /// The file's bytes.
    #[serde(flatten)]
    pub blob: BlobRef,
}

impl OutputSet {
    /// The repository of the output: `outputs/<robot id>/<task>`.
    pub fn repository(&self) -> Option<RepositoryName> {
        repository(&self.robot_id, &self.task)
    }

    /// The tag of the output: `<deployment>-<run>`.
    pub fn tag(&self) -> Option<Tag> {
        format!("{}-{}", self.deployment, self.run).parse().ok()
    }

    /// The manifest of the output, where `config` is the blob of the set's own JSON.
    pub fn manifest(&self, config: BlobRef) -> ImageManifest {
        let layer = |file: &OutputFile| {
            let mut layer = Descriptor::new(FILE_TYPE, file.blob);
            layer
                .annotations
                .insert("org.opencontainers.image.title".to_owned(), file.path.to_string());
            layer
        };
        ImageManifest {
            schema_version: 2,
            media_type: Some(MANIFEST_TYPE.to_owned()),
            artifact_type: Some(OUTPUT_TYPE.to_owned()),
            config: Descriptor::new(OUTPUT_CONFIG_TYPE, config),
            layers: self.files.iter().map(layer).collect(),
            subject: None,
            annotations: [].into(),
        }
    }
}

/// The repository of a robot's outputs of a task. Never `None` for ids and names as generated
/// today.
pub fn repository(robot: &RobotId, task: &TaskName) -> Option<RepositoryName> {
    format!("outputs/{robot}/{task}").parse().ok()
}

/// The robot and task of an output repository; `None` for other repositories.
pub fn owner(repository: &RepositoryName) -> Option<(RobotId, TaskName)> {
    let (robot, task) = repository.as_str().strip_prefix("outputs/")?.split_once('/')?;
    Some((robot.parse().ok()?, task.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repository_names_its_owner() {
        let robot = RobotId::random();
        let task: TaskName = "corridor_mapping".parse().expect("valid");
        let name = repository(&robot, &task).expect("a name");
        assert_eq!(owner(&name), Some((robot, task)));
        for foreign in ["corridor_mapping", "outputs", "outputs/x/y", "inputs/r00000000000000a1/y"]
        {
            assert_eq!(owner(&foreign.parse().expect("valid")), None, "{foreign}");
        }
    }
}
