//! Whole servers with a common store of blobs, and the program itself: it is killed between an
//! object and its row, while it moves blobs, and pulls a large blob in little memory.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use reqwest::{Method, StatusCode};
use serde_json::Value;
use task_proto::Digest;
use taskd::serve::Server;
use taskd::store::{Store, sqlite_url};
use taskd::system::clock::Clock;
use tempfile::TempDir;

use crate::common_store::{Objects, files_below};
use crate::corruption::eventually;
use crate::harness::TestServer;

const MB: usize = 1 << 20;
/// Far below a blob of 100 MB, and above what the server needs for anything else.
const MAX_MORE_MEMORY_BYTES: u64 = 48 << 20;

async fn server(directory: TempDir, objects: &Objects) -> TestServer {
    let url = objects.url();
    TestServer::start_in(directory, |config| config.blob_store = Some(url)).await
}

async fn push(server: &TestServer, bytes: Vec<u8>) -> reqwest::Response {
    let digest = Digest::of(&bytes);
    let path = format!("/v2/talker/blobs/uploads/?digest={digest}");
    server.request(Method::POST, &path).body(bytes).send().await.expect("an answer")
}

async fn pull(server: &TestServer, digest: Digest) -> reqwest::Response {
    let path = format!("/v2/talker/blobs/{digest}");
    server.request(Method::GET, &path).send().await.expect("an answer")
}

async fn ready(server: &TestServer) -> (StatusCode, String) {
    let answer = server.bare(Method::GET, "/readyz").send().await.expect("an answer");
    let (status, body) = (answer.status(), answer.json::<Value>().await.expect("json"));
    (status, body["blobs"].as_str().unwrap_or_default().to_owned())
}

#[tokio::test(flavor = "multi_thread")]
async fn restarted_server_with_an_empty_cache_serves_all_packages() {
    let objects = Objects::in_directory();
    let server_of = async |directory| server(directory, &objects).await;
    let first = server_of(TempDir::new().expect("a directory")).await;
    let package = first.push("talker", "1.0").await;
    let bytes: Vec<u8> = (0..3 * MB).map(|at| (at / 7) as u8).collect();
    let digest = Digest::of(&bytes);
    assert_eq!(push(&first, bytes.clone()).await.status(), StatusCode::CREATED);
    let cache = first.data().join("blob-cache");
    assert!(!first.data().join("blobs").exists());
    let directory = first.stop().await;
    fs::remove_dir_all(cache).expect("removed");

    let second = server_of(directory).await;
    let head = second.request(Method::HEAD, &format!("/v2/talker/blobs/{digest}"));
    let head = head.send().await.expect("an answer");
    assert_eq!(head.headers()["content-length"], bytes.len().to_string());
    let part = second
        .request(Method::GET, &format!("/v2/talker/blobs/{digest}"))
        .header("range", "bytes=1000000-1000009");
    let part = part.send().await.expect("an answer");
    assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
    assert_eq!(part.bytes().await.expect("a body"), bytes[1_000_000..1_000_010]);
    assert!(pull(&second, digest).await.bytes().await.expect("a body") == bytes);
    let manifest = format!("/v2/talker/manifests/{}", package.manifest.digest);
    let manifest = second.request(Method::GET, &manifest).send().await.expect("an answer");
    let manifest = manifest.bytes().await.expect("a body");
    assert_eq!(Digest::of(&manifest), package.manifest.digest);
    second.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn push_without_the_store_is_refused_and_readyz_says_why() {
    let objects = Objects::in_directory();
    let server = server(TempDir::new().expect("a directory"), &objects).await;
    let package = server.push("talker", "1.0").await;
    assert_eq!(ready(&server).await, (StatusCode::OK, "ok".to_owned()));
    let url = objects.setting();
    let path = Path::new(url.trim_start_matches("file://")).to_owned();
    fs::rename(&path, path.with_extension("away")).expect("renamed");
    let refused = push(&server, b"new".to_vec()).await;
    assert_eq!(refused.status(), StatusCode::SERVICE_UNAVAILABLE);
    assert!(refused.headers().contains_key("retry-after"));
    let body: Value = refused.json().await.expect("json");
    assert_eq!(body["errors"][0]["code"], "UNAVAILABLE");
    let message = body["errors"][0]["message"].as_str().expect("a message");
    assert!(message.contains("blobs.store") && message.ends_with("mounted?"), "{message}");
    // What lies here is served, and reports and orders go on, so the server is ready.
    assert_eq!(pull(&server, package.content.digest).await.status(), StatusCode::OK);
    eventually("/readyz says why", async || {
        let (status, blobs) = ready(&server).await;
        assert_eq!(status, StatusCode::OK);
        blobs.starts_with(&url) && blobs.len() > url.len()
    })
    .await;
    fs::rename(path.with_extension("away"), &path).expect("renamed");
    assert_eq!(push(&server, b"new".to_vec()).await.status(), StatusCode::CREATED);
    server.stop().await;
}

/// The chain of messages by which a server does not start.
async fn refusal(directory: &TempDir, blob_store: Option<&Objects>) -> String {
    let mut config = taskd::config::Config::with_data(directory.path().join("data"));
    config.http.set_port(0);
    config.mqtt.set_port(0);
    config.blob_store = blob_store.map(Objects::url);
    let error = Server::start(config, Clock::system()).await.err().expect("refused");
    let causes = std::iter::successors(std::error::Error::source(&error), |cause| cause.source());
    causes.fold(error.to_string(), |text, cause| format!("{text}: {cause}"))
}

#[tokio::test(flavor = "multi_thread")]
async fn server_whose_blobs_lie_elsewhere_does_not_start() {
    let objects = Objects::in_directory();
    let local = TestServer::start().await;
    local.push("talker", "1.0").await;
    let directory = local.stop().await;
    let text = refusal(&directory, Some(&objects)).await;
    assert!(text.contains("3 blobs lie in ") && text.contains("taskd blobs move"), "{text}");

    // The refused start has changed nothing.
    let local = TestServer::start_in(directory, |_| {}).await;
    local.stop().await;

    let common = server(TempDir::new().expect("a directory"), &objects).await;
    common.push("talker", "1.0").await;
    let directory = common.stop().await;
    let text = refusal(&directory, None).await;
    assert!(text.starts_with("blobs.store is not set"), "{text}");
}

/// The program with its data in a directory.
struct Program {
    process: Child,
    http: String,
    token: String,
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

#[expect(clippy::disallowed_methods, reason = "the test starts the program it tests")]
fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taskd"));
    command.env_clear().stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn taskd(arguments: &[&str], data: &Path, objects: &Objects) -> Command {
    let mut command = program();
    let setting = objects.setting();
    // The other way for a key is the environment.
    let setting = setting.split_once("&credentials=").map_or(&*setting, |(bucket, _)| bucket);
    command.args(arguments).arg("--data").arg(data).args(["--blobs-store", setting]);
    command.envs([("AWS_ACCESS_KEY_ID", "test"), ("AWS_SECRET_ACCESS_KEY", "swordfish")]);
    command
}

impl Program {
    fn start(data: &Path, objects: &Objects) -> Self {
        let serve = ["serve", "--http", "127.0.0.1:0", "--mqtt", "127.0.0.1:0"];
        let mut command = taskd(&serve, data, objects);
        let mut process = command.stderr(Stdio::null()).spawn().expect("it starts");
        let mut said = String::new();
        let stdout = process.stdout.take().expect("piped");
        BufReader::new(stdout).read_line(&mut said).expect("it says where it is");
        assert!(said.starts_with("taskd serves HTTP on http://127.0.0.1:"), "{said}");
        let addresses = fs::read(data.join("addresses.json")).expect("published");
        let addresses: Value = serde_json::from_slice(&addresses).expect("json");
        let http = addresses["http"].as_str().expect("an address").to_owned();
        let token = fs::read_to_string(data.join("operator.token")).expect("a token");
        Self { process, http, token: token.trim().to_owned() }
    }

    fn request(&self, method: Method, path: &str) -> reqwest::RequestBuilder {
        let url = format!("http://{}{path}", self.http);
        crate::registry::client().request(method, url).bearer_auth(&self.token)
    }

    fn push(&self, bytes: &[u8]) -> reqwest::RequestBuilder {
        let path = format!("/v2/talker/blobs/uploads/?digest={}", Digest::of(bytes));
        self.request(Method::POST, &path).body(bytes.to_vec())
    }

    /// The memory that belongs to no file, in bytes.
    fn anonymous_bytes(&self) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.process.id()));
        let status = status.expect("it runs");
        let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:")).expect("there");
        let kilobytes = line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number");
        kilobytes * 1024
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn server_killed_between_object_and_row_has_not_acknowledged() {
    let (directory, objects) = (TempDir::new().expect("a directory"), Objects::in_directory());
    let data = directory.path().join("data");
    let mut program = Program::start(&data, &objects);
    // The first use of a token is a write as well.
    program.push(b"first").send().await.expect("an answer");
    let bytes = b"acknowledged means stored".to_vec();
    // Nothing is written meanwhile, so the row has to wait.
    let store = Store::open(&sqlite_url(&data.join("taskd.sqlite"))).await.expect("opens");
    let write = store.begin().await.expect("begins");
    let pushing = tokio::spawn(program.push(&bytes).send());
    eventually("the object is there", async || {
        tokio::task::yield_now().await;
        objects.files().len() == 2
    })
    .await;
    program.process.kill().expect("killed");
    program.process.wait().expect("ended");
    assert!(pushing.await.expect("no panic").is_err(), "it was not acknowledged");
    drop(write);
    store.close().await;

    let program = Program::start(&data, &objects);
    let path = format!("/v2/talker/blobs/{}", Digest::of(&bytes));
    let absent = program.request(Method::GET, &path).send().await.expect("an answer");
    assert_eq!(absent.status(), StatusCode::NOT_FOUND);
    let again = program.push(&bytes).send().await.expect("an answer");
    assert_eq!(again.status(), StatusCode::CREATED);
    let pulled = program.request(Method::GET, &path).send().await.expect("an answer");
    assert_eq!(pulled.bytes().await.expect("a body"), bytes);
    assert_eq!(objects.files().len(), 3, "the orphan stays for a day");
}

#[tokio::test(flavor = "multi_thread")]
async fn large_blob_is_pushed_and_pulled_in_little_memory() {
    let (directory, objects) = (TempDir::new().expect("a directory"), Objects::in_directory());
    let data = directory.path().join("data");
    let bytes: Vec<u8> = (0..100 * MB).map(|at| (at ^ (at >> 8) ^ (at >> 16)) as u8).collect();
    let path = format!("/v2/talker/blobs/{}", Digest::of(&bytes));
    let program = Program::start(&data, &objects);
    program.push(b"warm").send().await.expect("an answer");
    let before = program.anonymous_bytes();
    let measure = async |request: reqwest::RequestBuilder| {
        let mut most = 0;
        let running = tokio::spawn(async move { request.send().await?.bytes().await });
        while !running.is_finished() {
            most = most.max(program.anonymous_bytes());
            tokio::task::yield_now().await;
        }
        (running.await.expect("no panic").expect("an answer"), most.saturating_sub(before))
    };
    let (_, more) = measure(program.push(&bytes)).await;
    assert!(more < MAX_MORE_MEMORY_BYTES, "a push took {more} bytes");
    drop(program);
    fs::remove_dir_all(data.join("blob-cache")).expect("removed");

    let program = Program::start(&data, &objects);
    program.push(b"warm").send().await.expect("an answer");
    let before = program.anonymous_bytes();
    let (mut most, mut came) = (0, 0);
    let mut answer = program.request(Method::GET, &path).send().await.expect("an answer");
    while let Some(chunk) = answer.chunk().await.expect("it goes on") {
        assert!(chunk == bytes[came..came + chunk.len()]);
        came += chunk.len();
        most = most.max(program.anonymous_bytes());
    }
    assert_eq!(came, bytes.len());
    let more = most.saturating_sub(before);
    assert!(more < MAX_MORE_MEMORY_BYTES, "a pull took {more} bytes");
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

fn blob_files(data: &Path) -> std::collections::BTreeSet<PathBuf> {
    files_below(&data.join("blobs/sha256"))
}

#[tokio::test(flavor = "multi_thread")]
async fn move_that_was_killed_is_completed_by_the_next() {
    killed_move_is_completed(Objects::in_directory()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn move_to_s3_that_was_killed_is_completed_by_the_next() {
    killed_move_is_completed(Objects::in_s3().await).await;
}

async fn killed_move_is_completed(objects: Objects) {
    let local = TestServer::start().await;
    let mut digests = Vec::new();
    for seed in 0..40_u8 {
        let bytes = vec![seed; MB / 4];
        digests.push(Digest::of(&bytes));
        assert_eq!(push(&local, bytes).await.status(), StatusCode::CREATED);
    }
    let data = local.data().to_owned();
    let directory = local.stop().await;
    let damaged = data.join("blobs/sha256").join(digests[0].hex());
    fs::write(&damaged, b"damaged").expect("written");

    let mut killed = taskd(&["blobs", "move"], &data, &objects).spawn().expect("it starts");
    eventually("some are moved", async || {
        tokio::task::yield_now().await;
        objects.files().len() >= 3
    })
    .await;
    killed.kill().expect("killed");
    killed.wait().expect("ended");
    let left = blob_files(&data).len();
    assert!((1..40).contains(&left), "{left} are left");

    let moved = taskd(&["blobs", "move"], &data, &objects).output().expect("it runs");
    let text = stdout(&moved);
    assert!(text.contains(" moved to "), "{text}");
    assert!(blob_files(&data).iter().all(|file| file.extension().is_some()), "all are moved");
    assert!(damaged.with_extension("damaged").exists());
    let again = taskd(&["blobs", "move"], &data, &objects).output().expect("it runs");
    let text = stdout(&again);
    assert!(text.starts_with("0 blobs ("), "{text}");

    let program = Program::start(&data, &objects);
    let used = taskd(&["blobs", "move"], &data, &objects).output().expect("it runs");
    let error = String::from_utf8_lossy(&used.stderr);
    assert!(!used.status.success() && error.contains("is in use"), "{error}");
    fs::remove_dir_all(data.join("blob-cache/sha256")).expect("removed");
    fs::create_dir(data.join("blob-cache/sha256")).expect("made");
    for (at, digest) in digests.iter().enumerate() {
        let path = format!("/v2/talker/blobs/{digest}");
        let answer = program.request(Method::GET, &path).send().await.expect("an answer");
        let expected = if at == 0 { StatusCode::NOT_FOUND } else { StatusCode::OK };
        assert_eq!(answer.status(), expected, "{at}");
        if at > 0 {
            assert_eq!(answer.bytes().await.expect("a body"), vec![at as u8; MB / 4]);
        }
    }
    drop(program);
    drop(directory);
}

#[test]
fn move_without_a_store_is_refused() {
    let directory = TempDir::new().expect("a directory");
    let mut command = program();
    let refused = command.args(["blobs", "move", "--data"]).arg(directory.path()).output();
    let refused = refused.expect("it runs");
    let error = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1));
    assert!(error.starts_with("taskd: blobs.store: no store is set"), "{error}");
}

#[test]
fn key_in_the_setting_is_refused_and_not_repeated() {
    let mut command = program();
    command.args(["serve", "--data", "/nowhere"]);
    let refused = command.args(["--blobs-store", "s3://AKIA1:swordfish@fleet"]).output();
    let refused = refused.expect("it runs");
    let error = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(2));
    assert!(error.starts_with("taskd: --blobs-store: it holds an access key"), "{error}");
    assert!(!error.contains("swordfish"), "{error}");
}
