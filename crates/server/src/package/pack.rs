//! Makes a package of a directory: checks it, packs its files, and describes them in the OCI way. The same directory gives
//! the same digests, whoever packs it, wherever and whenever.

use std::io::{BufWriter, Write as _};
use std::path::Path;

use task_proto::Digest;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::manifest::{CONTENT_RATIO_FREE_BYTES, MAX_CONTENT_RATIO};
use task_proto::oci::ImageManifest;
use tempfile::NamedTempFile;

use super::{PackageError, Packed, Problem, archive, source};

/// Packs `dir`. Reads every file once and blocks meanwhile.
pub fn pack(dir: &Path) -> Result<Packed, PackageError> {
    let source::Source { mut manifest, tree } = source::read(dir)?;
    let failed =
        |source| PackageError::Io { what: "can't write the packed content to a temporary file".to_owned(), source };
    let mut content = NamedTempFile::with_prefix("taskd-content-").map_err(failed)?;
    let mut output = BufWriter::with_capacity(256 * 1024, content.as_file_mut());
    let (content_blob, facts) = archive::write(&tree, &mut output)?;
    output.flush().map_err(failed)?;
    drop(output);
    if facts.tar_size > content_blob.size.saturating_mul(MAX_CONTENT_RATIO).max(CONTENT_RATIO_FREE_BYTES) {
        let reason = format!(
            "compresses more than {MAX_CONTENT_RATIO} times ({} to {} bytes), which robots refuse; leave out what is empty",
            facts.tar_size, content_blob.size
        );
        return Err(PackageError::Invalid {
            dir: dir.to_owned(),
            problems: vec![Problem { file: ".".to_owned(), reason }],
        });
    }
    manifest.content = facts;
    let config_bytes = json(&manifest)?;
    let config = blob(&config_bytes);
    let manifest_bytes = json(&ImageManifest::package(config, content_blob))?;
    let package = PackageRef {
        name: manifest.name.clone(),
        version: manifest.version.clone(),
        manifest: blob(&manifest_bytes),
        config,
        content: content_blob,
    };
    Ok(Packed { package, manifest, config_bytes, manifest_bytes, content })
}

/// Compact JSON with the fields in the order of their declaration and maps sorted: one text for one value.
fn json<T: serde::Serialize>(value: &T) -> Result<Vec<u8>, PackageError> {
    serde_json::to_vec(value)
        .map_err(|error| PackageError::Io { what: "can't write the task manifest".to_owned(), source: error.into() })
}

fn blob(bytes: &[u8]) -> BlobRef {
    BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 }
}
