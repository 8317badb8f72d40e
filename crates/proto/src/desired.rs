//! The state a robot should be in: one signed document per robot and generation, and how it is announced.
//! Whatever is absent from the document should be absent from the robot.

use serde::{Deserialize, Serialize};

use crate::envelope::Envelope;
use crate::{DeploymentId, Digest, Generation, RobotId, TaskName, Version};

/// The largest [`Envelope`], in bytes of JSON, that travels inside an MQTT message; above it only the generation does.
pub const MAX_PUSHED_ENVELOPE_BYTES: usize = 64 * 1024;

/// Everything one robot should run. Travels as the payload of an [`Envelope`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DesiredState {
    /// The robot this is for; any other refuses it.
    pub robot_id: RobotId,
    /// A robot refuses a generation below the last it accepted.
    pub generation: Generation,
    /// When it was signed: milliseconds since the Unix epoch, by the server's clock.
    pub issued_at_ms: u64,
    /// Until when new work may be begun by it, likewise.
    pub expires_at_ms: u64,
    /// The tasks, at most one of a name, sorted by name.
    pub tasks: Vec<DesiredTask>,
}

/// One task as it should be on the robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DesiredTask {
    /// The task's name: that of its package.
    pub task: TaskName,
    /// The order that put it here.
    pub deployment: DeploymentId,
    /// What to run.
    pub package: PackageRef,
    /// Whether it should be running.
    pub wanted: Wanted,
    /// How often it was asked to start, from 1. A job runs once for each value.
    pub run: u64,
    /// How the bytes should travel.
    #[serde(default)]
    pub delivery: Delivery,
}

/// A package pinned by digest.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct PackageRef {
    /// The package's name.
    pub name: TaskName,
    /// The package's version.
    pub version: Version,
    /// The OCI manifest: the package's identity.
    pub manifest: BlobRef,
    /// The task manifest, JSON.
    pub config: BlobRef,
    /// The content, tar+zstd.
    pub content: BlobRef,
}

/// Bytes by digest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct BlobRef {
    /// What they hash to.
    pub digest: Digest,
    /// How many they are.
    pub size: u64,
}

/// Whether a task should be running.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Wanted {
    /// Yes.
    Running,
    /// Installed, but not running.
    Stopped,
}

/// How a package's bytes travel to a robot.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Delivery {
    /// Nothing is published; the robot asks on its own timer.
    Poll,
    /// MQTT pushes the link, the robot pulls over HTTP. Also what an agent does with a mechanism it does not know.
    #[default]
    #[serde(other)]
    PushPull,
}

/// What the server publishes on a robot's `desired` topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Doorbell {
    /// The whole signed state.
    State(Envelope),
    /// Too large for a message: the robot GETs it.
    Notice {
        /// The generation that waits.
        generation: Generation,
    },
}
