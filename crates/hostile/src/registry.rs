//! Manifests as anyone may push them.

use std::collections::BTreeSet;

use task_proto::packages::oci::{MANIFEST_TYPE, PACKAGE_TYPE};
use taskd::http::registry::oci::parsed::ParsedManifest;

/// An OCI manifest: each part is known once, its texts fit a header, and a manifest that claims to
/// be a package is the same package when written again.
pub fn oci_manifest(bytes: &[u8]) {
    for content_type in [None, Some(MANIFEST_TYPE)] {
        let Ok(parsed) = ParsedManifest::new(content_type, bytes) else { continue };
        assert_eq!(parsed.parts.iter().collect::<BTreeSet<_>>().len(), parsed.parts.len());
        let texts =
            [Some(&parsed.media_type), parsed.artifact_type.as_ref(), parsed.subject.as_ref()];
        assert!(texts.into_iter().flatten().all(|text| !text.contains(char::is_control)));
        let Some(package) = parsed.package else { continue };
        assert_eq!(parsed.artifact_type.as_deref(), Some(PACKAGE_TYPE));
        let written = serde_json::to_vec(&package).expect("a parsed value can be written");
        let again =
            ParsedManifest::new(content_type, &written).expect("a written value can be parsed");
        assert_eq!((again.package.as_ref(), &again.parts), (Some(&package), &parsed.parts));
        if let Some((config, content)) = package.package_blobs() {
            assert!(
                parsed.parts.contains(&config.digest) && parsed.parts.contains(&content.digest)
            );
        }
    }
}
