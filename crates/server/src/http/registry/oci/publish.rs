//! Publishes a package that the server packed itself, through the same steps as a push.

use std::io;

use http::header::CONTENT_TYPE;
use http::{HeaderMap, HeaderValue};
use task_package::Packed;
use task_proto::api::PackageView;
use task_proto::desired::BlobRef;
use task_proto::packages::oci::MANIFEST_TYPE;
use task_proto::{RepositoryName, Tag};
use tokio_util::io::ReaderStream;

use super::manifests::{Push, push};
use super::uploads::start_upload;
use super::{OciError, Registry};
use crate::domain::person::Person;
use crate::store::Reference;

/// Bytes of content read at once.
const CHUNK_BYTES: usize = 256 * 1024;

/// Stores a package under its version as the tag, as if `by` had pushed it.
pub async fn publish(
    registry: &Registry,
    by: &Person,
    packed: &Packed,
    takes_version: bool,
) -> Result<PackageView, OciError> {
    let package = &packed.package;
    let repository = RepositoryName::of_package(&package.name);
    let tag: Tag =
        package.version.as_str().parse().map_err(|error| OciError::tag_invalid(&error))?;
    let unreadable = |error: io::Error| OciError::internal(&error);
    let content = tokio::fs::File::open(packed.content.path()).await.map_err(unreadable)?;
    store(
        registry,
        &repository,
        package.content,
        ReaderStream::with_capacity(content, CHUNK_BYTES),
    )
    .await?;
    let config = ReaderStream::new(&packed.config_bytes[..]);
    store(registry, &repository, package.config, config).await?;
    let mut headers = HeaderMap::new();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(MANIFEST_TYPE));
    let manifest = packed.manifest_bytes.clone().into();
    let reference = Reference::Tag(tag.clone());
    let request = Push {
        repository: &repository,
        reference,
        by: Some(by),
        required_type: None,
        takes_version,
    };
    push(registry, request, vec![tag], &headers, manifest).await?;
    let view = registry.store.packages().get(&package.name, &package.manifest.digest).await?;
    view.ok_or_else(OciError::manifest_unknown)
}

/// Makes these bytes a blob of the repository, unless the repository has the blob.
async fn store<S>(
    registry: &Registry,
    repository: &RepositoryName,
    blob: BlobRef,
    bytes: S,
) -> Result<(), OciError>
where
    S: futures_util::Stream<Item = io::Result<bytes::Bytes>> + Send,
{
    let is_there = registry.store.blobs().has(Some(repository), &blob.digest).await?
        && registry.blobs.touch(blob.digest, registry.clock.now_ms()).await?;
    if is_there {
        return Ok(());
    }
    let upload = start_upload(registry, repository).await?;
    if let Err(error) = registry.blobs.append(repository, &upload.id, Some(0), bytes, 0).await {
        // Best effort: the collector would remove the upload anyway, and the caller needs the
        // original error.
        let _ = upload.cancel().await;
        return Err(error.into());
    }
    let completed = upload.complete(blob.digest).await;
    if completed.is_err() {
        // As above.
        let _ = upload.cancel().await;
    }
    completed.map(drop)
}
