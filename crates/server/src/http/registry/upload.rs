//! Packages uploaded from the page: a directory arrives as an archive, is unpacked beside the
//! blobs, packed as by `taskd push`, and put into the registry. The archive comes from a browser
//! and is untrusted.

use std::collections::HashSet;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::body::Body;
use axum::extract::{Request, State};
use bytes::Bytes;
use futures_util::StreamExt as _;
use http::{HeaderMap, StatusCode, header};
use serde::Deserialize;
use task_archive::{Compression, Limits, Refusal, UnpackError, unpack_unannounced};
use task_macros::operation;
use task_package::{PackageError, Packed, pack_into};
use task_proto::UserName;
use task_proto::api::PackageView;
use tempfile::TempDir;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::timeout;
use utoipa::IntoParams;

use super::Registry;
use super::oci::{self, OciError};
use crate::blobs::{BlobError, Blobs};
use crate::domain::person::Person;
use crate::http::error::ApiError;
use crate::http::extract::QueryParams;
use crate::http::openapi::Created;

/// The most archives that are unpacked and packed at the same time.
const MAX_CONCURRENT: usize = 2;
/// The time limits of a sender that holds a slot.
const SENDER_TIMEOUTS: SenderTimeouts =
    SenderTimeouts { idle: Duration::from_secs(60), total: Duration::from_secs(60 * 60) };
/// Capacity of the channel between the body and the unpacker, in chunks.
const CHANNEL_CHUNKS: usize = 16;
/// Allowance for archive overhead beyond the contents, in bytes.
const OVERHEAD_BYTES: u64 = 1 << 20;

/// Time limits of a sender.
#[derive(Debug, Clone, Copy)]
struct SenderTimeouts {
    /// For the next chunk.
    idle: Duration,
    /// For the whole body.
    total: Duration,
}

/// The workspace for unpacking, and the limits on its users. Clones share the limits.
#[derive(Clone)]
pub struct UploadSpace {
    directory: PathBuf,
    limits: Limits,
    slots: Arc<Semaphore>,
    /// People with an archive being unpacked.
    uploading: Arc<Mutex<HashSet<UserName>>>,
}

impl UploadSpace {
    /// Uses this empty directory. At most `max_bytes` of an archive are unpacked.
    pub fn new(directory: PathBuf, max_bytes: u64) -> Self {
        let limits = Limits::default();
        let limits = Limits { bytes: limits.bytes.min(max_bytes), ..limits };
        let slots = Arc::new(Semaphore::new(MAX_CONCURRENT));
        Self { directory, limits, slots, uploading: Arc::default() }
    }

    /// Reserves a slot for one archive of this person. One person may have one at a time.
    fn reserve_slot(&self, person: &UserName) -> Result<UploadSlot, ApiError> {
        if !locked(&self.uploading).insert(person.clone()) {
            return Err(ApiError::too_many(format!(
                "{person} is already uploading a package; wait until it is done"
            )));
        }
        let mark = PersonMark { uploading: self.uploading.clone(), person: person.clone() };
        let slot = self.slots.clone().try_acquire_owned().map_err(|_| {
            ApiError::too_many(format!(
                "{MAX_CONCURRENT} packages are being uploaded already; try again in a moment"
            ))
        })?;
        Ok(UploadSlot { _mark: mark, _slot: slot })
    }
}

/// The slot of an archive being unpacked and packed; released on drop.
struct UploadSlot {
    _mark: PersonMark,
    _slot: OwnedSemaphorePermit,
}

/// Marks a person with an upload under way; dropping the guard removes the mark.
struct PersonMark {
    uploading: Arc<Mutex<HashSet<UserName>>>,
    person: UserName,
}

impl Drop for PersonMark {
    fn drop(&mut self) {
        locked(&self.uploading).remove(&self.person);
    }
}

fn locked(uploading: &Mutex<HashSet<UserName>>) -> MutexGuard<'_, HashSet<UserName>> {
    // A set of names stays valid after a panic.
    uploading.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The reason why an archive did not become a package.
#[derive(Debug, thiserror::Error)]
enum UploadError {
    #[error(transparent)]
    Unpack(#[from] UnpackError),
    #[error(transparent)]
    Package(#[from] PackageError),
    #[error("the directory for uploads can't be used")]
    Disk(#[from] io::Error),
}

/// The query of `POST /packages`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct UploadQuery {
    /// Whether the package may take over a version that has other content. The earlier package is
    /// then outdated.
    #[serde(default)]
    #[param(required = false)]
    force: bool,
}

/// Uploads a package's directory as a tar archive, optionally compressed with zstd, and packs it as
/// `taskd push` would.
#[operation(tag = "packages",
    request_body(description = "The directory: either its entries, or the directory itself with its entries.",
        content((String = "application/x-tar"), (String = "application/zstd"))),
    responses((status = 400, description = "The request body ended early."),
        (status = 409, description = "`version_taken`: the version exists with other content; the message names it."),
        (status = 413, description = "`too_large`: the package exceeds the server's limit."),
        (status = 415, description = "The body is neither `application/x-tar` nor `application/zstd`."),
        (status = 422, description = "`archive_refused`: the archive has an entry that a package can't have. \
            `package_invalid`: the package can't run; the message lists all problems."),
        (status = 408, description = "The upload took too long."),
        (status = 429, description = "This person, or too many others, are uploading a package already."),
        (status = 507, description = "`disk_full`: the server's disk is full.")))]
pub(in crate::http) async fn package(
    State(uploads): State<UploadSpace>,
    State(registry): State<Registry>,
    by: Person,
    QueryParams(query): QueryParams<UploadQuery>,
    request: Request,
) -> Result<Created<PackageView>, ApiError> {
    let compression = compression(request.headers())?;
    let slot = uploads.reserve_slot(&by.name)?;
    let (packed, _slot) =
        receive(&uploads, &registry.blobs, slot, compression, request.into_body()).await?;
    Ok(Created(oci::publish(&registry, &by, &packed, query.force).await?))
}

fn timed_out(message: &str) -> ApiError {
    ApiError::new(StatusCode::REQUEST_TIMEOUT, "timeout", message)
}

fn compression(headers: &HeaderMap) -> Result<Compression, ApiError> {
    let content_type =
        headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or_default();
    match content_type.split(';').next().unwrap_or_default().trim().to_ascii_lowercase().as_str() {
        "application/x-tar" => Ok(Compression::None),
        "application/zstd" => Ok(Compression::Zstd),
        _ => {
            let message = "Content-Type: expected application/x-tar or application/zstd";
            Err(ApiError::new(
                StatusCode::UNSUPPORTED_MEDIA_TYPE,
                "unsupported_media_type",
                message,
            ))
        }
    }
}

/// Unpacks the body as it arrives, and packs the contents. The work goes on if the caller
/// disconnects, so its slot has to stay taken as well.
async fn receive(
    uploads: &UploadSpace,
    blobs: &Blobs,
    slot: UploadSlot,
    compression: Compression,
    body: Body,
) -> Result<(Packed, UploadSlot), ApiError> {
    let (sender, receiver) = mpsc::channel(CHANNEL_CHUNKS);
    let (directory, limits) = (uploads.directory.clone(), uploads.limits);
    // Half of the room: the unpacked contents and their package are on disk at the same time.
    let room = blobs.space_for_people() / 2;
    let (limits, is_short) =
        (Limits { bytes: limits.bytes.min(room), ..limits }, room < limits.bytes);
    let max_bytes = limits.bytes.saturating_add(OVERHEAD_BYTES);
    let work = tokio::task::spawn_blocking(move || {
        pack(BodyReader { receiver, current: Bytes::new() }, compression, &limits, &directory)
            .map(|it| (it, slot))
    });
    let (fed, worked) = tokio::join!(feed(body, sender, max_bytes, SENDER_TIMEOUTS), work);
    let as_disk_error = |error: ApiError| match error.status {
        StatusCode::PAYLOAD_TOO_LARGE if is_short => {
            OciError::from(BlobError::DiskReserved { reserve: blobs.settings().reserve_bytes })
                .into()
        }
        _ => error,
    };
    // Checked first: if the body is incomplete, so is its archive.
    fed.map_err(as_disk_error)?;
    match worked {
        Ok(worked) => worked.map_err(|error| as_disk_error(refused(error))),
        Err(panic) => std::panic::resume_unwind(panic.into_panic()),
    }
}

/// Passes the body on until the body ends or the receiver is gone.
async fn feed(
    body: Body,
    sender: mpsc::Sender<Bytes>,
    max_bytes: u64,
    timeouts: SenderTimeouts,
) -> Result<(), ApiError> {
    let (mut chunks, mut received) = (body.into_data_stream(), 0);
    let forwarding = async {
        loop {
            let chunk = match timeout(timeouts.idle, chunks.next()).await {
                Ok(Some(Ok(chunk))) => chunk,
                Ok(Some(Err(_))) => return Err(ApiError::invalid("the request body ended early")),
                Ok(None) => return Ok(()),
                Err(_) => return Err(timed_out("the upload stopped for a minute")),
            };
            received += chunk.len() as u64;
            if received > max_bytes {
                let message =
                    format!("the archive has more than {max_bytes} bytes, this server's limit");
                return Err(too_large(message));
            }
            if sender.send(chunk).await.is_err() {
                return Ok(());
            }
        }
    };
    timeout(timeouts.total, forwarding)
        .await
        .unwrap_or_else(|_| Err(timed_out("the upload took longer than an hour")))
}

/// A body that a thread reads. The body ends when its sender is gone.
struct BodyReader {
    receiver: mpsc::Receiver<Bytes>,
    current: Bytes,
}

impl Read for BodyReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        while self.current.is_empty() {
            match self.receiver.blocking_recv() {
                Some(chunk) => self.current = chunk,
                None => return Ok(0),
            }
        }
        let piece = self.current.split_to(buffer.len().min(self.current.len()));
        buffer[..piece.len()].copy_from_slice(&piece);
        Ok(piece.len())
    }
}

fn pack(
    body: BodyReader,
    compression: Compression,
    limits: &Limits,
    directory: &Path,
) -> Result<Packed, UploadError> {
    let temporary = TempDir::new_in(directory)?;
    let unpacked = temporary.path().join("package");
    unpack_unannounced(body, compression, limits, &unpacked)?;
    let package = only_directory(&unpacked)?.unwrap_or(unpacked);
    Ok(pack_into(&package, directory)?)
}

/// The only directory in `unpacked`, if there is no other entry: archives of a directory mostly
/// contain the directory's name.
fn only_directory(unpacked: &Path) -> io::Result<Option<PathBuf>> {
    let mut entries = std::fs::read_dir(unpacked)?;
    match (entries.next().transpose()?, entries.next()) {
        (Some(only), None) if only.file_type()?.is_dir() => Ok(Some(only.path())),
        _ => Ok(None),
    }
}

fn refused(error: UploadError) -> ApiError {
    let unprocessable =
        |code, message| ApiError::new(StatusCode::UNPROCESSABLE_ENTITY, code, message);
    let source = match &error {
        UploadError::Unpack(UnpackError::Refused(refusal @ Refusal::Limit { .. })) => {
            return too_large(refusal.to_string());
        }
        UploadError::Unpack(UnpackError::Refused(refusal)) => {
            return unprocessable("archive_refused", refusal.to_string());
        }
        // The error's own text contains the path of an internal directory.
        UploadError::Package(PackageError::Invalid { problems, .. }) => {
            let lines: Vec<String> = problems.iter().map(ToString::to_string).collect();
            return unprocessable("package_invalid", lines.join("\n"));
        }
        UploadError::Unpack(UnpackError::Source(source) | UnpackError::Disk { source, .. })
        | UploadError::Package(PackageError::Io { source, .. })
        | UploadError::Disk(source) => source,
    };
    ApiError::disk(&error, source)
}

fn too_large(message: String) -> ApiError {
    ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "too_large", message)
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use futures_util::stream;

    use super::*;

    const LONG: Duration = Duration::from_secs(60);
    const SHORT: Duration = Duration::from_millis(20);

    /// The answer that [`feed`] gives to the sender of this body.
    async fn refusal_message(body: Body, timeouts: SenderTimeouts) -> String {
        let (sender, mut receiver) = mpsc::channel(CHANNEL_CHUNKS);
        let fed = async {
            tokio::join!(feed(body, sender, 1 << 20, timeouts), async {
                while receiver.recv().await.is_some() {}
            })
            .0
        };
        let error = timeout(LONG, fed).await.expect("an end").expect_err("let go");
        assert_eq!(error.status, StatusCode::REQUEST_TIMEOUT);
        error.message
    }

    #[tokio::test]
    async fn silent_and_endless_uploads_time_out() {
        let silent = Body::from_stream(stream::pending::<Result<Bytes, Infallible>>());
        let message =
            refusal_message(silent, SenderTimeouts { idle: SHORT, total: 2 * LONG }).await;
        assert!(message.contains("stopped for a minute"), "{message}");
        let endless = stream::unfold((), |()| async {
            tokio::task::yield_now().await;
            Some((Ok::<_, Infallible>(Bytes::new()), ()))
        });
        let message = refusal_message(
            Body::from_stream(endless),
            SenderTimeouts { idle: 2 * LONG, total: SHORT },
        )
        .await;
        assert!(message.contains("longer than an hour"), "{message}");
    }
}
