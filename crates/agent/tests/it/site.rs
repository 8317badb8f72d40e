//! A server that answers for a package's blobs on the test's command, and a robot's data directory.

use std::fs;
use std::path::PathBuf;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::{HeaderMap, Response, StatusCode};
use axum::routing::get;
use futures_util::{StreamExt, stream};
use task_agent::install::fetch::{FetchError, FetchSettings, Fetcher};
use task_agent::system::layout::{DataDir, VersionDir};
use task_proto::Digest;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::messages::report::Progress;
use task_proto::packages::manifest::{ContentFacts, TaskManifest};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::archive::{Tar, noise};
use crate::flips::{self, Fault};

const CHUNK_BYTES: usize = 64 * 1024;
/// A refusal in a registry's words.
pub const BLOB_UNKNOWN: &str =
    r#"{"errors":[{"code":"BLOB_UNKNOWN","message":"the blob is not here"}]}"#;
pub const TOKEN: &str = "the robot's token";
/// Time limit by which a pull has ended, for any behaviour of the server.
const PATIENCE: Duration = Duration::from_secs(60);

/// How the server answers one request for a blob.
#[derive(Debug, Clone)]
pub enum Answer {
    /// Correct.
    Well,
    /// Correct, but the connection breaks after this number of bytes.
    Cut(usize),
    /// Correct, but the transfer stalls after this number of bytes.
    Stall(usize),
    /// Correct, but a byte at a time: each byte arrives soon, the complete blob never.
    Drip,
    /// The whole blob, for any requested range.
    IgnoreRange,
    /// This status, in a registry's words.
    Refused(u16),
    /// This status and these headers, with an empty body.
    Status(u16, Vec<(&'static str, &'static str)>),
    /// An HTML page, as from a captive portal.
    Html(u16),
    /// The right headers, other bytes.
    OtherBytes,
    /// Bytes without end, and no length.
    Endless,
    /// A length that is not the blob's.
    Length(u64),
    /// The right bytes without headers that describe them.
    Anonymous,
    /// A range that was not asked for.
    OtherRange,
}

#[derive(Default)]
struct Script {
    blobs: Vec<Vec<u8>>,
    /// Taken from the front; [`Answer::Well`] when there are none.
    answers: Vec<Answer>,
    /// First byte asked for by each request.
    asked: Vec<u64>,
}

/// A server, a data directory and a package.
pub struct Site {
    script: Arc<Mutex<Script>>,
    pub fetcher: Fetcher,
    pub data: DataDir,
    pub package: PackageRef,
    pub manifest: TaskManifest,
    pub content: Vec<u8>,
    pub server: reqwest::Url,
    _dir: tempfile::TempDir,
}

impl Site {
    pub async fn new(tar: &Tar) -> Self {
        Self::with(tar, settings()).await
    }

    pub async fn with(tar: &Tar, settings: FetchSettings) -> Self {
        Self::with_content(tar.compressed(), tar.facts(), settings).await
    }

    pub async fn with_content(
        content: Vec<u8>,
        facts: ContentFacts,
        settings: FetchSettings,
    ) -> Self {
        let manifest = manifest(facts);
        let config = serde_json::to_vec(&manifest).unwrap();
        let blob = |bytes: &[u8]| BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 };
        let package = PackageRef {
            name: manifest.name.clone(),
            version: manifest.version.clone(),
            manifest: blob(b"the OCI manifest"),
            config: blob(&config),
            content: blob(&content),
        };
        let script = Arc::new(Mutex::new(Script {
            blobs: vec![content.clone(), config],
            ..Script::default()
        }));
        let router = Router::new()
            .route("/v2/{name}/blobs/{digest}", get(answer))
            .with_state(script.clone());
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server: reqwest::Url =
            format!("http://{}/", listener.local_addr().unwrap()).parse().unwrap();
        tokio::spawn(async move { axum::serve(listener, router).await });
        let dir = tempfile::tempdir().unwrap();
        let data = DataDir::new(dir.path()).unwrap();
        let fetcher =
            Fetcher::new(client(), server.clone(), TOKEN.to_owned(), data.clone(), settings);
        Self { script, fetcher, data, package, manifest, content, server, _dir: dir }
    }

    /// As after a new start of the agent.
    pub fn restart(&mut self, settings: FetchSettings) {
        self.fetcher = Fetcher::new(
            client(),
            self.server.clone(),
            TOKEN.to_owned(),
            self.data.clone(),
            settings,
        );
    }

    /// Directs pulls through a proxy that flips bytes; returns the count of flipped bytes.
    pub async fn behind_flips(&mut self, fault: Fault) -> Arc<AtomicU64> {
        let server = self.server.socket_addrs(|| None).unwrap()[0];
        let (proxy, flipped) = flips::proxy(server, fault).await;
        self.server = format!("http://{proxy}/").parse().unwrap();
        self.restart(settings());
        flipped
    }

    pub fn answers(&self, answers: impl IntoIterator<Item = Answer>) {
        self.script.lock().unwrap().answers = answers.into_iter().collect();
    }

    pub fn asked(&self) -> Vec<u64> {
        std::mem::take(&mut self.script.lock().unwrap().asked)
    }

    pub async fn pull(&self) -> Result<(), FetchError> {
        let progress = watch::Sender::new(Progress { done: 0, total: 0 });
        let cancel = CancellationToken::new();
        let pull = self.fetcher.content(&self.package, &self.manifest, &progress, &cancel);
        let ended = tokio::time::timeout(PATIENCE, pull).await.expect("the pull ends");
        assert!(
            progress.borrow().done <= self.package.content.size,
            "more was read than was ordered"
        );
        ended
    }

    pub fn version(&self) -> VersionDir {
        self.data.task(&self.package.name).version(&self.package.manifest.digest)
    }

    pub fn part(&self) -> PathBuf {
        self.data.blob_part(&self.package.content.digest)
    }

    pub fn put_part(&self, bytes: &[u8]) {
        fs::create_dir_all(self.part().parent().unwrap()).unwrap();
        fs::write(self.part(), bytes).unwrap();
    }

    pub fn assert_in_place(&self) {
        assert_eq!(fs::read(self.version().src().join("data")).unwrap(), noise());
        assert!(!self.part().exists(), "the compressed bytes are still there");
        self.assert_nothing_staged();
    }

    pub fn assert_nothing_staged(&self) {
        let staged = fs::read_dir(self.data.staging()).map_or(0, Iterator::count);
        assert_eq!(staged, 0, "a tree was left in the staging directory");
    }
}

pub fn settings() -> FetchSettings {
    FetchSettings {
        reserve_bytes: 0,
        reconnect_wait: Duration::from_millis(1),
        ..FetchSettings::default()
    }
}

pub fn client() -> reqwest::Client {
    let _ = rustls::crypto::ring::default_provider().install_default();
    reqwest::Client::builder().no_proxy().build().unwrap()
}

pub fn manifest(facts: ContentFacts) -> TaskManifest {
    serde_json::from_value(serde_json::json!({
        "name": "plain", "version": "1.0.0", "run": { "exec": ["true"] }, "content": facts
    }))
    .unwrap()
}

async fn answer(
    State(script): State<Arc<Mutex<Script>>>,
    Path((name, digest)): Path<(String, String)>,
    headers: HeaderMap,
) -> Response<Body> {
    assert_eq!(
        (name.as_str(), headers["authorization"].to_str().unwrap()),
        ("plain", "Bearer the robot's token")
    );
    let range = headers.get("range").map(|range| {
        let (first, last) =
            range.to_str().unwrap().strip_prefix("bytes=").unwrap().split_once('-').unwrap();
        (first.parse::<usize>().unwrap(), last.parse::<usize>().ok())
    });
    let (offset, last) = range.unwrap_or_default();
    let (blob, answer) = {
        let mut script = script.lock().unwrap();
        script.asked.push(offset as u64);
        let blob = script.blobs.iter().find(|blob| Digest::of(blob).to_string() == digest).cloned();
        let answer =
            if script.answers.is_empty() { Answer::Well } else { script.answers.remove(0) };
        (blob.expect("a blob of the package"), answer)
    };
    let total = blob.len();
    let start = if matches!(answer, Answer::IgnoreRange) { 0 } else { offset };
    let mut response = Response::builder().header("docker-content-digest", &digest);
    let end =
        last.filter(|_| !matches!(answer, Answer::IgnoreRange)).map_or(total, |last| last + 1);
    if start > 0 || end < total {
        let range = format!("bytes {start}-{}/{total}", end - 1);
        response = response.status(StatusCode::PARTIAL_CONTENT).header("content-range", range);
    }
    let bytes = blob[start..end].to_vec();
    let length = bytes.len();
    let exact = |response: axum::http::response::Builder| response.header("content-length", length);
    match answer {
        Answer::Well | Answer::IgnoreRange => exact(response).body(Body::from(bytes)),
        Answer::Cut(after) => exact(response).body(cut(bytes, after)),
        Answer::Stall(after) => exact(response).body(stalled(bytes, after)),
        Answer::Drip => {
            let every = tokio::time::interval(Duration::from_millis(2));
            let drops = stream::unfold((bytes, 0, every), async |(bytes, at, mut every)| {
                every.tick().await;
                let drop = Bytes::copy_from_slice(bytes.get(at..=at)?);
                Some((Ok::<_, std::io::Error>(drop), (bytes, at + 1, every)))
            });
            exact(response).body(Body::from_stream(drops))
        }
        Answer::Refused(status) => {
            Response::builder().status(status).body(Body::from(BLOB_UNKNOWN))
        }
        Answer::Status(status, headers) => {
            let response = Response::builder().status(status);
            headers
                .into_iter()
                .fold(response, |response, (name, value)| response.header(name, value))
                .body(Body::empty())
        }
        Answer::Html(status) => Response::builder()
            .status(status)
            .header("content-type", "Text/HTML; charset=utf-8")
            .body(Body::from("<html>Please sign in</html>")),
        Answer::OtherBytes => exact(response).body(Body::from(vec![7; length])),
        Answer::Endless => {
            let chunks = stream::repeat_with(|| {
                Ok::<_, std::io::Error>(Bytes::from_static(&[7; CHUNK_BYTES]))
            });
            response.body(Body::from_stream(chunks))
        }
        Answer::Length(length) => {
            response.header("content-length", length).body(Body::from(vec![7; length as usize]))
        }
        Answer::Anonymous => {
            Response::builder().header("content-length", length).body(Body::from(bytes))
        }
        Answer::OtherRange => Response::builder()
            .status(StatusCode::PARTIAL_CONTENT)
            .header("docker-content-digest", &digest)
            .header("content-range", format!("bytes 0-{}/{total}", total - 1))
            .body(Body::from(bytes)),
    }
    .unwrap()
}

fn chunks(bytes: Vec<u8>, count: usize) -> Vec<Result<Bytes, std::io::Error>> {
    bytes[..count.min(bytes.len())]
        .chunks(CHUNK_BYTES)
        .map(|chunk| Ok(Bytes::copy_from_slice(chunk)))
        .collect()
}

fn cut(bytes: Vec<u8>, after: usize) -> Body {
    let broken = stream::once(async { Err(std::io::Error::other("cut")) });
    Body::from_stream(stream::iter(chunks(bytes, after)).chain(broken))
}

fn stalled(bytes: Vec<u8>, after: usize) -> Body {
    Body::from_stream(stream::iter(chunks(bytes, after)).chain(stream::pending()))
}
