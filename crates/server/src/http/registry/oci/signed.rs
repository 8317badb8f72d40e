//! Checks signed documents at their push: an envelope about a package, or a list of publishers.
//! Robots decide whether a signature counts. The server refuses documents that could never count,
//! or that contradict their manifest.

use task_proto::desired::BlobRef;
use task_proto::packages::oci::ImageManifest;
use task_proto::packages::publisher::{
    LIST_REPOSITORY, MAX_LIST_BYTES, MAX_SIGNATURE_BYTES, PackageStatement, PublisherList,
};
use task_proto::trust::envelope::Envelope;
use task_proto::{RepositoryName, Tag};

use super::blobs::check_blob;
use super::parsed::ParsedManifest;
use super::{OciError, Registry};
use crate::store::{Reference, SignedDocument};

/// The signed document in a manifest, if its type is that of one.
pub(super) async fn check(
    registry: &Registry,
    repository: &RepositoryName,
    parsed: &ParsedManifest,
    tags: &[Tag],
) -> Result<Option<SignedDocument>, OciError> {
    if let Some(image) = &parsed.signature {
        return check_signature(registry, repository, image).await;
    }
    match &parsed.publishers {
        Some(image) => check_list(registry, repository, image, tags).await.map(Some),
        None => Ok(None),
    }
}

/// Notifies the robots that a document concerns. If this fails, the robots learn of the document at
/// their next request.
pub(super) async fn notify(
    registry: &Registry,
    repository: &RepositoryName,
    document: Option<&SignedDocument>,
) {
    match document {
        Some(SignedDocument::List { .. }) => registry.changes.notify_all_robots(),
        Some(SignedDocument::Signature { package, .. }) => {
            let Ok(name) = repository.as_str().parse() else { return };
            match registry.store.robots().with_package(&name, package).await {
                Ok(robots) => registry.changes.notify_robots(robots),
                Err(error) => tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "robots were not notified of a signature; they learn of it at their next request"
                ),
            }
        }
        None => {}
    }
}

/// The signature of a package in the package's own repository. A signature beside a copy in another
/// repository is itself a copy and has no effect: `None`.
async fn check_signature(
    registry: &Registry,
    repository: &RepositoryName,
    image: &ImageManifest,
) -> Result<Option<SignedDocument>, OciError> {
    let subject = image
        .subject
        .as_ref()
        .ok_or_else(|| OciError::manifest_invalid("subject: required for a signature"))?;
    let stored =
        registry.store.manifests().get(repository, &Reference::Digest(subject.digest)).await?;
    stored.ok_or_else(|| {
        OciError::manifest_invalid("subject: there is no such package; push it first")
    })?;
    let (blob, envelope) = envelope(registry, repository, image, MAX_SIGNATURE_BYTES).await?;
    let statement = PackageStatement::unverified(&envelope);
    let signed = statement
        .map_err(|error| OciError::manifest_invalid(format!("the signature: {error}")))?
        .package;
    let own = match repository.as_str().parse() {
        Ok(name) => registry.store.packages().get(&name, &subject.digest).await?,
        Err(_) => None,
    };
    let is_signed = match &own {
        Some(view) => signed == view.package,
        None => signed.manifest.digest == subject.digest,
    };
    if !is_signed {
        let message = format!("{} {} was signed, not the subject", signed.name, signed.version);
        return Err(OciError::manifest_invalid(message));
    }
    Ok(own.map(|_| SignedDocument::Signature { package: subject.digest, envelope: blob }))
}

async fn check_list(
    registry: &Registry,
    repository: &RepositoryName,
    image: &ImageManifest,
    tags: &[Tag],
) -> Result<SignedDocument, OciError> {
    if repository.as_str() != LIST_REPOSITORY {
        let message = format!("a list of publishers belongs in the repository {LIST_REPOSITORY}");
        return Err(OciError::manifest_invalid(message));
    }
    let refused = |error| OciError::manifest_invalid(format!("the list of publishers: {error}"));
    let (blob, envelope) = envelope(registry, repository, image, MAX_LIST_BYTES).await?;
    let offered = PublisherList::unverified(&envelope).map_err(refused)?;
    if tags.iter().any(|tag| tag.as_str() != offered.version.to_string()) {
        return Err(OciError::manifest_invalid(
            "the tag of a list of publishers must be its version",
        ));
    }
    let again = registry.store.publishers().list(Some(offered.version)).await?;
    let newest = registry.store.publishers().list(None).await?.filter(|_| again != Some(blob));
    let before = match newest {
        Some(newest) => Some(newest_list(registry, newest).await?),
        None => None,
    };
    let list = match &before {
        Some(before) => PublisherList::verify_successor(&envelope, &before.keepers, before.version),
        None => PublisherList::verify_self_signed(&envelope),
    };
    let list = list.map_err(refused)?;
    let changes_keepers = before.is_none_or(|before| before.keepers != list.keepers);
    Ok(SignedDocument::List { version: list.version, envelope: blob, changes_keepers })
}

async fn newest_list(registry: &Registry, newest: BlobRef) -> Result<PublisherList, OciError> {
    let blob = registry.blobs.get(newest.digest).await?.ok_or_else(OciError::blob_unknown)?;
    let envelope = parse(&blob.read().await?)?;
    PublisherList::unverified(&envelope)
        .map_err(|error| OciError::manifest_invalid(error.to_string()))
}

/// The single layer of a signed document.
async fn envelope(
    registry: &Registry,
    repository: &RepositoryName,
    image: &ImageManifest,
    max_bytes: u64,
) -> Result<(BlobRef, Envelope), OciError> {
    let envelope = image.lone_envelope();
    let envelope =
        envelope.ok_or_else(|| OciError::manifest_invalid("layers: expected one DSSE envelope"))?;
    if envelope.size > max_bytes {
        let message = format!(
            "layers: the envelope has {} bytes; at most {max_bytes} are allowed",
            envelope.size
        );
        return Err(OciError::manifest_invalid(message));
    }
    let blob = check_blob(registry, repository, envelope).await?;
    Ok((envelope, parse(&blob.read().await?)?))
}

fn parse(bytes: &[u8]) -> Result<Envelope, OciError> {
    serde_json::from_slice(bytes)
        .map_err(|error| OciError::manifest_invalid(format!("not a DSSE envelope: {error}")))
}
