//! The parts of the OCI image and distribution specifications (v1.1) that taskd writes or reads.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::Digest;
use crate::desired::BlobRef;

/// Media type of an image manifest, the only kind of manifest a package uses.
pub const MANIFEST_TYPE: &str = "application/vnd.oci.image.manifest.v1+json";
/// Media type of an image index; stored for other clients, never deployed.
pub const INDEX_TYPE: &str = "application/vnd.oci.image.index.v1+json";
/// `artifactType` of a task package.
pub const PACKAGE_TYPE: &str = "application/vnd.taskd.package.v1";
/// Media type of a package's config: a [`crate::packages::manifest::TaskManifest`] as JSON.
pub const CONFIG_TYPE: &str = "application/vnd.taskd.config.v1+json";
/// Media type of a package's one layer.
pub const CONTENT_TYPE: &str = "application/vnd.taskd.content.v1.tar+zstd";
/// Media type of an empty config: `{}`.
pub const EMPTY_TYPE: &str = "application/vnd.oci.empty.v1+json";
/// The bytes of an empty config.
pub const EMPTY: &[u8] = b"{}";
/// Media type of a layer that is a [`crate::trust::envelope::Envelope`].
pub const ENVELOPE_TYPE: &str = "application/vnd.dsse.envelope.v1+json";

/// An OCI content descriptor.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Descriptor {
    /// The content's media type.
    pub media_type: String,
    /// The content's digest.
    pub digest: Digest,
    /// The content's size in bytes.
    pub size: u64,
    /// The type of the artifact a manifest descriptor points to (referrers lists).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub artifact_type: Option<String>,
    /// Arbitrary annotations.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub annotations: BTreeMap<String, String>,
}

impl Descriptor {
    /// A descriptor without artifact type or annotations.
    pub fn new(media_type: &str, blob: BlobRef) -> Self {
        Self {
            media_type: media_type.to_owned(),
            digest: blob.digest,
            size: blob.size,
            artifact_type: None,
            annotations: BTreeMap::new(),
        }
    }

    /// The blob's digest and size.
    pub fn blob(&self) -> BlobRef {
        BlobRef { digest: self.digest, size: self.size }
    }
}

/// An OCI image manifest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct ImageManifest {
    /// Always 2.
    pub schema_version: u32,
    /// [`MANIFEST_TYPE`]; other writers may leave it out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub media_type: Option<String>,
    /// Type of the artifact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub artifact_type: Option<String>,
    /// The config blob.
    pub config: Descriptor,
    /// The content blobs.
    pub layers: Vec<Descriptor>,
    /// The manifest this one refers to, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subject: Option<Descriptor>,
    /// Arbitrary annotations.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub annotations: BTreeMap<String, String>,
}

impl ImageManifest {
    /// The manifest of a task package.
    pub fn package(config: BlobRef, content: BlobRef) -> Self {
        Self {
            schema_version: 2,
            media_type: Some(MANIFEST_TYPE.to_owned()),
            artifact_type: Some(PACKAGE_TYPE.to_owned()),
            config: Descriptor::new(CONFIG_TYPE, config),
            layers: vec![Descriptor::new(CONTENT_TYPE, content)],
            subject: None,
            annotations: BTreeMap::new(),
        }
    }

    /// The manifest of an artifact of type `artifact_type` that holds a signed document, about
    /// `subject` or on its own.
    pub fn signed_document(
        artifact_type: &str,
        envelope: BlobRef,
        subject: Option<BlobRef>,
    ) -> Self {
        Self {
            schema_version: 2,
            media_type: Some(MANIFEST_TYPE.to_owned()),
            artifact_type: Some(artifact_type.to_owned()),
            config: Descriptor::new(EMPTY_TYPE, BlobRef::of(EMPTY)),
            layers: vec![Descriptor::new(ENVELOPE_TYPE, envelope)],
            subject: subject.map(|subject| Descriptor::new(MANIFEST_TYPE, subject)),
            annotations: BTreeMap::new(),
        }
    }

    /// The signed document, if the artifact has no other content.
    pub fn lone_envelope(&self) -> Option<BlobRef> {
        let [envelope] = &self.layers[..] else { return None };
        (envelope.media_type == ENVELOPE_TYPE).then(|| envelope.blob())
    }

    /// The config and content blobs, if this is the manifest of a task package.
    pub fn package_blobs(&self) -> Option<(BlobRef, BlobRef)> {
        let [content] = &self.layers[..] else { return None };
        let is_package = self.artifact_type.as_deref() == Some(PACKAGE_TYPE)
            && self.config.media_type == CONFIG_TYPE
            && content.media_type == CONTENT_TYPE;
        is_package.then(|| (self.config.blob(), content.blob()))
    }
}
