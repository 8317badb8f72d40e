//! Reading, pushing and deleting manifests. A manifest with the type of a task package is validated
//! here, so that every package that can be ordered can also run.

use std::time::Duration;

use axum::body::Body;
use bytes::Bytes;
use http::header::CONTENT_TYPE;
use http::request::Parts;
use http::{HeaderMap, HeaderValue, StatusCode};
use task_archive::{Limits, UnpackError};
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::packages::manifest::{ContentFacts, TaskManifest};
use task_proto::packages::oci::{ImageManifest, PACKAGE_TYPE};
use task_proto::packages::output::{MAX_FILES, OutputSet};
use task_proto::{Digest, RepositoryName, Tag};

use super::super::archives::READ_TIMEOUT;
use super::blobs::{REVALIDATED, caching, check_blob, deletion_answer, serve};
use super::parsed::{ParsedManifest, is_json};
use super::uploads::stored_bytes;
use super::{Answer, OciError, Registry, empty, is_reserved, signed};
use crate::blobs::{Blob, Content};
use crate::domain::person::Person;
use crate::http::registry::packages::in_use_message;
use crate::orders::changes::Change;
use crate::store::{
    AuditAction, AuditEvent, Deletion, NewManifest, NewOutput, PutManifest, Reference,
    StoredManifest, disk_usage,
};

/// The largest manifest, in bytes; the specification asks for at least this.
const MAX_MANIFEST_BYTES: usize = 4 * 1024 * 1024;
/// The largest task manifest, in bytes.
const MAX_CONFIG_BYTES: u64 = 1024 * 1024;
/// Time limit for a manifest's body.
const BODY_TIMEOUT: Duration = Duration::from_secs(60);
/// The most tags that one request sets.
const MAX_TAGS: usize = 64;

/// `GET` and `HEAD /v2/<name>/manifests/<reference>`. An invalid reference is answered as unknown.
pub(super) async fn get(
    registry: &Registry,
    repository: &RepositoryName,
    reference: Result<Reference, OciError>,
    request: &Parts,
) -> Answer {
    let Ok(reference) = reference else { return Err(OciError::manifest_unknown()) };
    let stored = registry
        .store
        .manifests()
        .get(repository, &reference)
        .await?
        .ok_or_else(OciError::manifest_unknown)?;
    let blob = registry.blobs.get(stored.digest).await?.ok_or_else(OciError::manifest_unknown)?;
    let content_type = match is_json(&stored.media_type) {
        true => {
            HeaderValue::try_from(stored.media_type).map_err(|_| OciError::manifest_unknown())?
        }
        // Earlier versions accepted any type, including types that a browser shows as a page.
        false => HeaderValue::from_static("application/octet-stream"),
    };
    let cache = match reference {
        Reference::Digest(_) => caching(request),
        Reference::Tag(_) => HeaderValue::from_static(REVALIDATED),
    };
    serve(&Content::Local(blob), request, content_type, cache)
}

/// The target and the author of a push.
pub(super) struct Push<'a> {
    pub(super) repository: &'a RepositoryName,
    pub(super) reference: Reference,
    /// `None` for a robot.
    pub(super) by: Option<&'a Person>,
    /// The only artifact type that is accepted.
    pub(super) required_type: Option<&'static str>,
    /// True if a package may take its version from another package.
    pub(super) takes_version: bool,
}

impl<'a> Push<'a> {
    /// The push of a request. `?force=true` lets a package take its version from another.
    pub(super) fn of(
        parts: &Parts,
        repository: &'a RepositoryName,
        reference: Reference,
        by: Option<&'a Person>,
        required_type: Option<&'static str>,
    ) -> Result<Self, OciError> {
        let pairs: Vec<(String, String)> = super::query(&parts.uri)?;
        let takes_version = pairs.iter().any(|(key, value)| key == "force" && value == "true");
        Ok(Self { repository, reference, by, required_type, takes_version })
    }
}

/// `PUT`: stores the exact bytes, if all referenced parts are in the repository.
pub(super) async fn put(
    registry: &Registry,
    request: Push<'_>,
    parts: &Parts,
    body: Body,
) -> Answer {
    let bytes = read_body(body).await?;
    let tags = tags_to_set(parts, &request.reference)?;
    let repository = request.repository;
    let stored = push(registry, request, tags, &parts.headers, bytes).await?;
    created(repository, &stored.manifest.digest, stored.subject, parts, &stored.tags)
}

/// Stores a manifest's bytes, and returns the stored manifest.
pub(super) async fn push(
    registry: &Registry,
    push: Push<'_>,
    tags: Vec<Tag>,
    headers: &HeaderMap,
    bytes: Bytes,
) -> Result<NewManifest, OciError> {
    let Push { repository, reference, by, required_type, takes_version } = push;
    let digest = digest_of(&bytes, &reference)?;
    let content_type = headers.get(CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let parsed = ParsedManifest::new(content_type, &bytes)?;
    parsed.check_robot_algorithms(digest)?;
    if required_type
        .is_some_and(|required_type| parsed.artifact_type.as_deref() != Some(required_type))
    {
        return Err(OciError::denied("a robot may only push outputs"));
    }

    let manifest = BlobRef { digest, size: bytes.len() as u64 };
    // Before the hold, because reading an archive may take minutes. Parts that disappear in between
    // are noticed when the manifest is stored.
    let package = match &parsed.package {
        Some(image) => check_package(registry, repository, manifest, image).await?,
        None => None,
    };
    // From here until the manifest is stored, its parts must not be collected.
    let _hold = registry.blobs.hold_collection().await;
    let output = match &parsed.output {
        Some(image) => {
            let max_bytes = registry.blobs.settings().max_robot_bytes;
            Some(NewOutput {
                set: check_output(registry, repository, image, max_bytes).await?,
                max_bytes,
            })
        }
        None => None,
    };
    let document = signed::check(registry, repository, &parsed, &tags).await?;
    if required_type.is_some() && output.is_none() {
        return Err(OciError::denied("a robot may only push outputs"));
    }
    if required_type.is_some()
        && output
            .as_ref()
            .is_some_and(|output| tags.iter().any(|tag| output.set.tag().as_ref() != Some(tag)))
    {
        return Err(OciError::denied("a robot may only tag an output with its own run"));
    }
    let now_ms = registry.clock.now_ms();
    // A robot's manifest is counted together with the parts that it lists.
    let more = if by.is_some() { manifest.size } else { 0 };
    registry.blobs.check_space(repository, more, stored_bytes(registry, repository).await?)?;
    // Counted before the bytes are stored, so that a client that disconnects in between is counted
    // as well.
    registry.store.robot_blobs().count(repository, &manifest).await?;
    registry.blobs.put(digest.algorithm(), bytes, now_ms).await?;
    let new = NewManifest {
        manifest: StoredManifest { digest, size: manifest.size, media_type: parsed.media_type },
        artifact_type: parsed.artifact_type,
        annotations: parsed.annotations,
        subject: parsed.subject,
        parts: parsed.parts,
        tags,
        takes_version,
        package,
        output,
        document,
    };
    let event = by.map(|by| push_deed(by, repository, &new));
    match registry.store.manifests().put(repository, &new, event.as_ref(), now_ms).await? {
        PutManifest::VersionTaken(other) => Err(version_taken(&new, &other)),
        PutManifest::PartsMissing(missing) => Err(OciError::parts_unknown(&missing)),
        PutManifest::Outdated => Err(OciError::manifest_invalid(
            "a list of publishers with this version or a newer one exists",
        )),
        PutManifest::TagInUse(tag, users) => {
            let message = by
                .map(|by| in_use_message(by, &format!("{repository}:{tag}"), &users))
                .unwrap_or_default();
            Err(OciError::conflict(message))
        }
        PutManifest::Stored => {
            signed::notify(registry, repository, new.document.as_ref()).await;
            if let Some((package, _)) = &new.package {
                registry.changes.announce(Change::Package(package.name.clone()));
            }
            Ok(new)
        }
    }
}

/// The refusal to move a version to another package without `force`.
fn version_taken(new: &NewManifest, other: &Digest) -> OciError {
    let (name, version) = match &new.package {
        Some((package, _)) => (package.name.as_str(), package.version.as_str()),
        None => ("", ""),
    };
    OciError::conflict(format!(
        "{name} {version} exists with other content, manifest {other}: raise the version, or push with --force (?force=true)"
    ))
}

/// The digest of a manifest, which must match a digest in the reference.
fn digest_of(bytes: &[u8], reference: &Reference) -> Result<Digest, OciError> {
    let Reference::Digest(expected) = reference else { return Ok(Digest::of(bytes)) };
    let digest = expected.algorithm().digest(bytes);
    if digest != *expected {
        return Err(OciError::digest_invalid(format!(
            "the manifest hashes to {digest}, not to {expected}"
        )));
    }
    Ok(digest)
}

/// The audit entry for the push of a manifest.
fn push_deed(by: &Person, repository: &RepositoryName, new: &NewManifest) -> AuditEvent {
    let tags: Vec<&str> = new.tags.iter().map(Tag::as_str).collect();
    let event = AuditEvent::by(by, AuditAction::ManifestPush, repository)
        .with("manifest", new.manifest.digest);
    event.with("tags", tags.join(",")).with_some("type", new.artifact_type.as_ref())
}

/// `DELETE`: a tag alone, or a manifest with all its tags.
pub(super) async fn delete(
    registry: &Registry,
    by: &Person,
    repository: &RepositoryName,
    reference: Reference,
) -> Answer {
    let now_ms = registry.clock.now_ms();
    let (deletion, named) = match reference {
        Reference::Tag(tag) => {
            let event = AuditEvent::by(by, AuditAction::TagDelete, repository).with("tag", &tag);
            let deletion = registry.store.tags().delete(repository, &tag, &event, now_ms).await?;
            (deletion, format!("{repository}:{tag}"))
        }
        Reference::Digest(digest) => {
            let _hold = registry.blobs.hold_collection().await;
            let event = AuditEvent::by(by, AuditAction::ManifestDelete, repository)
                .with("manifest", digest);
            let deletion =
                registry.store.manifests().delete(repository, &digest, &event, now_ms).await?;
            if let Deletion::Deleted(parts) = &deletion {
                if let Ok(name) = repository.as_str().parse() {
                    registry.changes.announce(Change::Package(name));
                }
                // An order that looked the package up a moment ago still finds its bytes, because
                // the bytes are kept for a while.
                for &blob in parts.iter().chain([&digest]) {
                    registry.blobs.touch(blob, now_ms).await?;
                }
            }
            (deletion, format!("{repository}@{digest}"))
        }
    };
    deletion_answer(by, deletion, &named, OciError::manifest_unknown)
}

async fn read_body(body: Body) -> Result<Bytes, OciError> {
    let too_large =
        || OciError::too_large(format!("a manifest may have at most {MAX_MANIFEST_BYTES} bytes"));
    match tokio::time::timeout(BODY_TIMEOUT, axum::body::to_bytes(body, MAX_MANIFEST_BYTES)).await {
        Ok(Ok(bytes)) => Ok(bytes),
        Ok(Err(error)) => {
            let is_limit = std::error::Error::source(&error)
                .is_some_and(|source| source.is::<http_body_util::LengthLimitError>());
            Err(if is_limit {
                too_large()
            } else {
                OciError::manifest_invalid("the manifest ended early")
            })
        }
        Err(_) => Err(OciError::manifest_invalid("the manifest took too long to arrive")),
    }
}

/// The tag in the path, or the tags in the query of a push by digest.
fn tags_to_set(parts: &Parts, reference: &Reference) -> Result<Vec<Tag>, OciError> {
    if let Reference::Tag(tag) = reference {
        return Ok(vec![tag.clone()]);
    }
    let pairs: Vec<(String, String)> = super::query(&parts.uri)?;
    let tags = pairs.iter().filter(|(key, _)| key == "tag").take(MAX_TAGS);
    tags.map(|(_, tag)| tag.parse().map_err(|error| OciError::tag_invalid(&error))).collect()
}

/// Reads an output's config blob and checks its statements.
async fn check_output(
    registry: &Registry,
    repository: &RepositoryName,
    image: &ImageManifest,
    max_bytes: u64,
) -> Result<OutputSet, OciError> {
    let config = image.config.blob();
    let output: OutputSet = serde_json::from_slice(
        &read_config(registry, repository, config).await?,
    )
    .map_err(|error| {
        OciError::manifest_invalid(format!("the config does not describe an output: {error}"))
    })?;
    if output.repository().as_ref() != Some(repository) {
        let message = format!(
            "the output of {} on {} belongs in its own repository",
            output.task, output.robot_id
        );
        return Err(OciError::manifest_invalid(message));
    }
    if output.files.len() > MAX_FILES || output.manifest(config) != *image {
        let message = format!(
            "the manifest does not match the output in its config, or has more than {MAX_FILES} files"
        );
        return Err(OciError::manifest_invalid(message));
    }
    let bytes = disk_usage(&output);
    if bytes > max_bytes {
        let message = format!(
            "the output takes {bytes} bytes, the limit per robot is {max_bytes} (robots.output_bytes)"
        );
        return Err(OciError::too_large(message));
    }
    for file in &output.files {
        check_blob(registry, repository, file.blob).await?;
    }
    Ok(output)
}

async fn read_config(
    registry: &Registry,
    repository: &RepositoryName,
    config: BlobRef,
) -> Result<Bytes, OciError> {
    let blob = check_blob(registry, repository, config).await?;
    if config.size > MAX_CONFIG_BYTES {
        return Err(OciError::manifest_invalid(format!(
            "the config has more than {MAX_CONFIG_BYTES} bytes"
        )));
    }
    Ok(blob.read().await?)
}

/// Reads the task manifest in a package's config blob, and validates the manifest and the archive.
/// A package can be ordered from the repository of its own name. A package in another repository is
/// a copy: validated in the same way, but returned as `None`.
async fn check_package(
    registry: &Registry,
    repository: &RepositoryName,
    manifest: BlobRef,
    image: &ImageManifest,
) -> Result<Option<(PackageRef, TaskManifest)>, OciError> {
    let Some((config, content)) = image.package_blobs() else {
        let message = format!(
            "a manifest of artifactType {PACKAGE_TYPE} needs its config and one layer of its own types"
        );
        return Err(OciError::manifest_invalid(message));
    };
    let archive = check_blob(registry, repository, content).await?;
    let task: TaskManifest = serde_json::from_slice(
        &read_config(registry, repository, config).await?,
    )
    .map_err(|error| {
        OciError::manifest_invalid(format!("the config is not a task manifest: {error}"))
    })?;
    let problems: Vec<String> = task.problems().iter().map(ToString::to_string).collect();
    if !problems.is_empty() {
        return Err(OciError::manifest_invalid(problems.join("; ")));
    }
    if is_reserved(repository) {
        let message =
            format!("the package {} can't be stored in {repository}, which is reserved", task.name);
        return Err(OciError::manifest_invalid(message));
    }
    // A stored package was checked at its first push.
    if registry.store.packages().get(&task.name, &manifest.digest).await?.is_none() {
        check_archive(registry, &archive, content.size, task.content).await?;
    }
    let package = PackageRef {
        name: task.name.clone(),
        version: task.version.clone(),
        manifest,
        config,
        content,
    };
    Ok((RepositoryName::of_package(&task.name) == *repository).then_some((package, task)))
}

/// Reads the package's archive by the same rules that a robot uses to unpack.
async fn check_archive(
    registry: &Registry,
    blob: &Blob,
    size: u64,
    facts: ContentFacts,
) -> Result<(), OciError> {
    let check = registry
        .readers
        .read(blob, move |bytes| task_archive::check(bytes, size, &facts, &Limits::default()));
    let checked = tokio::time::timeout(READ_TIMEOUT, check).await;
    match checked
        .map_err(|_| OciError::manifest_invalid("the package's archive took too long to read"))?
    {
        Ok(()) => Ok(()),
        Err(UnpackError::Refused(refusal)) => Err(OciError::manifest_invalid(format!(
            "robots would refuse the package's archive: {refusal}"
        ))),
        Err(error @ (UnpackError::Source(_) | UnpackError::Disk { .. })) => {
            Err(OciError::internal(&error))
        }
    }
}

fn created(
    repository: &RepositoryName,
    digest: &Digest,
    subject: Option<String>,
    request: &Parts,
    tags: &[Tag],
) -> Answer {
    let location = format!("/v2/{repository}/manifests/{digest}");
    let headers = [("location", location), ("docker-content-digest", digest.to_string())];
    let mut response = empty(StatusCode::CREATED, headers)?;
    if let Some(subject) = subject.and_then(|subject| HeaderValue::try_from(subject).ok()) {
        response.headers_mut().insert("oci-subject", subject);
    }
    if request.uri.query().is_some() {
        for tag in tags {
            let tag =
                HeaderValue::try_from(tag.as_str()).map_err(|_| OciError::manifest_unknown())?;
            response.headers_mut().append("oci-tag", tag);
        }
    }
    Ok(response)
}
