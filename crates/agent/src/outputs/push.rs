//! Pushes an output through the OCI distribution API: the config and the manifest, to hear whether it would be kept, then
//! blobs in chunks that go on where they broke off, then the manifest once more.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use http::header::{CONTENT_RANGE, CONTENT_TYPE, LOCATION, RANGE, RETRY_AFTER};
use reqwest::{Method, RequestBuilder, Response, StatusCode, Url};
use task_proto::Digest;
use task_proto::desired::BlobRef;
use task_proto::oci::MANIFEST_TYPE;
use task_proto::output::OutputSet;
use task_proto::report::Progress;
use tokio::sync::{Semaphore, watch};

use super::{OutputError, OutputOrder};
use crate::credential::Credential;
use crate::fetch::MAX_RETRY_AFTER;
use crate::task_user::{self, TaskUser};
use crate::{durable, foreign_file};

/// Bytes sent in one request: what a bad link loses at most.
const CHUNK_BYTES: u64 = 1024 * 1024;
/// The registry's word for a manifest whose files are not all there.
const FILES_MISSING: &str = "MANIFEST_BLOB_UNKNOWN";
/// How long one request may take.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(180);
/// How often an upload that the server has forgotten is begun again in one go.
const MAX_BEGINNINGS: u32 = 3;
/// The most of an error's body that is read.
const MAX_ERROR_BYTES: usize = 4096;

/// The server's registry, as this robot may use it.
#[derive(Clone)]
pub struct Registry {
    client: reqwest::Client,
    base: Url,
    token: Credential,
    /// Whose turn it is to push: the server keeps so much of a robot that is not listed yet, and two would share that.
    turn: Arc<Semaphore>,
}

/// Uploads under way, by the digest of what they bring.
type Notes = BTreeMap<Digest, String>;

impl Registry {
    /// The registry of the server at `base`.
    pub fn new(client: reqwest::Client, base: Url, token: impl Into<Credential>) -> Self {
        Self { client, base, token: token.into(), turn: Arc::new(Semaphore::new(1)) }
    }

    fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let mut url = self.base.clone();
        let (path, query) = path.split_once('?').map_or((path, None), |(path, query)| (path, Some(query)));
        url.set_path(&format!("{}{path}", self.base.path().trim_end_matches('/')));
        url.set_query(query);
        self.client.request(method, url).bearer_auth(self.token.current()).timeout(REQUEST_TIMEOUT)
    }

    async fn send(&self, what: &str, request: RequestBuilder) -> Result<Response, OutputError> {
        let response = request.send().await.map_err(OutputError::Unreachable)?;
        if response.status().is_success() { Ok(response) } else { Err(refusal(what, response).await) }
    }
}

/// Pushes all of `output`.
pub(super) async fn push(
    registry: &Registry,
    order: &OutputOrder,
    output: &OutputSet,
    progress: &watch::Sender<Progress>,
) -> Result<(), OutputError> {
    let refused = || OutputError::TooMuch("the robot's or task's name can't be a repository's".to_owned());
    let (repository, tag) = output.repository().zip(output.tag()).ok_or_else(refused)?;
    let total = output.files.iter().map(|file| file.blob.size).sum();
    progress.send_replace(Progress { done: 0, total });
    // It is never closed.
    let _turn = registry.turn.acquire().await;
    let mut push = Push {
        registry,
        base: format!("/v2/{repository}"),
        notes: read_notes(&order.notes, output),
        user: order.user.as_ref(),
        notes_path: &order.notes,
        done: 0,
        progress,
    };
    let config = serde_json::to_vec(output).map_err(|error| note_error(&order.notes, error.into()))?;
    let config_ref = BlobRef { digest: Digest::of(&config), size: config.len() as u64 };
    push.small(config_ref.digest, config).await?;
    let manifest =
        serde_json::to_vec(&output.manifest(config_ref)).map_err(|error| note_error(&order.notes, error.into()))?;
    let list = async || {
        let put = registry.request(Method::PUT, &format!("/v2/{repository}/manifests/{tag}"));
        registry.send("the output", put.header(CONTENT_TYPE, MANIFEST_TYPE).body(manifest.clone())).await
    };
    // What the server would not list need not travel.
    match list().await {
        Err(OutputError::Refused { code, .. }) if code == FILES_MISSING => {}
        listed => return listed.map(drop),
    }
    for file in &output.files {
        push.file(&order.directory.join(file.path.as_str()), file.blob).await?;
        push.done += file.blob.size;
        progress.send_modify(|progress| progress.done = push.done);
    }
    match list().await {
        // It was there when this began, and has been collected meanwhile.
        Err(OutputError::Refused { status, code, text, .. }) if code == FILES_MISSING => {
            Err(OutputError::Busy { status, text, retry_after: None })
        }
        listed => listed.map(drop),
    }
}

struct Push<'a> {
    registry: &'a Registry,
    base: String,
    user: Option<&'a TaskUser>,
    notes: Notes,
    notes_path: &'a Path,
    /// Bytes of the files before this one.
    done: u64,
    progress: &'a watch::Sender<Progress>,
}

impl Push<'_> {
    async fn file(&mut self, path: &Path, blob: BlobRef) -> Result<(), OutputError> {
        let head = self.registry.request(Method::HEAD, &format!("{}/blobs/{}", self.base, blob.digest));
        match self.registry.send("a file", head).await {
            Ok(_) => return Ok(()),
            Err(OutputError::Refused { status: 404, .. }) => {}
            Err(error) => return Err(error),
        }
        if blob.size <= CHUNK_BYTES {
            let bytes = read_part(self.user, path, 0, blob.size).await?;
            return self.small(blob.digest, bytes).await;
        }
        let mut beginnings = 0;
        loop {
            match self.large(path, blob).await {
                // The server has collected the upload, or took a chunk whose answer was lost.
                Err(OutputError::Refused { status: 404 | 416, .. }) if beginnings < MAX_BEGINNINGS => {
                    beginnings += 1;
                    self.note(blob.digest, None)?;
                }
                done => return done,
            }
        }
    }

    /// Pushes what fits into one request.
    async fn small(&self, digest: Digest, bytes: Vec<u8>) -> Result<(), OutputError> {
        let post = self.registry.request(Method::POST, &format!("{}/blobs/uploads/?digest={digest}", self.base));
        let post = post.header(CONTENT_TYPE, "application/octet-stream").body(bytes);
        self.registry.send("a file", post).await.map(drop)
    }

    async fn large(&mut self, path: &Path, blob: BlobRef) -> Result<(), OutputError> {
        let (mut location, mut offset) = match self.notes.get(&blob.digest).cloned() {
            Some(location) => {
                let status =
                    self.registry.send("an upload's state", self.registry.request(Method::GET, &location)).await?;
                let offset = uploaded(&status).min(blob.size);
                (location, offset)
            }
            None => {
                let post = self.registry.request(Method::POST, &format!("{}/blobs/uploads/", self.base));
                let begun = self.registry.send("an upload", post).await?;
                let location = location(&begun)?;
                self.note(blob.digest, Some(location.clone()))?;
                (location, 0)
            }
        };
        while offset < blob.size {
            let bytes = read_part(self.user, path, offset, CHUNK_BYTES.min(blob.size - offset)).await?;
            let last = offset + bytes.len() as u64 - 1;
            let patch = self.registry.request(Method::PATCH, &location);
            let patch = patch.header(CONTENT_RANGE, format!("{offset}-{last}")).body(bytes);
            let taken = self.registry.send("a part of a file", patch).await?;
            location = self::location(&taken)?;
            offset = last + 1;
            self.progress.send_modify(|progress| progress.done = self.done + offset);
        }
        let put = self.registry.request(Method::PUT, &format!("{location}?digest={}", blob.digest));
        self.registry.send("a file", put).await?;
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

/// What an earlier try noted of these files; nothing, if that can't be read: then uploads begin anew.
fn read_notes(path: &Path, output: &OutputSet) -> Notes {
    let read = std::fs::read(path).ok().and_then(|bytes| serde_json::from_slice::<Notes>(&bytes).ok());
    let mut notes = read.unwrap_or_default();
    notes.retain(|digest, _| output.files.iter().any(|file| file.blob.digest == *digest));
    notes
}

async fn read_part(user: Option<&TaskUser>, path: &Path, offset: u64, length: u64) -> Result<Vec<u8>, OutputError> {
    let path = path.to_owned();
    let read = {
        let path = path.clone();
        move || {
            let mut file = foreign_file::open(&path)?;
            file.seek(SeekFrom::Start(offset))?;
            let mut bytes = Vec::new();
            file.take(length).read_to_end(&mut bytes)?;
            if bytes.len() as u64 == length { Ok(bytes) } else { Err(std::io::Error::other("it became shorter")) }
        }
    };
    let read = task_user::do_as(user, read).await.map_err(OutputError::User)?;
    read.map_err(|source| OutputError::Read { path, source })
}

/// How many bytes an upload has. A single one can't be told from none, and then it begins anew.
fn uploaded(status: &Response) -> u64 {
    let range = status.headers().get(RANGE).and_then(|value| value.to_str().ok());
    let last = range.and_then(|range| range.strip_prefix("0-")?.parse::<u64>().ok());
    last.filter(|last| *last > 0).map_or(0, |last| last.saturating_add(1))
}

/// Where an upload goes on, as a path of this server.
fn location(response: &Response) -> Result<String, OutputError> {
    let location = response.headers().get(LOCATION).and_then(|value| value.to_str().ok());
    let path = location.filter(|location| location.starts_with("/v2/") && !location.contains('?'));
    path.map(str::to_owned).ok_or_else(|| OutputError::Refused {
        what: "an upload".to_owned(),
        status: response.status().as_u16(),
        code: String::new(),
        text: "its answer does not say where to go on".to_owned(),
    })
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
    let seconds = response.headers().get(RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
    let mut body = Vec::new();
    while let Ok(Some(chunk)) = response.chunk().await {
        body.extend_from_slice(&chunk);
        if body.len() > MAX_ERROR_BYTES {
            break;
        }
    }
    body.truncate(MAX_ERROR_BYTES);
    let (code, text) = said(&body);
    let status = status.as_u16();
    if is_passing {
        let retry_after = seconds.map(|seconds| Duration::from_secs(seconds).min(MAX_RETRY_AFTER));
        return OutputError::Busy { status, text, retry_after };
    }
    OutputError::Refused { what: what.to_owned(), status, code, text }
}

/// The code and the words of a registry's error body; all of what is none.
fn said(body: &[u8]) -> (String, String) {
    let parsed: serde_json::Value = serde_json::from_slice(body).unwrap_or_default();
    let [code, message] = ["code", "message"].map(|key| parsed["errors"][0][key].as_str());
    let text = message.map_or_else(|| String::from_utf8_lossy(body), Cow::Borrowed).replace(char::is_control, " ");
    (code.unwrap_or_default().to_owned(), text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn no_server_keeps_files_back_for_long() {
        let busy = http::Response::builder().status(503).header(RETRY_AFTER, u64::MAX.to_string()).body("");
        let refused = refusal("a file", busy.expect("an answer").into()).await;
        assert_eq!(refused.retry_after(), Some(MAX_RETRY_AFTER), "{refused}");
    }

    #[test]
    fn a_refusal_is_told_in_the_servers_words() {
        let error = br#"{"errors":[{"code":"SIZE_INVALID","message":"the output\nhas 9 bytes","detail":{}}]}"#;
        assert_eq!(said(error), ("SIZE_INVALID".to_owned(), "the output has 9 bytes".to_owned()));
        for other in ["<h1>Forbidden</h1>", r#"{"errors":[]}"#, r#"{"error":{"code":"x"}}"#, "[]"] {
            assert_eq!(said(other.as_bytes()), (String::new(), other.to_owned()));
        }
        assert_eq!(said(b"\xff\x1b[2J").1, "\u{fffd} [2J");
    }
}
