//! Pushing blobs: in one request, in a POST and a PUT, in chunks, or by a mount from another
//! repository.

use axum::body::Body;
use axum::response::Response;
use http::header::{CONTENT_LENGTH, CONTENT_RANGE};
use http::request::Parts;
use http::{HeaderMap, StatusCode};
use serde::Deserialize;
use task_proto::desired::BlobRef;
use task_proto::ids::digest::Algorithm;
use task_proto::packages::output::owner;
use task_proto::{Digest, RepositoryName};

use super::blobs::decimal;
use super::{ALGORITHMS, Answer, OciError, Registry, empty, parse_digest, query};
use crate::blobs::UploadId;

#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
struct BeginQuery {
    digest: Option<String>,
    digest_algorithm: Option<String>,
    mount: Option<String>,
    from: Option<String>,
}

#[derive(Deserialize)]
struct FinishQuery {
    digest: Option<String>,
}

/// `POST /v2/<name>/blobs/uploads/`: begins an upload, or completes the push at once if `digest` or
/// `mount` is given. A mount that is not allowed, because it would reveal another repository's
/// contents, begins an upload instead.
pub(super) async fn begin(
    registry: &Registry,
    repository: &RepositoryName,
    parts: &Parts,
    body: Body,
    may_mount: bool,
) -> Answer {
    let query: BeginQuery = query(&parts.uri)?;
    let is_supported =
        |requested: &String| Algorithm::ALL.iter().any(|algorithm| algorithm.as_str() == requested);
    if query.digest_algorithm.as_ref().is_some_and(|requested| !is_supported(requested)) {
        return Err(OciError::digest_invalid(ALGORITHMS));
    }
    if let Some(digest) = &query.mount {
        let digest = parse_digest(digest)?;
        if may_mount && mount(registry, repository, digest, query.from.as_deref()).await? {
            return created(repository, &digest);
        }
    } else if let Some(digest) = &query.digest {
        let digest = parse_digest(digest)?;
        let stored = stored_bytes(registry, repository).await?;
        check_length(registry, repository, &parts.headers, stored)?;
        let upload = start_upload(registry, repository).await?;
        let appended = registry
            .blobs
            .append(repository, &upload.id, Some(0), body.into_data_stream(), stored)
            .await;
        if let Err(error) = appended {
            // Best effort: the collector would remove the upload anyway, and the caller needs the
            // original error.
            let _ = upload.cancel().await;
            return Err(error.into());
        }
        let completed = upload.complete(digest).await;
        if completed.is_err() {
            // The caller does not know the upload's id, so it can't finish the upload later. As
            // above.
            let _ = upload.cancel().await;
        }
        return completed;
    }
    start_upload(registry, repository).await?.accepted(StatusCode::ACCEPTED, 0)
}

pub(super) async fn start_upload<'a>(
    registry: &'a Registry,
    repository: &'a RepositoryName,
) -> Result<Upload<'a>, OciError> {
    let id = registry.blobs.begin_upload(repository).await?;
    Ok(Upload { registry, repository, id })
}

/// An upload that was begun.
pub(super) struct Upload<'a> {
    pub(super) registry: &'a Registry,
    pub(super) repository: &'a RepositoryName,
    pub(super) id: UploadId,
}

impl Upload<'_> {
    /// `GET`: the current offset.
    pub(super) async fn status(&self) -> Answer {
        let offset = self.registry.blobs.upload_offset(self.repository, &self.id).await?;
        self.accepted(StatusCode::NO_CONTENT, offset)
    }

    /// `PATCH`: appends one chunk. Without a `Content-Range`, the chunk begins at the current
    /// offset.
    pub(super) async fn append(&self, parts: &Parts, body: Body) -> Answer {
        let offset = self.take_chunk(parts, body).await?;
        self.accepted(StatusCode::ACCEPTED, offset)
    }

    /// `PUT`: an optional last chunk, then the digest that the whole content must match.
    pub(super) async fn finish(&self, parts: &Parts, body: Body) -> Answer {
        let FinishQuery { digest } = query(&parts.uri)?;
        let digest =
            digest.ok_or_else(|| OciError::digest_invalid("the digest parameter is missing"))?;
        let digest = parse_digest(&digest)?;
        self.take_chunk(parts, body).await?;
        self.complete(digest).await
    }

    /// `DELETE`: cancels the upload.
    pub(super) async fn cancel(&self) -> Answer {
        self.registry.blobs.cancel_upload(self.repository, &self.id).await?;
        empty(StatusCode::NO_CONTENT, [])
    }

    async fn take_chunk(&self, parts: &Parts, body: Body) -> Result<u64, OciError> {
        let range = content_range(parts)?;
        let stored = stored_bytes(self.registry, self.repository).await?;
        check_length(self.registry, self.repository, &parts.headers, stored)?;
        let start = range.as_ref().map(|range| range.start);
        let body = body.into_data_stream();
        let offset =
            self.registry.blobs.append(self.repository, &self.id, start, body, stored).await?;
        match range {
            Some(range) if range.end != offset => Err(OciError::size_invalid(format!(
                "the Content-Range ends before byte {}, the body before byte {offset}",
                range.end
            ))),
            _ => Ok(offset),
        }
    }

    /// Makes the upload a blob of the repository, in one step from the collector's view, even if
    /// the caller has disconnected.
    pub(super) async fn complete(&self, digest: Digest) -> Answer {
        let (registry, repository, id) =
            (self.registry.clone(), self.repository.clone(), self.id.clone());
        let completed = tokio::spawn(async move {
            let _hold = registry.blobs.hold_collection().await;
            // Other uploads of the robot may have finished in the meantime.
            if let Err(full) = registry.blobs.check_space(
                &repository,
                0,
                stored_bytes(&registry, &repository).await?,
            ) {
                registry.blobs.cancel_upload(&repository, &id).await?;
                return Err(full.into());
            }
            let now_ms = registry.clock.now_ms();
            let size = registry.blobs.finish_upload(&repository, &id, digest, now_ms).await?;
            registry.store.blobs().link(&repository, &BlobRef { digest, size }).await?;
            Ok::<_, OciError>(())
        });
        completed.await.map_err(|error| OciError::internal(&error))??;
        created(self.repository, &digest)
    }

    fn accepted(&self, status: StatusCode, offset: u64) -> Answer {
        let (repository, id) = (self.repository, self.id.as_str());
        let headers: [(&str, String); 3] = [
            ("location", format!("/v2/{repository}/blobs/uploads/{id}")),
            // An empty upload can't be told from one with a single byte: the specification has no
            // notation for an empty range.
            ("range", format!("0-{}", offset.saturating_sub(1))),
            ("docker-upload-uuid", id.to_owned()),
        ];
        empty(status, headers)
    }
}

/// Adds a blob of `from` (of any repository, if absent) to this repository. False if `from` does
/// not have the blob.
async fn mount(
    registry: &Registry,
    repository: &RepositoryName,
    digest: Digest,
    from: Option<&str>,
) -> Result<bool, OciError> {
    let from = from
        .map(str::parse::<RepositoryName>)
        .transpose()
        .map_err(|error| OciError::name_invalid(&error))?;
    let _hold = registry.blobs.hold_collection().await;
    if !registry.store.blobs().has(from.as_ref(), &digest).await?
        || !registry.blobs.touch(digest, registry.clock.now_ms()).await?
    {
        return Ok(false);
    }
    let Some(blob) = registry.blobs.describe(digest).await? else { return Ok(false) };
    registry.store.blobs().link(repository, &BlobRef { digest, size: blob.size() }).await?;
    Ok(true)
}

/// Bytes stored for the robot that owns this repository; 0 if no robot owns the repository.
pub(super) async fn stored_bytes(
    registry: &Registry,
    repository: &RepositoryName,
) -> Result<u64, OciError> {
    let Some((robot, _)) = owner(repository) else { return Ok(0) };
    Ok(registry.store.robot_blobs().disk_usage(&robot).await?)
}

/// Refuses a body with a too large announced length, before reading it.
fn check_length(
    registry: &Registry,
    repository: &RepositoryName,
    headers: &HeaderMap,
    stored: u64,
) -> Result<(), OciError> {
    Ok(registry.blobs.check_space(repository, announced_length(headers).unwrap_or(0), stored)?)
}

fn announced_length(headers: &HeaderMap) -> Option<u64> {
    headers.get(CONTENT_LENGTH).and_then(|value| value.to_str().ok()).and_then(decimal)
}

/// `Content-Range` in the specification's form: `first-last`, both inclusive.
fn content_range(parts: &Parts) -> Result<Option<std::ops::Range<u64>>, OciError> {
    let Some(value) = parts.headers.get(CONTENT_RANGE) else { return Ok(None) };
    let range =
        value.to_str().ok().and_then(|text| text.split_once('-')).and_then(|(first, last)| {
            let (first, last) = (decimal(first)?, decimal(last)?);
            (first <= last && last < u64::MAX).then_some(first..last + 1)
        });
    let range = range
        .ok_or_else(|| OciError::upload_invalid("the Content-Range is not of the form 0-1023"))?;
    match announced_length(&parts.headers) {
        Some(length) if length != range.end - range.start => {
            Err(OciError::size_invalid("the Content-Length does not match the Content-Range"))
        }
        _ => Ok(Some(range)),
    }
}

fn created(repository: &RepositoryName, digest: &Digest) -> Result<Response, OciError> {
    let location = format!("/v2/{repository}/blobs/{digest}");
    empty(
        StatusCode::CREATED,
        [("location", location), ("docker-content-digest", digest.to_string())],
    )
}
