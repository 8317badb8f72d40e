//! Parses the parts of a manifest that the registry has to understand: its blobs and manifests, its
//! subject, and whether the manifest is a task package. All other fields are kept as they are and
//! not interpreted.

use std::collections::BTreeMap;

use serde::Deserialize;
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;
use task_proto::packages::oci::{INDEX_TYPE, ImageManifest, MANIFEST_TYPE, PACKAGE_TYPE};
use task_proto::packages::output::OUTPUT_TYPE;
use task_proto::packages::publisher::{LIST_ARTIFACT, SIGNATURE_ARTIFACT};

use super::OciError;

const DOCKER_MANIFEST_TYPE: &str = "application/vnd.docker.distribution.manifest.v2+json";
const DOCKER_LIST_TYPE: &str = "application/vnd.docker.distribution.manifest.list.v2+json";
/// The most blobs and manifests of one manifest: each one costs a lookup.
const MAX_PARTS: usize = 4096;
/// The most bytes of annotations, names included, of a manifest that refers to another: lists of
/// referrers repeat the annotations.
const MAX_ANNOTATION_BYTES: usize = 64 * 1024;

/// The parsed fields of a manifest of any kind.
#[derive(Debug)]
pub struct ParsedManifest {
    /// The content type under which the manifest is served; always a type of JSON.
    pub media_type: String,
    /// The artifact type in lists of referrers.
    pub artifact_type: Option<String>,
    /// The annotations in lists of referrers.
    pub annotations: BTreeMap<String, String>,
    /// The manifest that this one refers to.
    pub subject: Option<String>,
    /// The blobs and manifests that must be in the repository.
    pub parts: Vec<Digest>,
    /// The full manifest, if its type is that of a task package.
    pub package: Option<ImageManifest>,
    /// The full manifest, if its type is that of a run's output.
    pub output: Option<ImageManifest>,
    /// The full manifest, if its type is that of a package signature by publishers.
    pub signature: Option<ImageManifest>,
    /// The full manifest, if its type is that of a list of publishers.
    pub publishers: Option<ImageManifest>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    media_type: Option<String>,
    artifact_type: Option<String>,
    config: Option<Part>,
    layers: Option<Vec<Part>>,
    manifests: Option<Vec<Part>>,
    subject: Option<Part>,
    annotations: Option<BTreeMap<String, String>>,
}

/// A descriptor. Its digest may use any algorithm; stored blobs use sha256 or sha512.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Part {
    media_type: String,
    digest: String,
}

impl Part {
    /// True for layers that, by their type, are not distributed with the image.
    fn is_not_distributed(&self) -> bool {
        self.media_type.starts_with("application/vnd.oci.image.layer.nondistributable.")
            || self.media_type == "application/vnd.docker.image.rootfs.foreign.diff.tar.gzip"
    }
}

impl ParsedManifest {
    /// Parses a manifest that came with `content_type`.
    pub fn new(content_type: Option<&str>, bytes: &[u8]) -> Result<Self, OciError> {
        let invalid = |error: serde_json::Error| {
            OciError::manifest_invalid(format!("not a manifest: {error}"))
        };
        let document: Document = serde_json::from_slice(bytes).map_err(invalid)?;
        let media_type = media_type(content_type, document.media_type.as_deref())?;
        document.check_kind(&media_type)?;
        let parse_if_type = |kind: &str| {
            let is_type = document.artifact_type.as_deref() == Some(kind);
            is_type.then(|| serde_json::from_slice(bytes).map_err(invalid)).transpose()
        };
        let (package, output) = (parse_if_type(PACKAGE_TYPE)?, parse_if_type(OUTPUT_TYPE)?);
        let (signature, publishers) =
            (parse_if_type(SIGNATURE_ARTIFACT)?, parse_if_type(LIST_ARTIFACT)?);
        let config_type = document.config.as_ref().map(|config| config.media_type.clone());
        let parsed = Self {
            media_type,
            parts: document.parts()?,
            artifact_type: document.artifact_type.filter(|kind| !kind.is_empty()).or(config_type),
            annotations: document.annotations.unwrap_or_default(),
            subject: document.subject.map(|subject| subject.digest),
            package,
            output,
            signature,
            publishers,
        };
        parsed.check_texts()?;
        parsed.check_annotations()?;
        Ok(parsed)
    }

    /// Documents for or from robots must use sha256, the algorithm that robots of every version
    /// know.
    pub(super) fn check_robot_algorithms(&self, manifest: Digest) -> Result<(), OciError> {
        let documents = [&self.package, &self.output, &self.signature, &self.publishers];
        if documents.into_iter().all(Option::is_none) {
            return Ok(());
        }
        let mut digests = self.parts.iter().chain([&manifest]);
        match digests.find(|digest| digest.algorithm() != Algorithm::Sha256) {
            Some(other) => {
                let message = format!("{other}: robots only support digests by sha256");
                Err(OciError::manifest_invalid(message))
            }
            None => Ok(()),
        }
    }

    /// These texts go into headers and columns, which can't hold control characters.
    fn check_texts(&self) -> Result<(), OciError> {
        let texts =
            [("artifactType", self.artifact_type.as_ref()), ("subject", self.subject.as_ref())];
        match texts
            .iter()
            .find(|(_, text)| text.is_some_and(|text| text.contains(char::is_control)))
        {
            Some((key, _)) => {
                Err(OciError::manifest_invalid(format!("{key}: contains a control character")))
            }
            None => Ok(()),
        }
    }

    fn check_annotations(&self) -> Result<(), OciError> {
        let bytes: usize =
            self.annotations.iter().map(|(key, value)| key.len() + value.len()).sum();
        if self.subject.is_none() || bytes <= MAX_ANNOTATION_BYTES {
            return Ok(());
        }
        let message = format!(
            "annotations: {bytes} bytes; at most {MAX_ANNOTATION_BYTES} are allowed in a manifest with a subject"
        );
        Err(OciError::manifest_invalid(message))
    }
}

impl Document {
    /// Known types must have their required parts; other types are accepted as they are.
    fn check_kind(&self, media_type: &str) -> Result<(), OciError> {
        let missing = match media_type {
            MANIFEST_TYPE | DOCKER_MANIFEST_TYPE if self.config.is_none() => "config",
            MANIFEST_TYPE | DOCKER_MANIFEST_TYPE if self.layers.is_none() => "layers",
            INDEX_TYPE | DOCKER_LIST_TYPE if self.manifests.is_none() => "manifests",
            _ => return Ok(()),
        };
        Err(OciError::manifest_invalid(format!(
            "a manifest of type {media_type} needs {missing:?}"
        )))
    }

    fn parts(&self) -> Result<Vec<Digest>, OciError> {
        let lists = [&self.layers, &self.manifests].into_iter().flatten().flatten();
        let needed = self.config.iter().chain(lists).filter(|part| !part.is_not_distributed());
        let mut parts = Vec::new();
        for part in needed {
            let digest = part.digest.parse().map_err(|_| {
                OciError::manifest_invalid(format!(
                    "{:?} is not a digest of sha256 or sha512; others are not supported",
                    part.digest
                ))
            })?;
            if parts.len() == MAX_PARTS {
                return Err(OciError::manifest_invalid(format!(
                    "the manifest has more than {MAX_PARTS} parts"
                )));
            }
            parts.push(digest);
        }
        parts.sort();
        parts.dedup();
        Ok(parts)
    }
}

/// The manifest's type. If both the header and the document name a type, the two must agree.
fn media_type(header: Option<&str>, document: Option<&str>) -> Result<String, OciError> {
    let header = header
        .and_then(|text| text.split(';').next())
        .map(str::trim)
        .filter(|text| !text.is_empty());
    let media_type = match (header, document.filter(|text| !text.is_empty())) {
        (Some(header), Some(document)) if header != document => {
            return Err(OciError::manifest_invalid(format!(
                "the Content-Type is {header:?}, the manifest's mediaType {document:?}"
            )));
        }
        (Some(media_type), _) | (None, Some(media_type)) => media_type,
        (None, None) => MANIFEST_TYPE,
    };
    if !is_json(media_type) {
        let message = format!(
            "{media_type:?} is not a manifest type: expected application/json or application/…+json"
        );
        return Err(OciError::manifest_invalid(message));
    }
    Ok(media_type.to_owned())
}

/// True for a JSON media type, which no browser shows as a page. The allowed characters are those
/// of RFC 6838, section 4.2.
pub(super) fn is_json(media_type: &str) -> bool {
    let is_character = |b: u8| b.is_ascii_alphanumeric() || b"!#$&-^_.+".contains(&b);
    media_type.strip_prefix("application/").is_some_and(|subtype| {
        (subtype == "json" || subtype.ends_with("+json")) && subtype.bytes().all(is_character)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn manifest_type_is_a_json_type() {
        for text in
            ["application/json", MANIFEST_TYPE, DOCKER_LIST_TYPE, "application/x-foreign+json"]
        {
            assert!(is_json(text), "{text}");
            assert_eq!(media_type(Some(text), None).expect("taken"), text);
            assert_eq!(
                media_type(Some(&format!("{text}; charset=utf-8")), Some(text)).expect("taken"),
                text
            );
        }
        for text in [
            "text/html",
            "application/xhtml+xml",
            "image/svg+json",
            "application/",
            "application/xjson",
            "application/x,text/html+json",
            "application/x\n+json",
            "application/ä+json",
        ] {
            assert!(!is_json(text), "{text}");
            assert!(
                media_type(Some(text), None).is_err() && media_type(None, Some(text)).is_err(),
                "{text}"
            );
        }
    }
}
