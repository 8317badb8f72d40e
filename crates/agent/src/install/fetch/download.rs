//! One HTTP answer with a blob's bytes: requests a range, checks the answer, and yields exactly
//! that range. This module never touches the disk.
//!
//! There is no If-Range: the URL names the bytes by their digest, so the bytes can't change between
//! two requests. A cache with its own entity tags would only make every resumption start over.

use std::ops::Range;
use std::time::Duration;

use bytes::Bytes;
use http::header::{CONTENT_RANGE, CONTENT_TYPE, ETAG, RANGE, RETRY_AFTER};
use http::{HeaderMap, HeaderName, StatusCode};
use task_proto::RepositoryName;
use task_proto::desired::BlobRef;
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::FetchError;
use crate::transfer::registry_error::{CONTENT_DIGEST, RegistryError};

/// Fewest bytes that must arrive within each stall timeout.
const MIN_PROGRESS_BYTES: u64 = 16 * 1024;
/// Overrides the client's limit for whole requests: a large package on a bad link takes its time,
/// and the stall timeout detects a dead connection.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(7 * 24 * 3600);
/// Upper bound on the wait that a server may request.
pub(crate) const MAX_RETRY_AFTER: Duration = Duration::from_secs(3600);

/// An answer that is being read.
pub(super) struct Download {
    response: reqwest::Response,
    /// End of the requested range in the blob.
    end: u64,
    /// Offset in the blob of the next byte to return.
    position: u64,
    /// Leading bytes of the answer to skip, because the server ignored the range.
    skip: u64,
    stall_timeout: Duration,
    /// Time spent waiting since the last [`MIN_PROGRESS_BYTES`], and the bytes received in that
    /// time. Only waiting counts: a slow disk is not the server's fault.
    waited: Duration,
    progressed: u64,
    requested_at: Instant,
}

impl Download {
    /// Requests a range of `blob`. The range is empty only if the blob is empty.
    pub(super) async fn start(
        request: reqwest::RequestBuilder,
        repository: &RepositoryName,
        blob: BlobRef,
        range: Range<u64>,
        stall_timeout: Duration,
    ) -> Result<Self, FetchError> {
        let mut request = request.timeout(REQUEST_TIMEOUT);
        if range.end < blob.size {
            request = request
                .header(RANGE, format!("bytes={}-{}", range.start, range.end.saturating_sub(1)));
        } else if range.start > 0 {
            request = request.header(RANGE, format!("bytes={}-", range.start));
        }
        let requested_at = Instant::now();
        let answer = tokio::time::timeout(stall_timeout, request.send()).await;
        let mut response = answer
            .map_err(|_| FetchError::Stalled(stall_timeout))?
            .map_err(FetchError::Unreachable)?;
        let skip = match check_response(&response, repository, blob, &range) {
            Err(FetchError::Unavailable { .. })
                if !is_registry_error(&mut response, stall_timeout).await =>
            {
                let status = response.status().as_u16();
                return Err(FetchError::NotTheServer(format!(
                    "status {status} without a registry's error"
                )));
            }
            checked => checked?,
        };
        Ok(Self {
            response,
            end: range.end,
            position: range.start,
            skip,
            stall_timeout,
            waited: Duration::ZERO,
            progressed: 0,
            requested_at,
        })
    }

    /// Offset in the blob of the next byte.
    pub(super) fn position(&self) -> u64 {
        self.position
    }

    /// Time of the request.
    pub(super) fn requested_at(&self) -> Instant {
        self.requested_at
    }

    /// Sends all received bytes to `sender`, until the range is complete or the receiver is gone.
    pub(super) async fn forward(&mut self, sender: &mpsc::Sender<Bytes>) -> Result<(), FetchError> {
        while let Some(chunk) = self.next().await? {
            if sender.send(chunk).await.is_err() {
                break;
            }
        }
        Ok(())
    }

    /// Collects the next `length` bytes in memory.
    pub(super) async fn collect(mut self, length: u64) -> Result<Vec<u8>, FetchError> {
        let mut bytes = Vec::with_capacity(length as usize);
        while (bytes.len() as u64) < length
            && let Some(chunk) = self.next().await?
        {
            let missing = length as usize - bytes.len();
            bytes.extend_from_slice(&chunk[..missing.min(chunk.len())]);
        }
        Ok(bytes)
    }

    /// The next bytes; `None` once the requested range is complete, even if the server would send
    /// more.
    pub(super) async fn next(&mut self) -> Result<Option<Bytes>, FetchError> {
        while self.position < self.end {
            let began = Instant::now();
            let left = self.stall_timeout.saturating_sub(self.waited);
            let chunk = tokio::time::timeout(left, self.response.chunk()).await;
            let chunk = chunk.map_err(|_| FetchError::Stalled(self.stall_timeout))?;
            let Some(mut chunk) = chunk.map_err(FetchError::Unreachable)? else {
                return Err(FetchError::Interrupted { received: self.position, size: self.end });
            };
            self.waited += began.elapsed();
            self.progressed += chunk.len() as u64;
            if self.progressed >= MIN_PROGRESS_BYTES {
                (self.waited, self.progressed) = (Duration::ZERO, 0);
            }
            let skipped = self.skip.min(chunk.len() as u64);
            self.skip -= skipped;
            let _ = chunk.split_to(skipped as usize);
            chunk.truncate((self.end - self.position).min(chunk.len() as u64) as usize);
            self.position += chunk.len() as u64;
            if !chunk.is_empty() {
                return Ok(Some(chunk));
            }
        }
        Ok(None)
    }
}

/// Number of bytes of the answer to skip, or an error if the answer is not usable.
fn check_response(
    response: &reqwest::Response,
    repository: &RepositoryName,
    blob: BlobRef,
    range: &Range<u64>,
) -> Result<u64, FetchError> {
    let offset = range.start;
    let is_range = range.start > 0 || range.end < blob.size;
    let status = response.status();
    let headers = response.headers();
    // A captive portal may answer with any status.
    if header(headers, &CONTENT_TYPE)
        .is_some_and(|kind| kind.trim_start().to_ascii_lowercase().starts_with("text/html"))
    {
        return Err(FetchError::NotTheServer(format!(
            "an HTML page with status {}",
            status.as_u16()
        )));
    }
    let offered = match status {
        StatusCode::OK => 0..blob.size,
        StatusCode::PARTIAL_CONTENT if is_range => match content_range(headers) {
            Some((start, total))
                if start == offset && total.is_none_or(|total| total == blob.size) =>
            {
                range.clone()
            }
            _ => {
                return Err(digest_mismatch(
                    blob,
                    "its Content-Range is not the requested one".to_owned(),
                ));
            }
        },
        StatusCode::RANGE_NOT_SATISFIABLE if is_range => {
            return Err(digest_mismatch(
                blob,
                format!("the server has none from byte {offset} on"),
            ));
        }
        StatusCode::UNAUTHORIZED => return Err(FetchError::Unauthorized),
        StatusCode::TOO_MANY_REQUESTS | StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_EARLY => {
            return Err(busy(status, headers));
        }
        status if status.is_server_error() => return Err(busy(status, headers)),
        status if status.is_client_error() => {
            let digest = blob.digest;
            let repository = repository.clone();
            return Err(FetchError::Unavailable { status: status.as_u16(), digest, repository });
        }
        status => {
            return Err(FetchError::NotTheServer(format!("status {} for a blob", status.as_u16())));
        }
    };
    match header(headers, &CONTENT_DIGEST) {
        Some(found) if found != blob.digest.to_string() => {
            return Err(digest_mismatch(blob, format!("they are {found:?}")));
        }
        None if !headers.contains_key(ETAG) => {
            return Err(FetchError::NotTheServer(
                "an answer with neither Docker-Content-Digest nor ETag".to_owned(),
            ));
        }
        _ => {}
    }
    if let Some(length) =
        response.content_length().filter(|&length| length != offered.end - offered.start)
    {
        let reason = format!(
            "{length} bytes are offered from byte {} on, expected {}",
            offered.start, blob.size
        );
        return Err(digest_mismatch(blob, reason));
    }
    Ok(offset - offered.start)
}

/// Whether the refusal comes from the server itself. A proxy in front of a restarting server also
/// refuses, but only for a while.
async fn is_registry_error(response: &mut reqwest::Response, time_limit: Duration) -> bool {
    tokio::time::timeout(time_limit, RegistryError::read(response))
        .await
        .is_ok_and(|registry_error| registry_error.is_from_registry())
}

fn digest_mismatch(blob: BlobRef, reason: String) -> FetchError {
    FetchError::DigestMismatch { digest: blob.digest, reason }
}

fn busy(status: StatusCode, headers: &HeaderMap) -> FetchError {
    // The header's other form is a date, which a robot with a wrong clock can't use.
    let seconds = header(headers, &RETRY_AFTER).and_then(|value| value.trim().parse().ok());
    let retry_after = seconds.map(|seconds| Duration::from_secs(seconds).min(MAX_RETRY_AFTER));
    FetchError::Busy { status: status.as_u16(), retry_after }
}

/// First byte, and total size if present, of `bytes FIRST-LAST/SIZE`.
fn content_range(headers: &HeaderMap) -> Option<(u64, Option<u64>)> {
    let (range, total) =
        header(headers, &CONTENT_RANGE)?.strip_prefix("bytes ")?.split_once('/')?;
    let (start, _) = range.split_once('-')?;
    let total = if total == "*" { None } else { Some(total.parse().ok()?) };
    Some((start.parse().ok()?, total))
}

fn header<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}
