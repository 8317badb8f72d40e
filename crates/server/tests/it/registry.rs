//! A registry over a real listener, and a client with full control over its requests.

use std::path::Path;
use std::sync::LazyLock;
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use axum::middleware::{map_request, map_request_with_state};
use axum::routing::any;
use reqwest::{Client, Method, RequestBuilder, Response, StatusCode};
use serde_json::{Value, json};
use task_proto::Digest;
use task_proto::desired::BlobRef;
use task_proto::packages::oci::MANIFEST_TYPE;
use task_proto::trust::token::{Token, TokenKind};

use taskd::blobs::collector::{self, Collected};
use taskd::blobs::{BlobSettings, Blobs, CommonStore};
use taskd::config::TransferLimits;
use taskd::domain::blob_store_url::BlobStoreUrl;
use taskd::domain::person::Person;
use taskd::http::auth::Caller;
use taskd::http::connection::drain::drain_unread;
use taskd::http::peers::Peers;
use taskd::http::registry::archives::ArchiveReaders;
use taskd::http::registry::{Registry, oci};
use taskd::link::transfers::Transfers;
use taskd::orders::changes::Changes;
use taskd::store::{Store, sqlite_url};
use taskd::system::clock::Clock;
use tempfile::TempDir;

pub const GRACE: Duration = Duration::from_secs(3600);
/// Past what any file's time can be when a test runs.
pub const NOW_MS: u64 = 4_000_000_000_000;

/// The credentials of [`operator`].
static OPERATOR: LazyLock<Token> = LazyLock::new(|| Token::random(TokenKind::Operator));

pub struct TestRegistry {
    pub base: String,
    pub client: Client,
    pub registry: Registry,
    pub data: TempDir,
}

impl TestRegistry {
    /// A registry that treats every caller as an operator.
    pub async fn start() -> Self {
        Self::start_with(BlobSettings::default(), Some(operator())).await
    }

    pub async fn start_with(settings: BlobSettings, caller: Option<Caller>) -> Self {
        let data = tempfile::tempdir().expect("a directory");
        let store = Store::open(&sqlite_url(&data.path().join("taskd.db"))).await.expect("a store");
        Self::start_on(store, data, settings, caller).await
    }

    pub async fn start_on(
        store: Store,
        data: TempDir,
        settings: BlobSettings,
        caller: Option<Caller>,
    ) -> Self {
        let blobs = open_blobs(&store, data.path(), settings).await;
        store.tokens().create_first(&OPERATOR, NOW_MS).await.expect("stored");
        let site_label = "site".parse().expect("a label's key");
        let transfers = Transfers::new(&TransferLimits::default(), site_label);
        let (clock, changes) = (Clock::fixed(NOW_MS), Changes::new());
        let readers = ArchiveReaders::default();
        let peers = Peers::default();
        let registry = Registry { store, blobs, clock, transfers, changes, readers, peers };
        Self { base: serve(registry.clone(), caller).await, client: client(), registry, data }
    }

    pub fn ask(&self, method: Method, path: &str) -> RequestBuilder {
        let url =
            if path.starts_with('/') { format!("{}{path}", self.base) } else { path.to_owned() };
        self.client.request(method, url)
    }

    pub async fn get(&self, path: &str) -> Response {
        self.ask(Method::GET, path).send().await.expect("an answer")
    }

    pub async fn status(&self, method: Method, path: &str) -> StatusCode {
        self.ask(method, path).send().await.expect("an answer").status()
    }

    pub async fn begin(&self, repository: &str) -> String {
        let path = format!("/v2/{repository}/blobs/uploads/");
        let answer = self.ask(Method::POST, &path).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::ACCEPTED);
        header(&answer, "location")
    }

    pub async fn push_blob(&self, repository: &str, bytes: &[u8]) -> BlobRef {
        let digest = Digest::of(bytes);
        let path = format!("/v2/{repository}/blobs/uploads/?digest={digest}");
        let answer =
            self.ask(Method::POST, &path).body(bytes.to_vec()).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::CREATED);
        BlobRef { digest, size: bytes.len() as u64 }
    }

    pub async fn put_manifest(
        &self,
        path: &str,
        media_type: &str,
        manifest: &impl serde::Serialize,
    ) -> Response {
        let body = serde_json::to_vec(manifest).expect("JSON");
        self.ask(Method::PUT, path)
            .header("content-type", media_type)
            .body(body)
            .send()
            .await
            .expect("an answer")
    }

    /// Pushes an image of two small blobs, tagged `tag`.
    pub async fn push_image(&self, repository: &str, tag: &str) -> Digest {
        let config = self.push_blob(repository, b"{}").await;
        let layer = self.push_blob(repository, tag.as_bytes()).await;
        let image = image(config, layer);
        let answer = self
            .put_manifest(&format!("/v2/{repository}/manifests/{tag}"), MANIFEST_TYPE, &image)
            .await;
        assert_eq!(answer.status(), StatusCode::CREATED);
        header(&answer, "docker-content-digest").parse().expect("a digest")
    }

    pub async fn collect(&self, now_ms: u64) -> Collected {
        collector::collect(&self.registry.store, &self.registry.blobs, now_ms, GRACE)
            .await
            .expect("collected")
    }
}

tokio::task_local! {
    /// Whether the test's registries keep their blobs in a common store.
    static HAS_COMMON_STORE: ();
}

/// Runs a test whose registries keep their blobs in a common store, without local copies.
pub async fn with_common_store(test: impl Future<Output = ()>) {
    HAS_COMMON_STORE.scope((), test).await;
}

/// Runs each test with blobs in the data directory, and with blobs in a common store.
macro_rules! on_both_stores {
    ($($test:ident),* $(,)?) => {
        mod data_directory {
            $(#[tokio::test] async fn $test() {
                super::$test().await;
            })*
        }
        mod common_store {
            $(#[tokio::test] async fn $test() {
                crate::registry::with_common_store(super::$test()).await;
            })*
        }
    };
}
pub(crate) use on_both_stores;

async fn open_blobs(store: &Store, data: &Path, settings: BlobSettings) -> Blobs {
    if HAS_COMMON_STORE.try_with(|()| ()).is_err() {
        return Blobs::open(data, settings).expect("a blob store");
    }
    let directory = data.join("common");
    std::fs::create_dir(&directory).expect("made");
    let url = BlobStoreUrl::Directory(directory);
    let common = CommonStore::open(store.clone(), &url).await.expect("a common store");
    let settings = BlobSettings { max_cache_bytes: 0, ..settings };
    Blobs::open_with(data, settings, common).expect("a blob store")
}

/// Serves a registry to one caller and says where.
pub async fn serve(registry: Registry, caller: Option<Caller>) -> String {
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

pub fn client() -> Client {
    // Another test may have installed the provider before.
    let _ = rustls::crypto::ring::default_provider().install_default();
    Client::new()
}

pub async fn let_in(
    axum::extract::State(caller): axum::extract::State<Option<Caller>>,
    mut request: Request,
) -> Request {
    if let Some(caller) = caller {
        request.extensions_mut().insert(caller);
    }
    request
}

pub fn operator() -> Caller {
    Caller::Person(Person::first(OPERATOR.id().parse().expect("an id")))
}

fn described(kind: &str, blob: BlobRef) -> Value {
    json!({ "mediaType": kind, "digest": blob.digest, "size": blob.size })
}

pub fn image(config: BlobRef, layer: BlobRef) -> Value {
    json!({
        "schemaVersion": 2,
        "mediaType": MANIFEST_TYPE,
        "config": described("application/vnd.example.config", config),
        "layers": [described("application/vnd.example.layer", layer)],
    })
}

pub fn header(answer: &Response, name: &str) -> String {
    answer
        .headers()
        .get(name)
        .unwrap_or_else(|| panic!("no {name}"))
        .to_str()
        .expect("text")
        .to_owned()
}

/// The answer's status and its first error code.
pub async fn refusal(answer: Response) -> (u16, String) {
    let status = answer.status().as_u16();
    let body: Value = answer.json().await.expect("an error body");
    (status, body["errors"][0]["code"].as_str().expect("a code").to_owned())
}

pub fn refused(status: u16, code: &str) -> (u16, String) {
    (status, code.to_owned())
}
