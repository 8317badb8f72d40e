//! The registry over a real listener: what the distribution specification asks for, and what only this server does.

use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use axum::middleware::{map_request, map_request_with_state};
use axum::routing::any;
use reqwest::{Client, Method, RequestBuilder, Response, StatusCode};
use serde_json::{Value, json};
use task_proto::desired::BlobRef;
use task_proto::oci::{INDEX_TYPE, ImageManifest, MANIFEST_TYPE};
use task_proto::{Digest, RobotId};
use taskd::blobs::{BlobSettings, Blobs};
use taskd::clock::Clock;
use taskd::collector::{self, Collected};
use taskd::config::BlobRead;
use taskd::http::auth::Caller;
use taskd::http::drain::drain_unread;
use taskd::http::oci::{self, Registry};
use taskd::store::{Store, sqlite_url};
use tempfile::TempDir;

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, order_of, random_key};

const GRACE: Duration = Duration::from_secs(3600);
/// Past what any file's time can be when a test runs.
const NOW_MS: u64 = 4_000_000_000_000;

struct TestRegistry {
    base: String,
    client: Client,
    registry: Registry,
    data: TempDir,
}

impl TestRegistry {
    /// A registry whose every caller is an operator.
    async fn start() -> Self {
        Self::start_with(BlobSettings::default(), Some(operator())).await
    }

    async fn start_with(settings: BlobSettings, caller: Option<Caller>) -> Self {
        let data = tempfile::tempdir().expect("a directory");
        let store = Store::open(&sqlite_url(&data.path().join("taskd.db"))).await.expect("a store");
        Self::start_on(store, data, settings, caller).await
    }

    async fn start_on(store: Store, data: TempDir, settings: BlobSettings, caller: Option<Caller>) -> Self {
        let blobs = Blobs::open(data.path(), settings).expect("a blob store");
        let registry = Registry { store, blobs, clock: Clock::fixed(NOW_MS) };
        Self { base: serve(registry.clone(), caller).await, client: client(), registry, data }
    }

    fn ask(&self, method: Method, path: &str) -> RequestBuilder {
        let url = if path.starts_with('/') { format!("{}{path}", self.base) } else { path.to_owned() };
        self.client.request(method, url)
    }

    async fn get(&self, path: &str) -> Response {
        self.ask(Method::GET, path).send().await.expect("an answer")
    }

    async fn status(&self, method: Method, path: &str) -> StatusCode {
        self.ask(method, path).send().await.expect("an answer").status()
    }

    async fn begin(&self, repository: &str) -> String {
        let path = format!("/v2/{repository}/blobs/uploads/");
        let answer = self.ask(Method::POST, &path).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::ACCEPTED);
        header(&answer, "location")
    }

    async fn push_blob(&self, repository: &str, bytes: &[u8]) -> BlobRef {
        let digest = Digest::of(bytes);
        let path = format!("/v2/{repository}/blobs/uploads/?digest={digest}");
        let answer = self.ask(Method::POST, &path).body(bytes.to_vec()).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::CREATED);
        BlobRef { digest, size: bytes.len() as u64 }
    }

    async fn put_manifest(&self, path: &str, media_type: &str, manifest: &impl serde::Serialize) -> Response {
        let body = serde_json::to_vec(manifest).expect("JSON");
        self.ask(Method::PUT, path).header("content-type", media_type).body(body).send().await.expect("an answer")
    }

    /// Pushes an image of two small blobs, tagged `tag`.
    async fn push_image(&self, repository: &str, tag: &str) -> Digest {
        let config = self.push_blob(repository, b"{}").await;
        let layer = self.push_blob(repository, tag.as_bytes()).await;
        let image = image(config, layer);
        let answer = self.put_manifest(&format!("/v2/{repository}/manifests/{tag}"), MANIFEST_TYPE, &image).await;
        assert_eq!(answer.status(), StatusCode::CREATED);
        header(&answer, "docker-content-digest").parse().expect("a digest")
    }

    async fn collect(&self, now_ms: u64) -> Collected {
        collector::collect(&self.registry.store, &self.registry.blobs, now_ms, GRACE).await.expect("collected")
    }
}

/// Serves a registry to one caller and says where.
async fn serve(registry: Registry, caller: Option<Caller>) -> String {
    let router = Router::new()
        .route("/v2/", any(oci::version))
        .route("/v2/{*path}", any(oci::dispatch))
        .with_state(registry)
        .layer(map_request_with_state(caller, let_in))
        .layer(map_request(drain_unread));
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let base = format!("http://{}", listener.local_addr().expect("an address"));
    tokio::spawn(async move { axum::serve(listener, router).await });
    base
}

fn client() -> Client {
    // Another test may have installed it before.
    let _ = rustls::crypto::ring::default_provider().install_default();
    Client::new()
}

async fn let_in(axum::extract::State(caller): axum::extract::State<Option<Caller>>, mut request: Request) -> Request {
    if let Some(caller) = caller {
        request.extensions_mut().insert(caller);
    }
    request
}

fn operator() -> Caller {
    Caller::Operator
}

fn image(config: BlobRef, layer: BlobRef) -> Value {
    json!({
        "schemaVersion": 2,
        "mediaType": MANIFEST_TYPE,
        "config": { "mediaType": "application/vnd.example.config", "digest": config.digest, "size": config.size },
        "layers": [{ "mediaType": "application/vnd.example.layer", "digest": layer.digest, "size": layer.size }],
    })
}

fn header(answer: &Response, name: &str) -> String {
    answer.headers().get(name).unwrap_or_else(|| panic!("no {name}")).to_str().expect("text").to_owned()
}

/// The answer's status and its first error code.
async fn refusal(answer: Response) -> (u16, String) {
    let status = answer.status().as_u16();
    let body: Value = answer.json().await.expect("an error body");
    (status, body["errors"][0]["code"].as_str().expect("a code").to_owned())
}

fn refused(status: u16, code: &str) -> (u16, String) {
    (status, code.to_owned())
}

#[tokio::test]
async fn nobody_is_let_in_without_a_token() {
    let registry = TestRegistry::start_with(BlobSettings::default(), None).await;
    for path in ["/v2/", "/v2/a/tags/list", "/v2/a/manifests/x", "/v2/nonsense"] {
        let answer = registry.get(path).await;
        assert_eq!(header(&answer, "www-authenticate"), "Basic realm=\"taskd\", charset=\"UTF-8\"", "{path}");
        assert_eq!(refusal(answer).await, refused(401, "UNAUTHORIZED"), "{path}");
    }
}

#[tokio::test]
async fn a_robot_reads_no_blob_that_is_not_assigned_to_it() {
    let robot = TestRegistry::start_with(BlobSettings::default(), Some(Caller::Robot(RobotId::random()))).await;
    assert_eq!(robot.status(Method::GET, "/v2/").await, StatusCode::OK);
    let blob = format!("/v2/a/blobs/{}", Digest::of(b"x"));
    for (method, path) in [
        (Method::GET, blob.as_str()),
        (Method::HEAD, &blob),
        (Method::DELETE, &blob),
        (Method::GET, "/v2/a/tags/list"),
        (Method::GET, "/v2/a/manifests/latest"),
        (Method::PUT, "/v2/a/manifests/latest"),
        (Method::POST, "/v2/a/blobs/uploads/"),
    ] {
        assert_eq!(robot.status(method.clone(), path).await, StatusCode::FORBIDDEN, "{method} {path}");
    }
}

#[tokio::test]
async fn a_blob_is_read_whole_and_in_parts_from_either_kind_of_store() {
    let bytes: Vec<u8> = (0..1_000_000_u32).flat_map(u32::to_le_bytes).collect();
    for reading in [BlobRead::Mmap, BlobRead::Pread] {
        let settings = BlobSettings { reading, ..BlobSettings::default() };
        let registry = TestRegistry::start_with(settings, Some(operator())).await;
        let blob = registry.push_blob("a/b/c", &bytes).await;
        let path = format!("/v2/a/b/c/blobs/{}", blob.digest);

        let answer = registry.get(&path).await;
        let etag = format!("\"{}\"", blob.digest);
        assert_eq!(header(&answer, "etag"), etag);
        assert_eq!(header(&answer, "docker-content-digest"), blob.digest.to_string());
        assert_eq!(header(&answer, "content-length"), bytes.len().to_string());
        assert!(header(&answer, "cache-control").contains("immutable"));
        assert!(answer.bytes().await.expect("a body") == bytes);

        let head = registry.ask(Method::HEAD, &path).send().await.expect("an answer");
        assert_eq!((head.status(), header(&head, "content-length")), (StatusCode::OK, bytes.len().to_string()));

        let part = registry.ask(Method::GET, &path).header("range", "bytes=300001-3000000").send().await.expect("it");
        assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
        assert_eq!(header(&part, "content-range"), "bytes 300001-3000000/4000000");
        assert!(part.bytes().await.expect("a body") == bytes[300_001..=3_000_000]);

        let beyond = registry.ask(Method::GET, &path).header("range", "bytes=4000000-").send().await.expect("it");
        assert_eq!(header(&beyond, "content-range"), "bytes */4000000");
        assert_eq!(beyond.status(), StatusCode::RANGE_NOT_SATISFIABLE);

        let known = registry.ask(Method::GET, &path).header("if-none-match", etag).send().await.expect("it");
        assert_eq!(known.status(), StatusCode::NOT_MODIFIED);

        let empty = registry.push_blob("a/b/c", b"").await;
        let answer = registry.get(&format!("/v2/a/b/c/blobs/{}", empty.digest)).await;
        assert_eq!((answer.status(), header(&answer, "content-length")), (StatusCode::OK, "0".to_owned()));
    }
}

#[tokio::test]
async fn chunks_come_in_order_or_not_at_all() {
    let registry = TestRegistry::start().await;
    let upload = registry.begin("a").await;
    let patch = async |range: &str, body: &'static str| {
        let request = registry.ask(Method::PATCH, &upload).header("content-range", range).body(body);
        request.send().await.expect("an answer")
    };
    assert_eq!(patch("2-3", "xx").await.status(), StatusCode::RANGE_NOT_SATISFIABLE);
    let first = patch("0-4", "hello").await;
    assert_eq!((first.status(), header(&first, "range")), (StatusCode::ACCEPTED, "0-4".to_owned()));
    assert_eq!(patch("0-4", "hello").await.status(), StatusCode::RANGE_NOT_SATISFIABLE);
    assert_eq!(refusal(patch("5-9", "abc").await).await, refused(400, "SIZE_INVALID"));
    assert_eq!(refusal(patch("bytes 5-9/10", "abcde").await).await, refused(400, "BLOB_UPLOAD_INVALID"));

    let status = registry.get(&upload).await;
    assert_eq!((status.status(), header(&status, "range")), (StatusCode::NO_CONTENT, "0-4".to_owned()));
    let elsewhere = upload.replace("/v2/a/", "/v2/b/");
    assert_eq!(refusal(registry.get(&elsewhere).await).await, refused(404, "BLOB_UPLOAD_UNKNOWN"));

    let digest = Digest::of(b"hello world");
    let last = registry.ask(Method::PUT, &format!("{upload}?digest={digest}")).header("content-range", "5-10");
    let answer = last.body(" world").send().await.expect("an answer");
    assert_eq!((answer.status(), header(&answer, "docker-content-digest")), (StatusCode::CREATED, digest.to_string()));
    assert_eq!(registry.get(&header(&answer, "location")).await.text().await.expect("text"), "hello world");
    assert_eq!(registry.status(Method::GET, &upload).await, StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn wrong_bytes_and_cancelled_uploads_leave_nothing() {
    let registry = TestRegistry::start().await;
    let digest = Digest::of(b"announced");
    let path = format!("/v2/a/blobs/uploads/?digest={digest}");
    let answer = registry.ask(Method::POST, &path).body("sent").send().await.expect("an answer");
    assert_eq!(refusal(answer).await, refused(400, "DIGEST_INVALID"));
    assert_eq!(registry.status(Method::HEAD, &format!("/v2/a/blobs/{digest}")).await, StatusCode::NOT_FOUND);

    let upload = registry.begin("a").await;
    for bad in [upload.clone(), format!("{upload}?digest=sha512:00"), format!("{upload}?digest=sha256:00")] {
        let answer = registry.ask(Method::PUT, &bad).body("x").send().await.expect("an answer");
        assert_eq!(refusal(answer).await, refused(400, "DIGEST_INVALID"), "{bad}");
    }
    assert_eq!(registry.status(Method::DELETE, &upload).await, StatusCode::NO_CONTENT);
    let answer = registry.ask(Method::PATCH, &upload).body("x").send().await.expect("an answer");
    assert_eq!(refusal(answer).await, refused(404, "BLOB_UPLOAD_UNKNOWN"));
    let uploads = std::fs::read_dir(registry.data.path().join("uploads")).expect("a directory");
    assert_eq!(uploads.count(), 0);
}

#[tokio::test]
async fn limits_are_told_and_held() {
    let settings = BlobSettings { max_blob_bytes: 1000, max_uploads: 1, ..BlobSettings::default() };
    let registry = TestRegistry::start_with(settings, Some(operator())).await;
    let upload = registry.begin("a").await;
    let second = registry.ask(Method::POST, "/v2/a/blobs/uploads/").send().await.expect("an answer");
    assert_eq!(refusal(second).await, refused(429, "TOOMANYREQUESTS"));

    let announced = registry.ask(Method::PATCH, &upload).body(vec![0; 1001]).send().await.expect("an answer");
    assert_eq!(refusal(announced).await, refused(413, "SIZE_INVALID"));
    let pieces = futures_util::stream::iter((0..11).map(|_| Ok::<_, std::io::Error>(vec![0_u8; 100])));
    let streamed = registry.ask(Method::PATCH, &upload).body(reqwest::Body::wrap_stream(pieces));
    assert_eq!(refusal(streamed.send().await.expect("an answer")).await, refused(413, "SIZE_INVALID"));

    let large = registry.ask(Method::PUT, "/v2/a/manifests/x").body(vec![b' '; 4 * 1024 * 1024 + 1]);
    assert_eq!(refusal(large.send().await.expect("an answer")).await, refused(413, "SIZE_INVALID"));
}

#[tokio::test]
async fn one_blob_pushed_by_many_at_once_is_one_blob() {
    let registry = TestRegistry::start().await;
    let bytes = vec![7; 300_000];
    let pushes = (0..8).map(|_| registry.push_blob("a", &bytes));
    let blobs = futures_util::future::join_all(pushes).await;
    let answer = registry.get(&format!("/v2/a/blobs/{}", blobs[0].digest)).await;
    assert!(answer.bytes().await.expect("a body") == bytes);
}

#[tokio::test]
async fn a_blob_is_mounted_or_asked_for() {
    let registry = TestRegistry::start().await;
    let digest = registry.push_blob("from", b"x").await.digest;
    let mount = async |query: &str| registry.status(Method::POST, &format!("/v2/to/blobs/uploads/?{query}")).await;
    assert_eq!(mount(&format!("mount={digest}&from=other")).await, StatusCode::ACCEPTED);
    assert_eq!(registry.status(Method::HEAD, &format!("/v2/to/blobs/{digest}")).await, StatusCode::NOT_FOUND);
    assert_eq!(mount(&format!("mount={digest}&from=from")).await, StatusCode::CREATED);
    assert_eq!(registry.status(Method::HEAD, &format!("/v2/to/blobs/{digest}")).await, StatusCode::OK);

    let delete =
        async |repository: &str| registry.status(Method::DELETE, &format!("/v2/{repository}/blobs/{digest}")).await;
    assert_eq!((delete("to").await, delete("to").await), (StatusCode::ACCEPTED, StatusCode::NOT_FOUND));
    assert_eq!(registry.status(Method::GET, &format!("/v2/from/blobs/{digest}")).await, StatusCode::OK);
}

#[tokio::test]
async fn a_manifest_is_kept_byte_for_byte_under_digest_and_tag() {
    let registry = TestRegistry::start().await;
    let digest = registry.push_image("a/b", "v1").await;
    for reference in ["v1".to_owned(), digest.to_string()] {
        let answer = registry.get(&format!("/v2/a/b/manifests/{reference}")).await;
        assert_eq!(header(&answer, "content-type"), MANIFEST_TYPE);
        assert_eq!(header(&answer, "docker-content-digest"), digest.to_string());
        assert_eq!(Digest::of(&answer.bytes().await.expect("a body")), digest);
    }
    // The tag goes alone, the manifest with all its tags.
    assert_eq!(registry.status(Method::DELETE, "/v2/a/b/manifests/v1").await, StatusCode::ACCEPTED);
    assert_eq!(registry.status(Method::GET, "/v2/a/b/manifests/v1").await, StatusCode::NOT_FOUND);
    assert_eq!(registry.push_image("a/b", "v1").await, digest);
    let by_digest = format!("/v2/a/b/manifests/{digest}");
    assert_eq!(registry.status(Method::DELETE, &by_digest).await, StatusCode::ACCEPTED);
    for path in [by_digest.as_str(), "/v2/a/b/manifests/v1", "/v2/a/b/manifests/.not-a-tag"] {
        assert_eq!(refusal(registry.get(path).await).await, refused(404, "MANIFEST_UNKNOWN"), "{path}");
    }
}

#[tokio::test]
async fn a_manifest_that_can_not_be_is_refused_with_the_reason() {
    let registry = TestRegistry::start().await;
    let config = registry.push_blob("a", b"{}").await;
    let missing = BlobRef { digest: Digest::of(b"missing"), size: 7 };
    let good = image(config, config);
    let put = async |reference: &str, media_type: &str, manifest: &Value| {
        refusal(registry.put_manifest(&format!("/v2/a/manifests/{reference}"), media_type, manifest).await).await
    };
    let invalid = refused(400, "MANIFEST_INVALID");
    assert_eq!(put("v1", MANIFEST_TYPE, &image(config, missing)).await, refused(400, "MANIFEST_BLOB_UNKNOWN"));
    assert_eq!(put(&missing.digest.to_string(), MANIFEST_TYPE, &good).await, refused(400, "DIGEST_INVALID"));
    assert_eq!(put("-x", MANIFEST_TYPE, &good).await, refused(400, "TAG_INVALID"));
    assert_eq!(put("v1", INDEX_TYPE, &good).await, invalid);
    assert_eq!(put("v1", MANIFEST_TYPE, &json!({ "schemaVersion": 2 })).await, invalid);
    assert_eq!(put("v1", MANIFEST_TYPE, &json!([])).await, invalid);
    let index = json!({ "schemaVersion": 2, "manifests": [{ "mediaType": MANIFEST_TYPE, "digest": missing.digest }] });
    assert_eq!(put("v1", INDEX_TYPE, &index).await, refused(400, "MANIFEST_BLOB_UNKNOWN"));
    let name = registry.put_manifest("/v2/A/manifests/v1", MANIFEST_TYPE, &good).await;
    assert_eq!(refusal(name).await, refused(400, "NAME_INVALID"));
    // What is not understood is kept all the same.
    let foreign = registry.put_manifest("/v2/a/manifests/v1", "application/x-foreign+json", &json!({ "x": 1 })).await;
    assert_eq!(foreign.status(), StatusCode::CREATED);
}

#[tokio::test]
async fn of_two_manifests_for_one_tag_one_wins() {
    let registry = TestRegistry::start().await;
    let images = [registry.push_image("a", "one").await, registry.push_image("a", "two").await];
    let bodies = [registry.get("/v2/a/manifests/one").await, registry.get("/v2/a/manifests/two").await];
    let bodies = futures_util::future::join_all(bodies.map(Response::bytes)).await;
    let pushes = (0..20).map(|at| {
        let body = bodies[at % 2].as_ref().expect("a body").clone();
        registry.ask(Method::PUT, "/v2/a/manifests/latest").header("content-type", MANIFEST_TYPE).body(body).send()
    });
    for answer in futures_util::future::join_all(pushes).await {
        assert_eq!(answer.expect("an answer").status(), StatusCode::CREATED);
    }
    let latest = registry.get("/v2/a/manifests/latest").await;
    let digest: Digest = header(&latest, "docker-content-digest").parse().expect("a digest");
    assert!(images.contains(&digest));
    assert_eq!(Digest::of(&latest.bytes().await.expect("a body")), digest);
}

#[tokio::test]
async fn tags_are_listed_in_pages() {
    let registry = TestRegistry::start().await;
    assert_eq!(refusal(registry.get("/v2/a/tags/list").await).await, refused(404, "NAME_UNKNOWN"));
    for tag in ["b", "B", "a", "c_1", "C"] {
        registry.push_image("a", tag).await;
    }
    let mut seen = Vec::new();
    let mut next = "/v2/a/tags/list?n=2".to_owned();
    loop {
        let answer = registry.get(&next).await;
        let link = answer.headers().get("link").map(|link| link.to_str().expect("text").to_owned());
        let body: Value = answer.json().await.expect("JSON");
        assert_eq!(body["name"], "a");
        let tags = body["tags"].as_array().expect("a list").clone();
        assert!(tags.len() <= 2);
        seen.extend(tags);
        let Some(link) = link else { break };
        next = link.trim_start_matches('<').split_once(">; rel=\"next\"").expect("a link").0.to_owned();
    }
    assert_eq!(seen, ["B", "C", "a", "b", "c_1"]);
    let none: Value = registry.get("/v2/a/tags/list?n=0").await.json().await.expect("JSON");
    assert_eq!(none["tags"], json!([]));
    assert_eq!(registry.status(Method::GET, "/v2/a/tags/list?n=-1").await, StatusCode::BAD_REQUEST);
}

#[tokio::test]
async fn referrers_are_found_by_subject_and_filtered_by_type() {
    let registry = TestRegistry::start().await;
    let blob = registry.push_blob("a", b"{}").await;
    let subject = json!({ "mediaType": MANIFEST_TYPE, "digest": Digest::of(b"not here"), "size": 8 });
    for kind in ["application/x-one", "application/x-two"] {
        let mut manifest = image(blob, blob);
        manifest["subject"] = subject.clone();
        manifest["artifactType"] = json!(kind);
        manifest["annotations"] = json!({ "kind": kind });
        let answer = registry.put_manifest(&format!("/v2/a/manifests/{}", &kind[14..]), MANIFEST_TYPE, &manifest).await;
        assert_eq!(header(&answer, "oci-subject"), subject["digest"].as_str().expect("text"));
    }
    let path = format!("/v2/a/referrers/{}", subject["digest"].as_str().expect("text"));
    let all: Value = registry.get(&path).await.json().await.expect("JSON");
    assert_eq!(all["manifests"].as_array().expect("a list").len(), 2);
    let filtered = registry.get(&format!("{path}?artifactType=application/x-one")).await;
    assert_eq!(header(&filtered, "oci-filters-applied"), "artifactType");
    assert_eq!(header(&filtered, "content-type"), INDEX_TYPE);
    let filtered: Value = filtered.json().await.expect("JSON");
    let one = &filtered["manifests"].as_array().expect("a list")[..];
    assert_eq!((one.len(), &one[0]["annotations"]["kind"]), (1, &json!("application/x-one")));
    let nothing: Value = registry.get(&format!("/v2/b/referrers/{}", blob.digest)).await.json().await.expect("JSON");
    assert_eq!(nothing["manifests"], json!([]));
    assert_eq!(refusal(registry.get("/v2/a/referrers/x").await).await, refused(400, "DIGEST_INVALID"));
}

fn task(name: &str) -> Value {
    json!({
        "name": name, "version": "1.0.0", "run": { "exec": ["true"] },
        "content": { "tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0 },
    })
}

#[tokio::test]
async fn a_task_package_is_checked_and_listed() {
    let registry = TestRegistry::start().await;
    let content = registry.push_blob("talker", b"content").await;
    let mut no_command = task("talker");
    no_command["run"] = json!({});
    for (config, reason) in [
        (task("listener"), "name: \"listener\" must be the repository's name"),
        (no_command, "run: give either"),
        (json!({ "name": "talker" }), "missing field"),
    ] {
        let config = registry.push_blob("talker", config.to_string().as_bytes()).await;
        let package = ImageManifest::package(config, content);
        let answer = registry.put_manifest("/v2/talker/manifests/1.0.0", MANIFEST_TYPE, &package).await;
        let body: Value = answer.json().await.expect("an error body");
        assert_eq!(body["errors"][0]["code"], "MANIFEST_INVALID");
        assert!(body["errors"][0]["message"].as_str().expect("text").contains(reason), "{body} for {reason}");
    }
    assert_eq!(registry.registry.store.packages().await.expect("packages"), []);

    let config = registry.push_blob("talker", task("talker").to_string().as_bytes()).await;
    let package = ImageManifest::package(config, content);
    for _ in 0..2 {
        let answer = registry.put_manifest("/v2/talker/manifests/1.0.0", MANIFEST_TYPE, &package).await;
        assert_eq!(answer.status(), StatusCode::CREATED);
    }
    let packages = registry.registry.store.packages().await.expect("packages");
    let [view] = &packages[..] else { panic!("{packages:?}") };
    assert_eq!((view.package.config, view.package.content), (config, content));
    assert_eq!((view.pushed_at_ms, view.package.version.as_str()), (NOW_MS, "1.0.0"));
    let found = registry.registry.store.package(&view.package.name, &view.package.manifest.digest).await;
    assert_eq!(found.expect("a package").as_ref(), Some(view));

    let manifest = format!("/v2/talker/manifests/{}", view.package.manifest.digest);
    assert_eq!(registry.status(Method::DELETE, &manifest).await, StatusCode::ACCEPTED);
    assert_eq!(registry.registry.store.packages().await.expect("packages"), []);
}

async fn a_package_in_use_outlives_its_manifest(database: TestDatabase) {
    let data = tempfile::tempdir().expect("a directory");
    let store = database.store.clone();
    let registry = TestRegistry::start_on(store, data, BlobSettings::default(), Some(operator())).await;
    let config = registry.push_blob("talker", task("talker").to_string().as_bytes()).await;
    let content = registry.push_blob("talker", b"content").await;
    let package = ImageManifest::package(config, content);
    let answer = registry.put_manifest("/v2/talker/manifests/1.0.0", MANIFEST_TYPE, &package).await;
    assert_eq!(answer.status(), StatusCode::CREATED);
    let tags: Value = registry.get("/v2/talker/tags/list").await.json().await.expect("JSON");
    assert_eq!(tags["tags"], json!(["1.0.0"]));

    let fleet = Fleet::new(database);
    let robots = fleet.enroll(1).await;
    let ordered = registry.registry.store.packages().await.expect("packages").remove(0);
    fleet.actions.create_deployment(&random_key(), &order_of(&ordered), &ordered).await.expect("ordered");
    let robot = serve(registry.registry.clone(), Some(Caller::Robot(robots[0].id.clone()))).await;
    let stranger = serve(registry.registry.clone(), Some(Caller::Robot(RobotId::random()))).await;

    let manifest = ordered.package.manifest.digest;
    let path = format!("/v2/talker/manifests/{manifest}");
    assert_eq!(registry.status(Method::DELETE, &path).await, StatusCode::ACCEPTED);
    assert_eq!(registry.status(Method::GET, &path).await, StatusCode::NOT_FOUND);
    let loose = registry.push_blob("talker", b"loose").await.digest;
    let year_ms = 365 * 24 * 3_600_000;
    assert_eq!(registry.collect(NOW_MS + year_ms).await.blobs, 1);
    for (digest, expected) in [
        (manifest, StatusCode::OK),
        (config.digest, StatusCode::OK),
        (content.digest, StatusCode::OK),
        (loose, StatusCode::FORBIDDEN),
    ] {
        let path = format!("/v2/talker/blobs/{digest}");
        assert_eq!(registry.status(Method::GET, &format!("{robot}{path}")).await, expected, "{digest}");
        assert_eq!(registry.status(Method::GET, &format!("{stranger}{path}")).await, StatusCode::FORBIDDEN);
    }
}

on_both_databases!(a_package_in_use_outlives_its_manifest);

#[tokio::test]
async fn what_nothing_refers_to_is_collected_after_its_grace() {
    let registry = TestRegistry::start().await;
    let grace_ms = u64::try_from(GRACE.as_millis()).expect("small");
    let manifest = registry.push_image("a", "kept").await;
    let loose = registry.push_blob("a", b"loose").await.digest;
    let blob = format!("/v2/a/blobs/{loose}");
    assert_eq!(registry.collect(NOW_MS + grace_ms).await, Collected { uploads: 0, blobs: 0 });

    // Somebody who is about to push asks for it: the grace begins anew.
    registry.registry.clock.advance_ms(grace_ms);
    assert_eq!(registry.status(Method::HEAD, &blob).await, StatusCode::OK);
    assert_eq!(registry.collect(NOW_MS + grace_ms + 1).await.blobs, 0);
    assert_eq!(registry.collect(NOW_MS + 2 * grace_ms + 1).await.blobs, 1);
    assert_eq!(registry.status(Method::GET, &blob).await, StatusCode::NOT_FOUND);
    assert_eq!(registry.status(Method::GET, "/v2/a/manifests/kept").await, StatusCode::OK);

    // A deleted manifest, its config and its layer go after a grace of their own.
    let path = format!("/v2/a/manifests/{manifest}");
    assert_eq!(registry.status(Method::DELETE, &path).await, StatusCode::ACCEPTED);
    assert_eq!(registry.collect(NOW_MS + 2 * grace_ms).await.blobs, 0);
    assert_eq!(registry.collect(NOW_MS + 2 * grace_ms + 1).await.blobs, 3);
}

#[tokio::test]
async fn uploads_that_were_given_up_are_collected() {
    let registry = TestRegistry::start().await;
    let upload = registry.begin("a").await;
    // The file's time is the machine's, which is before the test's.
    assert_eq!(registry.collect(NOW_MS).await, Collected { uploads: 1, blobs: 0 });
    assert_eq!(registry.status(Method::GET, &upload).await, StatusCode::NOT_FOUND);
}
