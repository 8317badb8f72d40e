//! Reading and deleting blobs. Reads return the whole blob, a range, or "not modified" if the
//! client has the content already.

use std::ops::Range;

use axum::body::Body;
use axum::response::Response;
use bytes::Bytes;
use http::header::{
    ACCEPT_RANGES, AUTHORIZATION, CACHE_CONTROL, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE, ETAG,
    IF_NONE_MATCH, IF_RANGE, RANGE,
};
use http::request::Parts;
use http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use task_proto::desired::BlobRef;
use task_proto::{Digest, RepositoryName, RobotId};

use super::{Answer, OciError, Registry, empty};
use crate::blobs::{Blob, BytesConsumer, Content};
use crate::domain::person::Person;
use crate::http::connection::listener::Unencrypted;
use crate::http::registry::packages::in_use_message;
use crate::link::transfers::TransferRequest;
use crate::store::{AuditAction, AuditEvent, Deletion};

/// Cached copies must be revalidated with the server before each use.
pub(super) const REVALIDATED: &str = "private, no-cache";

/// `GET /v2/<name>/blobs/<digest>` by a person, and `HEAD` by a person without push access.
pub(super) async fn get(
    registry: &Registry,
    repository: &RepositoryName,
    digest: Digest,
    request: &Parts,
) -> Answer {
    if !registry.store.blobs().has(Some(repository), &digest).await? {
        return Err(OciError::blob_unknown());
    }
    read(registry, digest, request).await
}

/// `HEAD` of the same path by a caller with push access. Clients ask this before a push, so a
/// positive answer must stay true for a while: the blob is touched.
pub(super) async fn head_before_push(
    registry: &Registry,
    repository: &RepositoryName,
    digest: Digest,
    request: &Parts,
) -> Answer {
    let _hold = registry.blobs.hold_collection().await;
    if !registry.store.blobs().has(Some(repository), &digest).await? {
        return Err(OciError::blob_unknown());
    }
    if !registry.blobs.touch(digest, registry.clock.now_ms()).await? {
        return Err(OciError::blob_unknown());
    }
    read(registry, digest, request).await
}

/// `GET` or `HEAD` by a robot. Access depends on the robot's packages, regardless of their
/// repository and of whether the repository still has them. Reading bytes may have to wait for a
/// transfer slot; asking for their size does not.
pub(super) async fn get_for_robot(
    registry: &Registry,
    robot: &RobotId,
    digest: Digest,
    request: &Parts,
) -> Answer {
    let Some(order) = registry.store.robots().fetch_grant(robot, &digest).await? else {
        // Evidence blobs are small, and everything else waits for them.
        if registry.store.publishers().is_evidence_for(robot, &digest).await? {
            return read(registry, digest, request).await;
        }
        return Err(OciError::denied("the blob is not part of a package this robot should have"));
    };
    if request.method == Method::HEAD {
        return read(registry, digest, request).await;
    }
    let site = registry.transfers.site_of(&order.labels);
    let transfer_request =
        TransferRequest { priority: order.priority, deployment: order.number, site };
    let transfer = registry.transfers.admit(robot, digest, &transfer_request).await?;
    let transfer = transfer.by(request.extensions.get());
    Ok(read(registry, digest, request).await?.map(|body| Body::new(transfer.carry(body))))
}

/// `DELETE /v2/<name>/blobs/<digest>`: removes the blob from this repository. The bytes are deleted
/// once nothing references them.
pub(super) async fn delete(
    registry: &Registry,
    by: &Person,
    repository: &RepositoryName,
    digest: Digest,
) -> Answer {
    let event = AuditEvent::by(by, AuditAction::BlobDelete, repository).with("digest", digest);
    let deletion =
        registry.store.blobs().unlink(repository, &digest, &event, registry.clock.now_ms()).await?;
    deletion_answer(by, deletion, &format!("{repository}@{digest}"), OciError::blob_unknown)
}

async fn read(registry: &Registry, digest: Digest, request: &Parts) -> Answer {
    let content_type = HeaderValue::from_static("application/octet-stream");
    let content = match request.method {
        Method::HEAD => registry.blobs.describe(digest).await?,
        _ => registry.blobs.content(digest).await?,
    };
    let content = content.ok_or_else(OciError::blob_unknown)?;
    serve(&content, request, content_type, caching(request))
}

/// Cache policy for immutable content. A caller with a cookie shares the browser with the next
/// person to sign in, so the browser has to revalidate on each use, and gets 304.
pub(super) fn caching(request: &Parts) -> HeaderValue {
    let is_by_cookie = !request.headers.contains_key(AUTHORIZATION);
    HeaderValue::from_static(if is_by_cookie {
        REVALIDATED
    } else {
        "private, max-age=31536000, immutable"
    })
}

/// Answers with the part of the content that the request's headers ask for.
pub(super) fn serve(
    content: &Content,
    request: &Parts,
    content_type: HeaderValue,
    cache: HeaderValue,
) -> Answer {
    let (quoted, size) = (content.quoted_digest(), content.size());
    let digest = header_value(quoted.slice(1..quoted.len() - 1))?;
    let etag = header_value(quoted.clone())?;
    let common = [
        (ETAG, etag.clone()),
        (HeaderName::from_static("docker-content-digest"), digest),
        (CACHE_CONTROL, cache),
        (ACCEPT_RANGES, HeaderValue::from_static("bytes")),
    ];
    let headers = &request.headers;
    let mut response = if is_not_modified(headers, &etag) {
        let mut response = response_with_capacity(Body::empty());
        *response.status_mut() = StatusCode::NOT_MODIFIED;
        response
    } else {
        let (status, range) = match requested_range(headers, &etag, size) {
            RequestedRange::Whole => (StatusCode::OK, 0..size),
            RequestedRange::Part(range) => (StatusCode::PARTIAL_CONTENT, range),
            RequestedRange::Unsatisfiable => return unsatisfiable(size),
        };
        let length = range.end - range.start;
        let is_head = request.method == Method::HEAD;
        let reader = if request.extensions.get::<Unencrypted>().is_some() {
            BytesConsumer::Socket
        } else {
            BytesConsumer::Process
        };
        let content_range = (status == StatusCode::PARTIAL_CONTENT)
            .then(|| format!("bytes {}-{}/{size}", range.start, range.end.saturating_sub(1)));
        let mut response = response_with_capacity(match content {
            Content::Local(blob) if !is_head => Body::new(blob.body(range, reader)),
            Content::Arriving(arrival) if !is_head => {
                Body::from_stream(arrival.clone().content(range))
            }
            Content::Local(_) | Content::Arriving(_) | Content::Elsewhere { .. } => Body::empty(),
        });
        *response.status_mut() = status;
        if let Some(content_range) = content_range {
            response.headers_mut().insert(CONTENT_RANGE, header_value(content_range)?);
        }
        response.headers_mut().insert(CONTENT_LENGTH, HeaderValue::from(length));
        response.headers_mut().insert(CONTENT_TYPE, content_type);
        response
    };
    response.headers_mut().extend(common);
    Ok(response)
}

/// An answer with capacity for all its headers, including those for browsers.
fn response_with_capacity(body: Body) -> Response {
    const HEADERS: usize = 24;
    let mut response = Response::new(body);
    response.headers_mut().reserve(HEADERS);
    response
}

fn header_value(text: impl Into<Bytes>) -> Result<HeaderValue, OciError> {
    HeaderValue::from_maybe_shared(text.into()).map_err(|_| OciError::blob_unknown())
}

fn unsatisfiable(size: u64) -> Answer {
    use axum::response::IntoResponse as _;
    let message = format!("the content has {size} bytes");
    let mut response = OciError::range_invalid(message).into_response();
    response.headers_mut().insert(CONTENT_RANGE, header_value(format!("bytes */{size}"))?);
    Ok(response)
}

/// True if `If-None-Match` names the content.
fn is_not_modified(headers: &HeaderMap, etag: &HeaderValue) -> bool {
    let tags = headers
        .get_all(IF_NONE_MATCH)
        .iter()
        .flat_map(|value| value.as_bytes().split(|&b| b == b','));
    tags.map(<[u8]>::trim_ascii)
        .any(|tag| tag == b"*" || tag.strip_prefix(b"W/").unwrap_or(tag) == etag.as_bytes())
}

/// The result of evaluating a request's `Range`.
#[derive(Debug, PartialEq, Eq)]
enum RequestedRange {
    Whole,
    Part(Range<u64>),
    Unsatisfiable,
}

/// Evaluates `Range` by RFC 9110, section 14. Multiple ranges, other units and malformed values are
/// answered with the whole content, as the RFC allows. A range that ends before it begins is
/// unsatisfiable, as is usual for registries.
fn requested_range(headers: &HeaderMap, etag: &HeaderValue, size: u64) -> RequestedRange {
    if headers.get(IF_RANGE).is_some_and(|tag| tag != etag) {
        return RequestedRange::Whole;
    }
    let text = headers.get(RANGE).and_then(|value| value.to_str().ok());
    let Some((first, last)) =
        text.and_then(|text| text.strip_prefix("bytes=")).and_then(|set| set.split_once('-'))
    else {
        return RequestedRange::Whole;
    };
    let range = match (decimal(first), decimal(last)) {
        (Some(first), Some(last)) => first..size.min(last.saturating_add(1)),
        (Some(first), None) if last.is_empty() => first..size,
        (None, Some(length)) if first.is_empty() => size.saturating_sub(length)..size,
        _ => return RequestedRange::Whole,
    };
    if range.is_empty() { RequestedRange::Unsatisfiable } else { RequestedRange::Part(range) }
}

/// Parses a number of digits only: `parse` alone would accept a plus sign.
pub(super) fn decimal(text: &str) -> Option<u64> {
    text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse().ok())?
}

/// The answer to a deletion of the resource `named`.
pub(super) fn deletion_answer(
    by: &Person,
    deletion: Deletion,
    named: &str,
    unknown: fn() -> OciError,
) -> Answer {
    match deletion {
        Deletion::Deleted(_) => empty(StatusCode::ACCEPTED, []),
        Deletion::InUse(users) => Err(OciError::conflict(in_use_message(by, named, &users))),
        Deletion::Unknown => Err(unknown()),
    }
}

/// Checks that the repository has the blob, with the stated size.
pub(super) async fn check_blob(
    registry: &Registry,
    repository: &RepositoryName,
    part: BlobRef,
) -> Result<Blob, OciError> {
    let is_here = registry.store.blobs().has(Some(repository), &part.digest).await?;
    let blob = if is_here { registry.blobs.get(part.digest).await? } else { None };
    let blob = blob.ok_or_else(|| OciError::parts_unknown(&[part.digest]))?;
    if blob.size() != part.size {
        let message = format!(
            "the blob {} has {} bytes, its descriptor says {}",
            part.digest,
            blob.size(),
            part.size
        );
        return Err(OciError::manifest_invalid(message));
    }
    Ok(blob)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(HeaderName, &'static str)]) -> HeaderMap {
        pairs.iter().map(|(name, value)| (name.clone(), HeaderValue::from_static(value))).collect()
    }

    #[test]
    fn ranges_follow_the_http_rules() {
        let etag = HeaderValue::from_static("\"x\"");
        let cases = [
            ("bytes=0-0", RequestedRange::Part(0..1)),
            ("bytes=2-", RequestedRange::Part(2..10)),
            ("bytes=-3", RequestedRange::Part(7..10)),
            ("bytes=-30", RequestedRange::Part(0..10)),
            ("bytes=5-99", RequestedRange::Part(5..10)),
            ("bytes=10-", RequestedRange::Unsatisfiable),
            ("bytes=-0", RequestedRange::Unsatisfiable),
            ("bytes=18446744073709551615-", RequestedRange::Unsatisfiable),
            ("bytes=5-4", RequestedRange::Unsatisfiable),
            ("bytes=500-0", RequestedRange::Unsatisfiable),
            ("bytes=-", RequestedRange::Whole),
            ("bytes=0-1,3-4", RequestedRange::Whole),
            ("bytes=+1-2", RequestedRange::Whole),
            ("lines=0-1", RequestedRange::Whole),
        ];
        for (range, expected) in cases {
            assert_eq!(
                requested_range(&headers(&[(RANGE, range)]), &etag, 10),
                expected,
                "{range}"
            );
        }
        let part = |if_range| {
            requested_range(&headers(&[(RANGE, "bytes=1-"), (IF_RANGE, if_range)]), &etag, 10)
        };
        assert_eq!(part("\"x\""), RequestedRange::Part(1..10));
        assert_eq!(part("\"y\""), RequestedRange::Whole);
    }

    #[test]
    fn etag_in_a_list_matches() {
        let etag = HeaderValue::from_static("\"x\"");
        for (value, expected) in
            [("\"y\", \"x\"", true), ("W/\"x\"", true), ("*", true), ("\"y\"", false)]
        {
            assert_eq!(
                is_not_modified(&headers(&[(IF_NONE_MATCH, value)]), &etag),
                expected,
                "{value}"
            );
        }
    }
}
