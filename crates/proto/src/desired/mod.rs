//! Owns the state that a robot should be in, and its settings on the server; it never says which
//! steps lead there.
//!
//! There is one signed document for each robot and generation, and its announcement. A task that is
//! absent from the document should be absent from the robot.

pub mod settings;

use std::collections::BTreeMap;
use std::fmt;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Deserializer, Serialize};

use crate::desired::settings::{RobotSettings, default_if_unreadable, read_known_settings};
use crate::ids::Labels;
use crate::trust::envelope::Envelope;
use crate::{DeploymentId, Digest, Generation, RobotId, RobotName, TaskName, Version};

/// The largest [`Envelope`], in bytes of JSON, that travels inside an MQTT message. For a larger
/// one, the message has only the generation.
pub const MAX_PUSHED_ENVELOPE_BYTES: usize = 64 * 1024;
/// The largest [`DesiredNotice`], in bytes of JSON: an envelope and the inline blobs.
pub const MAX_DESIRED_NOTICE_BYTES: usize = 128 * 1024;

/// All tasks that one robot should run. Travels as the payload of an [`Envelope`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DesiredState {
    /// The robot that the state is for; any other robot refuses it.
    pub robot_id: RobotId,
    /// A robot refuses a generation below the last it accepted.
    pub generation: Generation,
    /// When it was signed: milliseconds since the Unix epoch, by the server's clock.
    pub issued_at_ms: u64,
    /// When the state expires: no new work starts by it afterwards. Milliseconds since the Unix
    /// epoch.
    pub expires_at_ms: u64,
    /// The tasks, at most one per name, sorted by name.
    pub tasks: Vec<DesiredTask>,
    /// Blobs signed by publishers, for a robot that requires signatures to run the tasks. They are
    /// no part of the desired state: they may change without a new generation.
    #[serde(default, skip_serializing_if = "Evidence::is_empty")]
    pub evidence: Evidence,
    /// Settings that the robot's administrator has set on the server; the robot's own settings win.
    #[serde(
        default,
        skip_serializing_if = "RobotSettings::is_empty",
        deserialize_with = "read_known_settings"
    )]
    pub settings: RobotSettings,
    /// The robot's name and labels, for the environment of its tasks. Like the evidence, they may
    /// change without a new generation. Absent from earlier servers.
    #[serde(
        default,
        skip_serializing_if = "RobotDescription::is_empty",
        deserialize_with = "default_if_unreadable"
    )]
    pub robot: RobotDescription,
}

/// The name and labels that the server holds of a robot.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct RobotDescription {
    /// The robot's name.
    #[serde(skip_serializing_if = "Option::is_none", deserialize_with = "default_if_unreadable")]
    pub name: Option<RobotName>,
    /// The robot's labels.
    #[serde(skip_serializing_if = "Labels::is_empty", deserialize_with = "readable_labels")]
    pub labels: Labels,
}

/// Reads the labels that this version can read: labels must not make a state unreadable.
fn readable_labels<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Labels, D::Error> {
    let given: serde_json::Map<_, _> = default_if_unreadable(deserializer)?;
    let readable = given
        .into_iter()
        .filter_map(|(key, value)| Some((key.parse().ok()?, value.as_str()?.parse().ok()?)));
    Ok(readable.collect())
}

impl RobotDescription {
    /// Whether nothing is known of the robot.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// References to blobs that publishers have signed, see [`crate::packages::publisher`]. The
/// reference itself proves nothing.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Evidence {
    /// Lists of publishers: each list that changed the keepers, and the newest list; the oldest
    /// first.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub lists: Vec<BlobRef>,
    /// Signatures of the packages named in the state, and of those that the robot goes back to if
    /// they do not get ready.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub signatures: Vec<SignatureRef>,
}

/// Reference to an envelope with a signed statement that a package may be run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SignatureRef {
    /// The package, by the digest of its OCI manifest.
    pub manifest: Digest,
    /// The envelope's bytes.
    pub envelope: BlobRef,
}

impl Evidence {
    /// Whether there are no references.
    pub fn is_empty(&self) -> bool {
        self.lists.is_empty() && self.signatures.is_empty()
    }

    /// The envelopes about one package.
    pub fn signatures_of(&self, package: &PackageRef) -> Vec<BlobRef> {
        let same = |signature: &&SignatureRef| signature.manifest == package.manifest.digest;
        self.signatures.iter().filter(same).map(|signature| signature.envelope).collect()
    }

    /// All blobs of the evidence.
    pub fn blobs(&self) -> impl Iterator<Item = BlobRef> {
        self.lists.iter().copied().chain(self.signatures.iter().map(|signature| signature.envelope))
    }
}

/// One task as it should be on the robot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DesiredTask {
    /// The task's name, which is its package's name.
    pub task: TaskName,
    /// The deployment that ordered the task.
    pub deployment: DeploymentId,
    /// The package to run.
    pub package: PackageRef,
    /// Whether the task should be running.
    pub wanted: TargetState,
    /// Number of times the task was asked to start, from 1. A job runs once for each value.
    pub run: u64,
    /// How the package's bytes should travel.
    #[serde(default)]
    pub delivery: Delivery,
    /// Tasks with a higher priority are handled first. From -100 to 100.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub priority: i32,
}

fn is_zero(priority: &i32) -> bool {
    *priority == 0
}

/// A package pinned by digest.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
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

/// A blob, by digest and size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BlobRef {
    /// Digest of the bytes.
    pub digest: Digest,
    /// Number of bytes.
    pub size: u64,
}

impl BlobRef {
    /// The reference to these bytes.
    pub fn of(bytes: &[u8]) -> Self {
        Self { digest: Digest::of(bytes), size: bytes.len() as u64 }
    }
}

/// The state that a task should be in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum TargetState {
    /// The task should be running.
    Running,
    /// Installed, but not running.
    Stopped,
}

/// How a package's bytes travel to a robot.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Delivery {
    /// Nothing is published; the robot asks on its own timer.
    Poll,
    /// The bytes come as parts on the package's topic.
    DirectPush,
    /// The bytes travel in the same message as the state, see [`Inline`].
    Inline,
    /// MQTT announces the package, the robot pulls it over HTTP. Also an agent's fallback for a
    /// method that it does not know.
    #[default]
    #[serde(other)]
    PushPull,
}

impl Delivery {
    /// The delivery method as it is written on the wire.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Poll => "poll",
            Self::DirectPush => "direct-push",
            Self::Inline => "inline",
            Self::PushPull => "push-pull",
        }
    }

    /// Whether the content comes as parts over MQTT.
    pub fn is_pushed(self) -> bool {
        self == Self::DirectPush
    }
}

impl fmt::Display for Delivery {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

/// The message that the server publishes on a robot's `desired` topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum DesiredNotice {
    /// The complete signed state.
    State {
        /// The signed state.
        #[serde(flatten)]
        envelope: Envelope,
        /// Blobs that the state names.
        #[serde(default, skip_serializing_if = "Inline::is_empty")]
        inline: Inline,
    },
    /// The state is too large for a message: the robot fetches it by GET.
    Notice {
        /// The generation to fetch.
        generation: Generation,
    },
}

/// Blobs that travel beside a signed state, in base64. They are not signed: each is looked up by
/// the digest that the state names, and must hash to that digest.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Inline(BTreeMap<Digest, Vec<u8>>);

impl Inline {
    /// Adds a blob under its digest.
    pub fn insert(&mut self, digest: Digest, bytes: Vec<u8>) {
        self.0.insert(digest, bytes);
    }

    /// Whether there are no blobs.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The bytes of `blob`, if present and of the right size and digest.
    pub fn get(&self, blob: &BlobRef) -> Option<&[u8]> {
        let bytes = self.0.get(&blob.digest)?;
        (bytes.len() as u64 == blob.size && Digest::of(bytes) == blob.digest).then_some(bytes)
    }
}

impl Serialize for Inline {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer
            .collect_map(self.0.iter().map(|(digest, bytes)| (digest, STANDARD.encode(bytes))))
    }
}

/// Unreadable blobs are skipped, because the state beside them is valid without them.
impl<'de> Deserialize<'de> for Inline {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let given: BTreeMap<String, serde_json::Value> = Deserialize::deserialize(deserializer)?;
        let readable = given.into_iter().filter_map(|(digest, text)| {
            Some((digest.parse().ok()?, STANDARD.decode(text.as_str()?).ok()?))
        });
        Ok(Self(readable.collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blob(bytes: &[u8]) -> BlobRef {
        BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 }
    }

    #[test]
    fn unreadable_label_leaves_the_others() {
        let read = |value| serde_json::from_value::<RobotDescription>(value).expect("reads");
        let robot = read(serde_json::json!({
            "name": {"first": "atlas"}, "labels": {"site": "lab", "a b": "x", "n": 7},
        }));
        let site = ("site".parse().expect("a key"), "lab".parse().expect("a value"));
        assert_eq!(robot, RobotDescription { name: None, labels: [site].into() });
        assert_eq!(read(serde_json::json!({"labels": 7})), RobotDescription::default());
    }

    #[test]
    fn inline_blob_is_returned_only_if_it_matches_its_reference() {
        let mut inline = Inline::default();
        inline.insert(Digest::of(b"true"), b"true".to_vec());
        inline.insert(Digest::of(b"other"), b"false".to_vec());
        let read: Inline =
            serde_json::from_value(serde_json::to_value(&inline).expect("json")).expect("reads");
        assert_eq!(read, inline);
        assert_eq!(read.get(&blob(b"true")), Some(&b"true"[..]));
        assert_eq!(read.get(&blob(b"other")), None);
        assert_eq!(read.get(&blob(b"absent")), None);
        assert_eq!(read.get(&BlobRef { size: 5, ..blob(b"true") }), None);
    }

    #[test]
    fn unreadable_inline_blobs_are_skipped() {
        let good = Digest::of(b"x").to_string();
        let other = Digest::of(b"y").to_string();
        let value = serde_json::json!({"sha512:00": "eA==", "x": 7, good: "eA==", other: "!"});
        let read: Inline = serde_json::from_value(value).expect("reads");
        assert_eq!(read.get(&blob(b"x")), Some(&b"x"[..]));
        assert_eq!(read.0.len(), 1);
    }
}
