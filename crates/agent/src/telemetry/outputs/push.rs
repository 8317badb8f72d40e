//! Pushes an output through the OCI distribution API. First come the config and the manifest, to
//! learn whether the registry would accept the output. Then come the blobs, in chunks that resume
//! after a cut, and finally the manifest again.

use std::collections::BTreeMap;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http::header::{CONTENT_RANGE, CONTENT_TYPE, LOCATION, RANGE, RETRY_AFTER};
use reqwest::{Method, RequestBuilder, Response, StatusCode, Url};
use task_proto::Digest;
use task_proto::desired::BlobRef;
use task_proto::messages::report::Progress;
use task_proto::packages::oci::MANIFEST_TYPE;
use task_proto::packages::output::OutputSet;
use tokio::sync::{Semaphore, watch};

use super::{OutputError, OutputSpec, find};
use crate::install::fetch::MAX_RETRY_AFTER;
use crate::system::durable;
use crate::system::task_user;
use crate::system::untrusted_file::Directory;
use crate::transfer::credential::Credential;
use crate::transfer::registry_error::{CONTENT_DIGEST, RegistryError};

/// Bytes per request: the most that a cut of a bad link loses.
const CHUNK_BYTES: u64 = 1024 * 1024;
/// Registry error code for a manifest with missing files.
const FILES_MISSING: &str = "MANIFEST_BLOB_UNKNOWN";
/// Registry error code for bytes that do not match the digest.
const DIGEST_MISMATCH: &str = "DIGEST_INVALID";
/// Timeout for one request.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(180);
/// Most restarts of an upload in one attempt, after the server forgot the upload or received other
/// bytes.
const MAX_RESTARTS: u32 = 3;
/// Most repeats of a request in one attempt, after the server received other bytes than its body.
const MAX_RESENDS: u32 = 3;
/// Registry error code for an unreadable manifest. Ours is readable, so the network changed its
/// bytes.
const MANIFEST_MISMATCH: &str = "MANIFEST_INVALID";

/// The server's registry, with this robot's access.
#[derive(Clone)]
pub struct Registry {
    client: reqwest::Client,
    base: Url,
    token: Credential,
    /// Permits one push at a time: the server limits the bytes of a robot that are not listed yet,
    /// and two pushes would share that limit.
    turn: Arc<Semaphore>,
}

/// Uploads in progress: location by the digest of the uploaded blob.
type Notes = BTreeMap<Digest, String>;

impl Registry {
    /// The registry of the server at `base`.
    pub fn new(client: reqwest::Client, base: Url, token: impl Into<Credential>) -> Self {
        Self { client, base, token: token.into(), turn: Arc::new(Semaphore::new(1)) }
    }

    fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let mut url = self.base.clone();
        let (path, query) =
            path.split_once('?').map_or((path, None), |(path, query)| (path, Some(query)));
        url.set_path(&format!("{}{path}", self.base.path().trim_end_matches('/')));
        url.set_query(query);
        self.client.request(method, url).bearer_auth(self.token.current()).timeout(REQUEST_TIMEOUT)
    }

    /// Sends a request that stores bytes as a whole, and checks that the registry confirms their
    /// digest.
    async fn store(
        &self,
        what: &str,
        digest: Digest,
        request: RequestBuilder,
    ) -> Result<(), OutputError> {
        let response = self.send(what, request).await?;
        if confirms_digest(&response, digest) { Ok(()) } else { Err(not_the_server(&response)) }
    }

    /// Like [`Self::store`], for bytes in memory that match the digest. If the server received
    /// other bytes, the request is repeated.
    async fn store_exactly(
        &self,
        what: &str,
        digest: Digest,
        request: impl Fn() -> RequestBuilder,
    ) -> Result<(), OutputError> {
        let mut again = 0;
        loop {
            match self.store(what, digest, request()).await {
                Err(OutputError::Refused { code, text, .. })
                    if code == DIGEST_MISMATCH || code == MANIFEST_MISMATCH =>
                {
                    if again == MAX_RESENDS {
                        return Err(OutputError::Corrupted { text });
                    }
                    again += 1;
                    tracing::warn!(
                        what,
                        text,
                        again,
                        "the server received other bytes; they are sent again"
                    );
                }
                stored => return stored,
            }
        }
    }

    /// Starts or continues an upload. Returns the answer and the location for the next request.
    async fn upload(
        &self,
        what: &str,
        request: RequestBuilder,
    ) -> Result<(Response, String), OutputError> {
        let response = self.send(what, request).await?;
        location(&response).map(|location| (response, location))
    }

    /// Whether the registry has this blob.
    async fn has(&self, repository: &str, digest: Digest) -> Result<bool, OutputError> {
        let head = self.request(Method::HEAD, &format!("{repository}/blobs/{digest}"));
        let response = head.send().await.map_err(OutputError::Unreachable)?;
        match response.status() {
            StatusCode::NOT_FOUND => Ok(false),
            status if !status.is_success() => Err(refusal("a file", response).await),
            _ if confirms_digest(&response, digest) => Ok(true),
            _ => Err(not_the_server(&response)),
        }
    }

    async fn send(&self, what: &str, request: RequestBuilder) -> Result<Response, OutputError> {
        let response = request.send().await.map_err(OutputError::Unreachable)?;
        if response.status().is_success() {
            Ok(response)
        } else {
            Err(refusal(what, response).await)
        }
    }
}

/// Pushes all of `output`.
pub(super) async fn push(
    registry: &Registry,
    spec: &OutputSpec,
    output: &OutputSet,
    progress: &watch::Sender<Progress>,
) -> Result<(), OutputError> {
    let refused = || {
        OutputError::TooMuch("the robot's or task's name is not a valid repository name".to_owned())
    };
    let (repository, tag) = output.repository().zip(output.tag()).ok_or_else(refused)?;
    let total = output.files.iter().map(|file| file.blob.size).sum();
    progress.send_replace(Progress { done: 0, total });
    // The semaphore is never closed.
    let _turn = registry.turn.acquire().await;
    let mut push = Push {
        registry,
        base: format!("/v2/{repository}"),
        notes: read_notes(&spec.notes, output),
        spec,
        notes_path: &spec.notes,
        done: 0,
        progress,
    };
    let config =
        serde_json::to_vec(output).map_err(|error| note_error(&spec.notes, error.into()))?;
    let config_ref = BlobRef { digest: Digest::of(&config), size: config.len() as u64 };
    push.small(config_ref.digest, config.into()).await?;
    let manifest = serde_json::to_vec(&output.manifest(config_ref))
        .map_err(|error| note_error(&spec.notes, error.into()))?;
    let list = async || {
        let put = || {
            let put = registry.request(Method::PUT, &format!("/v2/{repository}/manifests/{tag}"));
            put.header(CONTENT_TYPE, MANIFEST_TYPE).body(manifest.clone())
        };
        registry.store_exactly("the output", Digest::of(&manifest), put).await
    };
    // Files of an output that the server would refuse need not be sent.
    match list().await {
        Err(OutputError::Refused { code, .. }) if code == FILES_MISSING => {}
        listed => return listed,
    }
    for file in &output.files {
        push.file(file.path.as_str(), file.blob).await?;
        push.done += file.blob.size;
        progress.send_modify(|progress| progress.done = push.done);
    }
    match list().await {
        // A file was present at the start, and the server has deleted it meanwhile.
        Err(OutputError::Refused { status, code, text, .. }) if code == FILES_MISSING => {
            Err(OutputError::Busy { status, text, retry_after: None })
        }
        listed => listed,
    }
}

struct Push<'a> {
    registry: &'a Registry,
    base: String,
    spec: &'a OutputSpec,
    notes: Notes,
    notes_path: &'a Path,
    /// Bytes of all files before the current one.
    done: u64,
    progress: &'a watch::Sender<Progress>,
}

impl Push<'_> {
    async fn file(&mut self, path: &str, blob: BlobRef) -> Result<(), OutputError> {
        if self.registry.has(&self.base, blob.digest).await? {
            return Ok(());
        }
        let mut restarts = 0;
        loop {
            let sent = match blob.size <= CHUNK_BYTES {
                true => {
                    let bytes = read_part(self.spec, path, 0, blob.size).await?;
                    if Digest::of(&bytes) != blob.digest {
                        return Err(self.changed(path));
                    }
                    self.small(blob.digest, bytes.into()).await
                }
                false => self.large(path, blob).await,
            };
            let is_first = restarts < MAX_RESTARTS;
            match sent {
                // The server has deleted the upload, or stored a chunk and its answer was lost.
                Err(OutputError::Refused { status: 404 | 416, .. }) if is_first => {
                    self.note(blob.digest, None)?
                }
                Err(OutputError::Refused { code, text, .. }) if code == DIGEST_MISMATCH => {
                    self.note(blob.digest, None)?;
                    // A task that runs again overwrites its files. If the file is unchanged, the
                    // network is at fault.
                    if !self.is_unchanged(path, blob).await? {
                        return Err(self.changed(path));
                    }
                    if !is_first {
                        return Err(OutputError::Corrupted { text });
                    }
                }
                done => return done,
            }
            restarts += 1;
        }
    }

    /// Pushes a blob that fits into one request.
    async fn small(&self, digest: Digest, bytes: Bytes) -> Result<(), OutputError> {
        let post = || {
            let post = self
                .registry
                .request(Method::POST, &format!("{}/blobs/uploads/?digest={digest}", self.base));
            post.header(CONTENT_TYPE, "application/octet-stream").body(bytes.clone())
        };
        self.registry.store_exactly("a file", digest, post).await
    }

    async fn is_unchanged(&self, path: &str, blob: BlobRef) -> Result<bool, OutputError> {
        let root = self.spec.directory.clone();
        let file = PathBuf::from(path);
        let size = blob.size;
        let hash = move || find::hash(&Directory::open(&root)?, &file, size);
        let hashed =
            task_user::do_as(self.spec.user.as_ref(), hash).await.map_err(OutputError::User)?;
        let hashed = hashed
            .map_err(|source| OutputError::Read { path: self.spec.directory.join(path), source })?;
        Ok(hashed == blob)
    }

    fn changed(&self, path: &str) -> OutputError {
        let source = std::io::Error::other("it changed during the upload");
        OutputError::Read { path: self.spec.directory.join(path), source }
    }

    async fn large(&mut self, path: &str, blob: BlobRef) -> Result<(), OutputError> {
        let (mut location, mut offset) = match self.notes.get(&blob.digest).cloned() {
            Some(location) => {
                let get = self.registry.request(Method::GET, &location);
                let (status, location) = self.registry.upload("an upload's state", get).await?;
                (location, uploaded(&status).min(blob.size))
            }
            None => {
                let post =
                    self.registry.request(Method::POST, &format!("{}/blobs/uploads/", self.base));
                let (_, location) = self.registry.upload("an upload", post).await?;
                self.note(blob.digest, Some(location.clone()))?;
                (location, 0)
            }
        };
        while offset < blob.size {
            let bytes =
                read_part(self.spec, path, offset, CHUNK_BYTES.min(blob.size - offset)).await?;
            let last = offset + bytes.len() as u64 - 1;
            let patch = self.registry.request(Method::PATCH, &location);
            let patch = patch.header(CONTENT_RANGE, format!("{offset}-{last}")).body(bytes);
            (_, location) = self.registry.upload("a part of a file", patch).await?;
            offset = last + 1;
            self.progress.send_modify(|progress| progress.done = self.done + offset);
        }
        let put = self.registry.request(Method::PUT, &format!("{location}?digest={}", blob.digest));
        self.registry.store("a file", blob.digest, put).await?;
        self.note(blob.digest, None)
    }

    fn note(&mut self, digest: Digest, location: Option<String>) -> Result<(), OutputError> {
        match location {
            Some(location) => self.notes.insert(digest, location),
            None => self.notes.remove(&digest),
        };
        let written = serde_json::to_vec(&self.notes).map_err(std::io::Error::from);
        let written = written.and_then(|bytes| durable::write(self.notes_path, &bytes, 0o600));
        written.map_err(|source| note_error(self.notes_path, source))
    }
}

fn note_error(path: &Path, source: std::io::Error) -> OutputError {
    OutputError::Note { path: path.to_owned(), source }
}

/// Reads the upload notes of an earlier attempt for these files. If they can't be read, uploads
/// start over.
fn read_notes(path: &Path, output: &OutputSet) -> Notes {
    let read =
        std::fs::read(path).ok().and_then(|bytes| serde_json::from_slice::<Notes>(&bytes).ok());
    let mut notes = read.unwrap_or_default();
    notes.retain(|digest, _| output.files.iter().any(|file| file.blob.digest == *digest));
    notes
}

async fn read_part(
    spec: &OutputSpec,
    path: &str,
    offset: u64,
    length: u64,
) -> Result<Vec<u8>, OutputError> {
    let root = spec.directory.clone();
    let path = PathBuf::from(path);
    let failed_at = root.join(&path);
    let read = move || {
        let mut file = Directory::open(&root)?.file(&path)?;
        file.seek(SeekFrom::Start(offset))?;
        let mut bytes = Vec::new();
        file.take(length).read_to_end(&mut bytes)?;
        if bytes.len() as u64 == length {
            Ok(bytes)
        } else {
            Err(std::io::Error::other("it became shorter"))
        }
    };
    let read = task_user::do_as(spec.user.as_ref(), read).await.map_err(OutputError::User)?;
    read.map_err(|source| OutputError::Read { path: failed_at, source })
}

/// Number of bytes that an upload has received. A range of one byte looks like an empty one, so the
/// upload then starts over.
fn uploaded(status: &Response) -> u64 {
    let range = status.headers().get(RANGE).and_then(|value| value.to_str().ok());
    let last = range.and_then(|range| range.strip_prefix("0-")?.parse::<u64>().ok());
    last.filter(|last| *last > 0).map_or(0, |last| last.saturating_add(1))
}

/// Location for the next request of an upload, as a path on this server. Every answer about an
/// upload carries one.
fn location(response: &Response) -> Result<String, OutputError> {
    let location = response.headers().get(LOCATION).and_then(|value| value.to_str().ok());
    let path = location.filter(|location| location.starts_with("/v2/") && !location.contains('?'));
    path.map(str::to_owned).ok_or_else(|| not_the_server(response))
}

/// Whether the answer names this digest, as the answer of a registry with these bytes does.
fn confirms_digest(response: &Response, digest: Digest) -> bool {
    response
        .headers()
        .get(CONTENT_DIGEST)
        .is_some_and(|value| value.as_bytes() == digest.to_string().as_bytes())
}

fn not_the_server(response: &Response) -> OutputError {
    OutputError::NotTheServer {
        status: response.status().as_u16(),
        text: "without a registry's headers".to_owned(),
    }
}

async fn refusal(what: &str, mut response: Response) -> OutputError {
    let status = response.status();
    let is_passing = status.is_server_error()
        || matches!(
            status,
            StatusCode::TOO_MANY_REQUESTS
                | StatusCode::REQUEST_TIMEOUT
                | StatusCode::UNAUTHORIZED
                | StatusCode::CONFLICT
        );
    let seconds =
        response.headers().get(RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
    let registry_error = RegistryError::read(&mut response).await;
    let status = status.as_u16();
    let is_own = registry_error.is_from_registry();
    let RegistryError { code, text } = registry_error;
    if is_passing {
        let retry_after = seconds.map(|seconds| Duration::from_secs(seconds).min(MAX_RETRY_AFTER));
        return OutputError::Busy { status, text, retry_after };
    }
    match is_own {
        true => OutputError::Refused { what: what.to_owned(), status, code, text },
        false => OutputError::NotTheServer { status, text },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn server_retry_after_is_capped() {
        let busy = http::Response::builder()
            .status(503)
            .header(RETRY_AFTER, u64::MAX.to_string())
            .body("");
        let refused = refusal("a file", busy.expect("an answer").into()).await;
        assert_eq!(refused.retry_after(), Some(MAX_RETRY_AFTER), "{refused}");
    }
}
