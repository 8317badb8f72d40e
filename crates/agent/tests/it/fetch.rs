//! Pulls against a real HTTP server that misbehaves in every way a network or a server can.

use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::{HeaderMap, Response, StatusCode};
use axum::routing::get;
use futures_util::{StreamExt, stream};
use task_agent::fetch::{FetchError, FetchSettings, Fetcher};
use task_agent::layout::{DataDir, VersionDir};
use task_agent::link_meter::LinkMeter;
use task_proto::Digest;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::manifest::{ContentFacts, TaskManifest};
use task_proto::report::{FailureCode, Progress};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::archive::{Tar, noise, tar};

const CHUNK_BYTES: usize = 64 * 1024;
const TOKEN: &str = "the robot's token";
/// Whatever a server does, a pull has ended by then.
const PATIENCE: Duration = Duration::from_secs(60);

/// How the server answers one request for a blob.
#[derive(Debug, Clone)]
pub enum Answer {
    /// As it should.
    Well,
    /// As it should, but the connection breaks after so many bytes.
    Cut(usize),
    /// As it should, but after so many bytes nothing more comes.
    Stall(usize),
    /// As it should, but a byte at a time: each comes soon, all of them never.
    Drip,
    /// The whole blob, whatever range was asked for.
    IgnoreRange,
    /// This status, in a registry's words.
    Refused(u16),
    /// This status and these headers, with an empty body.
    Status(u16, Vec<(&'static str, &'static str)>),
    /// A page, as a captive portal shows it.
    Html(u16),
    /// The right headers, other bytes.
    OtherBytes,
    /// Bytes without end, and no length.
    Endless,
    /// A length that is not the blob's.
    Length(u64),
    /// The right bytes without anything that says what they are.
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
    server: reqwest::Url,
    _dir: tempfile::TempDir,
}

impl Site {
    pub async fn new(tar: &Tar) -> Self {
        Self::with(tar, settings()).await
    }

    pub async fn with(tar: &Tar, settings: FetchSettings) -> Self {
        let content = tar.compressed();
        let manifest = manifest(tar.facts());
        let config = serde_json::to_vec(&manifest).unwrap();
        let blob = |bytes: &[u8]| BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 };
        let package = PackageRef {
            name: manifest.name.clone(),
            version: manifest.version.clone(),
            manifest: blob(b"the OCI manifest"),
            config: blob(&config),
            content: blob(&content),
        };
        let script = Arc::new(Mutex::new(Script { blobs: vec![content.clone(), config], ..Script::default() }));
        let router = Router::new().route("/v2/{name}/blobs/{digest}", get(answer)).with_state(script.clone());
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server: reqwest::Url = format!("http://{}/", listener.local_addr().unwrap()).parse().unwrap();
        tokio::spawn(async move { axum::serve(listener, router).await });
        let dir = tempfile::tempdir().unwrap();
        let data = DataDir::new(dir.path()).unwrap();
        let fetcher = Fetcher::new(client(), server.clone(), TOKEN.to_owned(), data.clone(), settings);
        Self { script, fetcher, data, package, manifest, content, server, _dir: dir }
    }

    /// As after a new start of the agent.
    pub fn restart(&mut self, settings: FetchSettings) {
        self.fetcher = Fetcher::new(client(), self.server.clone(), TOKEN.to_owned(), self.data.clone(), settings);
    }

    pub fn answers(&self, answers: impl IntoIterator<Item = Answer>) {
        self.script.lock().unwrap().answers = answers.into_iter().collect();
    }

    pub fn asked(&self) -> Vec<u64> {
        std::mem::take(&mut self.script.lock().unwrap().asked)
    }

    async fn pull(&self) -> Result<(), FetchError> {
        let progress = watch::Sender::new(Progress { done: 0, total: 0 });
        let cancel = CancellationToken::new();
        let pull = self.fetcher.content(&self.package, &self.manifest, &progress, &cancel);
        let ended = tokio::time::timeout(PATIENCE, pull).await.expect("the pull ends");
        assert!(progress.borrow().done <= self.package.content.size, "more was read than was ordered");
        ended
    }

    pub fn version(&self) -> VersionDir {
        self.data.task(&self.package.name).version(&self.package.manifest.digest)
    }

    pub fn part(&self) -> PathBuf {
        self.data.blob_part(&self.package.content.digest)
    }

    fn put_part(&self, bytes: &[u8]) {
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
    FetchSettings { reserve_bytes: 0, reconnect_wait: Duration::from_millis(1), ..FetchSettings::default() }
}

fn client() -> reqwest::Client {
    let _ = rustls::crypto::ring::default_provider().install_default();
    reqwest::Client::builder().no_proxy().build().unwrap()
}

fn manifest(facts: ContentFacts) -> TaskManifest {
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
    assert_eq!((name.as_str(), headers["authorization"].to_str().unwrap()), ("plain", "Bearer the robot's token"));
    let offset: usize = headers.get("range").map_or(0, |range| {
        range.to_str().unwrap().strip_prefix("bytes=").unwrap().strip_suffix('-').unwrap().parse().unwrap()
    });
    let (blob, answer) = {
        let mut script = script.lock().unwrap();
        script.asked.push(offset as u64);
        let blob = script.blobs.iter().find(|blob| Digest::of(blob).to_string() == digest).cloned();
        let answer = if script.answers.is_empty() { Answer::Well } else { script.answers.remove(0) };
        (blob.expect("a blob of the package"), answer)
    };
    let total = blob.len();
    let start = if matches!(answer, Answer::IgnoreRange) { 0 } else { offset };
    let mut response = Response::builder().header("docker-content-digest", &digest);
    if start > 0 {
        let range = format!("bytes {start}-{}/{total}", total - 1);
        response = response.status(StatusCode::PARTIAL_CONTENT).header("content-range", range);
    }
    let bytes = blob[start..].to_vec();
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
            let words = r#"{"errors":[{"code":"BLOB_UNKNOWN","message":"the blob is not here"}]}"#;
            Response::builder().status(status).body(Body::from(words))
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
            let chunks = stream::repeat_with(|| Ok::<_, std::io::Error>(Bytes::from_static(&[7; CHUNK_BYTES])));
            response.body(Body::from_stream(chunks))
        }
        Answer::Length(length) => response.header("content-length", length).body(Body::from(vec![7; length as usize])),
        Answer::Anonymous => Response::builder().header("content-length", length).body(Body::from(bytes)),
        Answer::OtherRange => Response::builder()
            .status(StatusCode::PARTIAL_CONTENT)
            .header("docker-content-digest", &digest)
            .header("content-range", format!("bytes 0-{}/{total}", total - 1))
            .body(Body::from(bytes)),
    }
    .unwrap()
}

fn chunks(bytes: Vec<u8>, count: usize) -> Vec<Result<Bytes, std::io::Error>> {
    bytes[..count.min(bytes.len())].chunks(CHUNK_BYTES).map(|chunk| Ok(Bytes::copy_from_slice(chunk))).collect()
}

fn cut(bytes: Vec<u8>, after: usize) -> Body {
    let broken = stream::once(async { Err(std::io::Error::other("cut")) });
    Body::from_stream(stream::iter(chunks(bytes, after)).chain(broken))
}

fn stalled(bytes: Vec<u8>, after: usize) -> Body {
    Body::from_stream(stream::iter(chunks(bytes, after)).chain(stream::pending()))
}

#[tokio::test]
async fn a_package_gets_its_place_once() {
    let site = Site::new(&tar()).await;
    let manifest = site.fetcher.manifest(&site.package, &CancellationToken::new()).await.unwrap();
    assert_eq!(manifest, site.manifest);
    let progress = watch::Sender::new(Progress { done: 0, total: 0 });
    site.fetcher.content(&site.package, &manifest, &progress, &CancellationToken::new()).await.unwrap();
    site.assert_in_place();
    let size = site.content.len() as u64;
    assert_eq!(*progress.borrow(), Progress { done: size, total: size });
    assert_eq!(site.asked().len(), 2);

    site.fetcher.manifest(&site.package, &CancellationToken::new()).await.unwrap();
    site.pull().await.unwrap();
    assert_eq!(site.asked(), [0; 0], "what is there is not pulled again");
    fs::write(site.version().manifest(), "{}").unwrap();
    assert_eq!(site.fetcher.manifest(&site.package, &CancellationToken::new()).await.unwrap(), manifest);
}

#[tokio::test]
async fn a_cut_is_continued_within_the_pull() {
    let site = Site::new(&tar()).await;
    site.answers([Answer::Cut(1 << 20), Answer::Cut(1 << 20)]);
    site.pull().await.unwrap();
    site.assert_in_place();
    let asked = site.asked();
    assert_eq!((asked.len(), asked[0]), (3, 0));
    assert!(asked[1] > 0 && asked[2] > asked[1], "{asked:?}");
}

#[tokio::test]
async fn cuts_end_no_pull_that_gets_on() {
    let often = 2 * 5;
    // The same over and over would compress to nothing.
    let noise = noise();
    let parts = (0..6u8).flat_map(|part| noise.iter().map(move |byte| byte.rotate_left(part.into()) ^ part));
    let site = Site::new(&Tar::default().file("data", &parts.collect::<Vec<_>>()).end()).await;
    site.answers((0..often).map(|_| Answer::Cut(3 << 19)));
    site.pull().await.unwrap();
    assert_eq!(site.asked().len(), often + 1);
}

#[tokio::test]
async fn a_pull_that_was_dropped_goes_on_where_it_was() {
    let site = Site::new(&tar()).await;
    site.answers([Answer::Stall(2 << 20)]);
    let progress = watch::Sender::new(Progress { done: 0, total: 0 });
    let cancel = CancellationToken::new();
    let mut arrived = progress.subscribe();
    tokio::select! {
        result = site.fetcher.content(&site.package, &site.manifest, &progress, &cancel) => panic!("{result:?}"),
        _ = arrived.wait_for(|progress| progress.done == 2 << 20) => {}
    }
    site.pull().await.unwrap();
    site.assert_in_place();
    assert_eq!(site.asked(), [0, 2 << 20]);
}

#[tokio::test]
async fn a_cancelled_pull_leaves_only_the_part() {
    let site = Site::new(&tar()).await;
    site.answers([Answer::Stall(1 << 20)]);
    let progress = watch::Sender::new(Progress { done: 0, total: 0 });
    let cancel = CancellationToken::new();
    let mut arrived = progress.subscribe();
    let (result, _) = tokio::join!(site.fetcher.content(&site.package, &site.manifest, &progress, &cancel), async {
        arrived.wait_for(|progress| progress.done == 1 << 20).await.unwrap();
        cancel.cancel();
    });
    assert!(matches!(result, Err(FetchError::Cancelled)), "{result:?}");
    assert_eq!(fs::read(site.part()).unwrap(), site.content[..1 << 20]);
    site.assert_nothing_staged();
    assert!(!site.version().src().exists());
}

#[tokio::test]
async fn a_part_is_replayed_whatever_the_server_makes_of_ranges() {
    for (answers, asked) in [
        (vec![], vec![1 << 20]),
        (vec![Answer::IgnoreRange], vec![1 << 20]),
        (vec![Answer::Status(416, vec![])], vec![1 << 20, 0]),
        (vec![Answer::OtherRange], vec![1 << 20, 0]),
    ] {
        let site = Site::new(&tar()).await;
        site.put_part(&site.content[..1 << 20]);
        site.answers(answers);
        site.pull().await.unwrap();
        site.assert_in_place();
        assert_eq!(site.asked(), asked);
    }
}

#[tokio::test]
async fn a_whole_part_needs_no_server() {
    let site = Site::new(&tar()).await;
    site.put_part(&site.content);
    site.pull().await.unwrap();
    site.assert_in_place();
    assert_eq!(site.asked(), [0; 0]);
}

#[tokio::test]
async fn a_part_that_a_power_cut_spoiled_is_thrown_away() {
    let zeros = vec![0; 1 << 20];
    for spoiled in [zeros.clone(), [noise(), noise()].concat(), vec![0; tar().compressed().len()]] {
        let site = Site::new(&tar()).await;
        site.put_part(&spoiled);
        site.pull().await.unwrap();
        site.assert_in_place();
        assert_eq!(site.asked().last(), Some(&0));
    }
}

#[tokio::test]
async fn wrong_bytes_are_never_used_nor_kept() {
    let size = tar().compressed().len() as u64;
    for answer in [Answer::OtherBytes, Answer::Endless, Answer::Length(size - 1), Answer::Length(size + 1)] {
        let site = Site::new(&tar()).await;
        site.answers([answer.clone()]);
        let error = site.pull().await.unwrap_err();
        assert!(matches!(error, FetchError::DigestMismatch { .. }), "{answer:?}: {error:?}");
        assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::DIGEST_MISMATCH), false));
        assert!(!site.part().exists() && !site.version().src().exists());
        site.assert_nothing_staged();
    }
}

#[tokio::test]
async fn what_is_not_the_server_counts_as_not_reached() {
    let login = vec![("location", "/login")];
    let mut answers =
        vec![Answer::Html(200), Answer::Html(404), Answer::Html(302), Answer::Anonymous, Answer::Status(204, login)];
    // A proxy whose server restarts.
    answers.extend([403, 404, 410, 451].map(|status| Answer::Status(status, vec![("content-type", "text/plain")])));
    for answer in answers {
        let site = Site::new(&tar()).await;
        site.put_part(&site.content[..1000]);
        site.answers([answer.clone()]);
        let error = site.pull().await.unwrap_err();
        assert!(matches!(error, FetchError::NotTheServer(_)), "{answer:?}: {error:?}");
        assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::SERVER_UNREACHABLE), true));
        assert_eq!(fs::metadata(site.part()).unwrap().len(), 1000);
    }
}

#[tokio::test]
async fn statuses_say_whether_to_come_back() {
    let seconds = |seconds| Some(Duration::from_secs(seconds));
    for (status, retry_after, code, retryable, wait) in [
        (503, Some("7"), FailureCode::SERVER_UNREACHABLE, true, seconds(7)),
        (429, Some("999999"), FailureCode::SERVER_UNREACHABLE, true, seconds(3600)),
        (500, Some("Fri, 31 Dec 1999 23:59:59 GMT"), FailureCode::SERVER_UNREACHABLE, true, None),
        (502, None, FailureCode::SERVER_UNREACHABLE, true, None),
        (401, None, FailureCode::UNAUTHORIZED, true, None),
    ] {
        let site = Site::new(&tar()).await;
        site.answers([Answer::Status(status, retry_after.map(|value| ("retry-after", value)).into_iter().collect())]);
        let error = site.pull().await.unwrap_err();
        assert_eq!(
            (error.code(), error.is_retryable(), error.retry_after()),
            (Some(code), retryable, wait),
            "{status}"
        );
    }
    for status in [403, 404, 410] {
        let site = Site::new(&tar()).await;
        site.answers([Answer::Refused(status)]);
        let error = site.pull().await.unwrap_err();
        assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::PACKAGE_UNAVAILABLE), false), "{status}");
    }
}

#[tokio::test]
async fn a_server_without_room_is_obeyed_and_what_is_there_stays() {
    for (answer, told) in [
        (Answer::Status(429, vec![("retry-after", "7")]), Some(7)),
        (Answer::Status(503, vec![("retry-after", "9")]), Some(9)),
        (Answer::Status(503, vec![]), None),
        (Answer::Status(500, vec![("retry-after", "9")]), None),
    ] {
        let site = Site::new(&tar()).await;
        site.answers([Answer::Cut(1 << 20), answer.clone()]);
        let progress = watch::Sender::new(Progress { done: 0, total: 0 });
        let cancel = CancellationToken::new();
        let pull = site.fetcher.content(&site.package, &site.manifest, &progress, &cancel);
        let error = pull.await.unwrap_err();
        assert_eq!(error.told_to_wait(), told.map(Duration::from_secs), "{answer:?}");
        let there = fs::metadata(site.part()).unwrap().len();
        assert!(there > 0);
        assert_eq!(*progress.borrow(), Progress { done: there, total: site.content.len() as u64 });
        site.pull().await.unwrap();
        site.assert_in_place();
    }
}

#[tokio::test]
async fn what_came_with_the_order_is_not_pulled() {
    let site = Site::new(&tar()).await;
    let config = serde_json::to_vec(&site.manifest).unwrap();
    let (package, cancel) = (&site.package, CancellationToken::new());
    let blobs = |config: &[u8], content: &[u8]| {
        [(package.config, Bytes::copy_from_slice(config)), (package.content, Bytes::copy_from_slice(content))]
    };
    // Others than the state names are as good as none.
    site.fetcher.offer(blobs(&config[1..], &site.content[1..]));
    site.answers([Answer::Status(404, vec![])]);
    assert!(site.fetcher.manifest(package, &cancel).await.is_err());
    assert_eq!(site.asked(), [0]);
    site.fetcher.offer(blobs(&config, &site.content));
    site.put_part(&site.content[..100]);
    assert_eq!(site.fetcher.manifest(package, &cancel).await.unwrap(), site.manifest);
    site.pull().await.unwrap();
    site.assert_in_place();
    assert_eq!(site.asked(), [0; 0]);
}

#[tokio::test]
async fn transfers_teach_about_the_link() {
    let mut site = Site::new(&tar()).await;
    let meter = LinkMeter::default();
    let fetcher = Fetcher::new(client(), site.server.clone(), TOKEN.to_owned(), site.data.clone(), settings());
    site.fetcher = fetcher.measured_by(meter.clone());
    site.answers([Answer::Cut(1 << 20)]);
    site.pull().await.unwrap();
    let facts = meter.facts(tokio::time::Instant::now()).unwrap();
    assert_eq!((facts.losses, facts.reconnects, facts.rtt_ms), (1, 0, None));
    assert!(facts.throughput_bytes_per_s > Some(0));
}

#[tokio::test]
async fn a_server_that_stalls_is_given_up() {
    let site = Site::with(&tar(), FetchSettings { stall_timeout: Duration::from_millis(50), ..settings() }).await;
    site.answers(vec![Answer::Stall(0); 6]);
    let error = site.pull().await.unwrap_err();
    assert!(matches!(error, FetchError::Stalled(_)) && error.is_retryable(), "{error:?}");
}

#[tokio::test]
async fn slow_retrieval_is_cut_by_a_least_rate() {
    let site = Site::with(&tar(), FetchSettings { stall_timeout: Duration::from_millis(300), ..settings() }).await;
    site.answers(vec![Answer::Drip; 6]);
    let error = site.pull().await.unwrap_err();
    assert!(matches!(error, FetchError::Stalled(_)), "{error:?}");
    assert!(site.asked().len() > 1, "it was cut and asked for anew");
}

#[tokio::test]
async fn a_refused_archive_is_blamed_only_when_its_bytes_are_the_ordered_ones() {
    let hostile = Tar::default().file("../escape", b"x").file("data", &noise()).end();
    let site = Site::new(&hostile).await;
    let error = site.pull().await.unwrap_err();
    assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::ARCHIVE_REFUSED), false));
    assert!(error.to_string().contains("the path has '..'"), "{error}");
    assert!(!site.part().exists() && !site.version().src().exists());
    site.assert_nothing_staged();
}

#[tokio::test]
async fn too_little_room_is_said_before_anything_travels() {
    let site = Site::with(&tar(), FetchSettings { reserve_bytes: u64::MAX, ..settings() }).await;
    let error = site.pull().await.unwrap_err();
    assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::DISK_FULL), true));
    assert_eq!(error.retry_after(), Some(task_agent::disk::FULL_PAUSE));
    assert!(error.to_string().contains("in reserve"), "{error}");
    assert_eq!(site.asked(), [0; 0]);

    // What an earlier try had gathered only takes up more of the room that is missing.
    site.put_part(&site.content[..100]);
    assert_eq!(site.pull().await.unwrap_err().code(), Some(FailureCode::DISK_FULL));
    assert!(!site.part().exists());
}

#[tokio::test]
async fn two_pulls_of_one_content_take_turns() {
    let site = Site::new(&tar()).await;
    let (first, second) = tokio::join!(site.pull(), site.pull());
    assert!(first.is_ok() && second.is_ok(), "{first:?} {second:?}");
    assert_eq!(site.asked(), [0]);
    site.assert_in_place();
}

#[tokio::test]
async fn a_manifest_for_something_else_is_refused() {
    let mut site = Site::new(&tar()).await;
    let cancel = CancellationToken::new();
    site.package.version = "2.0.0".parse().unwrap();
    let error = site.fetcher.manifest(&site.package, &cancel).await.unwrap_err();
    assert_eq!(error.code(), Some(FailureCode::MANIFEST_INVALID));
    site.package.config.size = 2 << 20;
    let error = site.fetcher.manifest(&site.package, &cancel).await.unwrap_err();
    assert!(error.to_string().contains("at most 1048576 are allowed"), "{error}");
    assert!(!site.version().manifest().exists());
}

#[tokio::test]
async fn an_unreachable_server_is_tried_again_later() {
    let site = Site::new(&tar()).await;
    let nowhere = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let server = format!("http://{nowhere}").parse().unwrap();
    let fetcher = Fetcher::new(client(), server, TOKEN.to_owned(), site.data.clone(), settings());
    let error = fetcher.manifest(&site.package, &CancellationToken::new()).await.unwrap_err();
    assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::SERVER_UNREACHABLE), true));
}
