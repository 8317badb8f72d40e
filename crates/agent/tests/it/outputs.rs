//! Uploading outputs, to a server that is no registry and from under a task that goes on writing.
//! The tests of the whole system cover the upload to a real registry.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::sync::{Arc, Mutex};

use axum::Router;
use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::response::Response;
use http::Method;
use task_agent::telemetry::outputs::{OutputError, OutputSpec, Registry, upload};
use task_proto::Digest;
use task_proto::messages::report::Progress;
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// A run that has left `map.pgm`.
struct Left {
    dir: TempDir,
    spec: OutputSpec,
}

impl Left {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let spec = OutputSpec {
            robot_id: "r0123456789abcdef".parse().unwrap(),
            task: "mapper".parse().unwrap(),
            version: "1.0.0".parse().unwrap(),
            deployment: "d0123456789abcdef".parse().unwrap(),
            run: 1,
            directory: dir.path().join("run"),
            user: None,
            patterns: vec!["map.pgm".to_owned()],
            notes: dir.path().join("uploads.json"),
            max_bytes: 1 << 20,
        };
        std::fs::create_dir(&spec.directory).unwrap();
        let left = Self { dir, spec };
        std::fs::write(left.map(), "the whole map").unwrap();
        left
    }

    fn map(&self) -> PathBuf {
        self.dir.path().join("run/map.pgm")
    }

    async fn bring_to(&self, router: Router) -> Result<usize, OutputError> {
        let _ = rustls::crypto::ring::default_provider().install_default();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let base = format!("http://{}", listener.local_addr().unwrap()).parse().unwrap();
        tokio::spawn(async move { axum::serve(listener, router).await });
        let client =
            reqwest::Client::builder().no_proxy().redirect(reqwest::redirect::Policy::none());
        let registry = Registry::new(client.build().unwrap(), base, "token".to_owned());
        let progress = watch::Sender::new(Progress { done: 0, total: 0 });
        upload(&registry, &self.spec, &progress, &CancellationToken::new()).await
    }
}

fn answer(status: u16, headers: &[(&str, String)], body: impl Into<Body>) -> Response {
    let response = Response::builder().status(status);
    let response =
        headers.iter().fold(response, |response, (name, value)| response.header(*name, value));
    response.body(body.into()).unwrap()
}

/// An upload has begun, or has gone on.
fn begun() -> Response {
    answer(202, &[("location", "/v2/outputs/blobs/uploads/1".to_owned())], "")
}

fn refusal(status: u16, code: &str) -> Response {
    answer(status, &[], format!(r#"{{"errors":[{{"code":"{code}","message":"no"}}]}}"#))
}

#[tokio::test]
async fn answer_of_another_server_keeps_outputs_for_later() {
    let left = Left::new();
    for status in [200, 201, 202, 302, 403, 404, 405] {
        for kind in ["text/html", "text/plain"] {
            let portal = move || async move {
                let headers =
                    [("content-type", kind.to_owned()), ("location", "/login".to_owned())];
                answer(status, &headers, "please sign in")
            };
            let error = left.bring_to(Router::new().fallback(portal)).await.unwrap_err();
            assert!(
                matches!(error, OutputError::NotTheServer { .. }),
                "{status} {kind}: {error:?}"
            );
            assert!(error.retry_after().is_some(), "{error}");
        }
    }
}

#[tokio::test]
async fn output_received_as_other_bytes_is_sent_again_if_unchanged() {
    // A file in one piece or in parts, and the expected result.
    let bodies = [(1, "its own "), (MANY, "its own "), (1, "{"), (1, "{\"schemaVersion\"")];
    for ((times, garbled), faults) in bodies.into_iter().flat_map(|body| [(body, 2), (body, 1000)])
    {
        let is_brought = faults == 2;
        let left = Left::new();
        std::fs::write(left.map(), "its own ".repeat(times)).unwrap();
        let left = Left { spec: OutputSpec { max_bytes: 1 << 24, ..left.spec.clone() }, ..left };
        let parts = Arc::<Mutex<Vec<u8>>>::default();
        let (faults, listed) = (Arc::new(AtomicU32::new(faults)), Arc::<AtomicU32>::default());
        let garbles =
            move || faults.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(1)).is_ok();
        // A registry that has nothing, and receives another byte in the first of these bodies.
        let registry = move |request: Request| {
            let (garbles, listed, parts) = (garbles.clone(), listed.clone(), parts.clone());
            async move {
                let (method, path) = (request.method().clone(), request.uri().to_string());
                let mut body = to_bytes(request.into_body(), 1 << 24).await.unwrap().to_vec();
                if body.starts_with(garbled.as_bytes()) && garbles() {
                    body[0] ^= 0x10;
                }
                let created =
                    || answer(201, &[("docker-content-digest", Digest::of(&body).to_string())], "");
                match method {
                    Method::POST if path.ends_with("/uploads/") => {
                        parts.lock().unwrap().clear();
                        begun()
                    }
                    Method::PATCH => {
                        parts.lock().unwrap().extend(&body);
                        begun()
                    }
                    Method::PUT if path.contains("/uploads/") => {
                        let whole = Digest::of(&parts.lock().unwrap());
                        let has_come = path.ends_with(&format!("?digest={whole}"));
                        let headers = [("docker-content-digest", whole.to_string())];
                        if has_come {
                            answer(201, &headers, "")
                        } else {
                            refusal(400, "DIGEST_INVALID")
                        }
                    }
                    Method::POST if path.ends_with(&format!("?digest={}", Digest::of(&body))) => {
                        created()
                    }
                    Method::POST => refusal(400, "DIGEST_INVALID"),
                    Method::PUT if serde_json::from_slice::<serde_json::Value>(&body).is_err() => {
                        refusal(400, "MANIFEST_INVALID")
                    }
                    Method::PUT if listed.fetch_add(1, Relaxed) > 0 => created(),
                    _ => refusal(404, "MANIFEST_BLOB_UNKNOWN"),
                }
            }
        };
        let brought = left.bring_to(Router::new().fallback(registry)).await;
        match brought {
            Ok(count) => assert_eq!((count, is_brought), (1, true)),
            Err(error) => {
                assert!(!is_brought && matches!(error, OutputError::Corrupted { .. }), "{error:?}");
                assert!(error.retry_after().is_some(), "{error}");
            }
        }
    }
}

#[tokio::test]
async fn output_changed_during_upload_is_uploaded_later() {
    let left = Left::new();
    let map = left.map();
    // An empty registry; between the query of its content and the upload, the task writes once
    // more.
    let registry = move |request: Request| {
        let map = map.clone();
        async move {
            let (method, path) = (request.method().clone(), request.uri().to_string());
            let body = to_bytes(request.into_body(), 1 << 20).await.unwrap();
            let created =
                || answer(201, &[("docker-content-digest", Digest::of(&body).to_string())], "");
            match method {
                Method::HEAD => {
                    std::fs::write(map, "another map..").unwrap();
                    answer(404, &[], "")
                }
                Method::POST if path.ends_with(&format!("?digest={}", Digest::of(&body))) => {
                    created()
                }
                Method::POST => refusal(400, "DIGEST_INVALID"),
                _ => refusal(404, "MANIFEST_BLOB_UNKNOWN"),
            }
        }
    };
    let error = left.bring_to(Router::new().fallback(registry)).await.unwrap_err();
    assert!(matches!(&error, OutputError::Read { .. }), "{error:?}");
    assert!(error.retry_after().is_some(), "{error}");
}

#[tokio::test]
async fn directory_exchanged_for_a_link_while_files_are_sent_is_not_followed() {
    // A file that is sent in one request is held against its digest before, one that is sent in
    // parts is not.
    for times in [1, MANY] {
        exchange_while_files_are_sent(times).await;
    }
}

/// So often a few bytes are repeated that they are sent in parts.
const MANY: usize = 200_000;

async fn exchange_while_files_are_sent(times: usize) {
    let left = Left::new();
    let root = left.dir.path().to_owned();
    std::fs::create_dir_all(root.join("run/maps")).unwrap();
    std::fs::create_dir(root.join("secrets")).unwrap();
    // Both have the same size.
    std::fs::write(root.join("run/maps/key.pgm"), "its own ".repeat(times)).unwrap();
    std::fs::write(root.join("secrets/key.pgm"), "a secret".repeat(times)).unwrap();
    let spec = OutputSpec {
        patterns: vec!["maps/*.pgm".to_owned()],
        max_bytes: 1 << 24,
        ..left.spec.clone()
    };
    let left = Left { spec, ..left };
    let (told, mut sent) = tokio::sync::mpsc::unbounded_channel();
    let registry = move |request: Request| {
        let (root, told) = (root.clone(), told.clone());
        async move {
            let (method, path) = (request.method().clone(), request.uri().to_string());
            let body = to_bytes(request.into_body(), 1 << 24).await.unwrap();
            told.send(body.clone()).unwrap();
            match method {
                Method::POST if path.ends_with("/uploads/") => begun(),
                Method::PATCH => begun(),
                Method::HEAD => {
                    std::fs::rename(root.join("run/maps"), root.join("run/moved")).unwrap();
                    std::os::unix::fs::symlink(root.join("secrets"), root.join("run/maps"))
                        .unwrap();
                    answer(404, &[], "")
                }
                Method::POST => {
                    answer(201, &[("docker-content-digest", Digest::of(&body).to_string())], "")
                }
                _ => refusal(404, "MANIFEST_BLOB_UNKNOWN"),
            }
        }
    };
    let error = left.bring_to(Router::new().fallback(registry)).await.unwrap_err();
    while let Ok(body) = sent.try_recv() {
        assert!(!String::from_utf8_lossy(&body).contains("a secret"), "the link was followed");
    }
    assert!(matches!(&error, OutputError::Read { .. }), "{error:?}");
}
