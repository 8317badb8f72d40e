//! A server with a full disk: operations that need room are refused with that reason, everything
//! else goes on, also over a restart.

use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};
use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};
use task_proto::Digest;
use task_proto::messages::report::Phase;
use taskd::config::Config;
use taskd::serve::Server;
use taskd::system::clock::Clock;
use tempfile::TempDir;

use crate::harness::{TestRobot, TestServer, answer};

/// Runs the test on a file system of this size that only its threads see. That takes root.
fn on_small_disk(size: &str, test: impl AsyncFnOnce(TempDir) + Send) {
    let enter = |path: &Path| {
        unshare(CloneFlags::CLONE_NEWNS)?;
        mount(
            None::<&str>,
            "/",
            None::<&str>,
            MsFlags::MS_REC | MsFlags::MS_PRIVATE,
            None::<&str>,
        )?;
        mount(
            Some("tmpfs"),
            path,
            Some("tmpfs"),
            MsFlags::empty(),
            Some(format!("size={size}").as_str()),
        )
    };
    // File systems mounted on it vanish with the threads that see them.
    let place = TempDir::new().expect("a directory");
    std::thread::scope(|scope| {
        let running = scope.spawn(|| {
            enter(place.path()).expect("root, which may mount");
            let directory = TempDir::new_in(place.path()).expect("a directory");
            let runtime = tokio::runtime::Builder::new_multi_thread()
                .enable_all()
                .build()
                .expect("a runtime");
            runtime.block_on(test(directory));
        });
        running.join().expect("the test passes");
    });
}

/// Takes all room there is, to the last byte.
fn fill(directory: &Path) -> PathBuf {
    let path = directory.join("filler");
    let mut file = File::options().create(true).append(true).open(&path).expect("created");
    for size in [1 << 16, 1 << 12, 1] {
        while file.write_all(&vec![1; size]).is_ok() {}
    }
    path
}

async fn status_of(request: RequestBuilder) -> (StatusCode, Value) {
    let response = request.send().await.expect("an answer");
    (response.status(), response.json().await.unwrap_or_default())
}

/// Asks until there is no room any more: the write-ahead log has some left when the disk is full.
async fn use_up(server: &TestServer) {
    for number in 0..5000 {
        let labels = json!({ "labels": { "number": number.to_string() } });
        match status_of(server.request(Method::PATCH, "/api/v1/robots/atlas").json(&labels)).await {
            (StatusCode::OK, _) => {}
            (StatusCode::INSUFFICIENT_STORAGE, body) => {
                return assert_eq!(body["error"]["code"], "disk_full");
            }
            other => panic!("{other:?}"),
        }
    }
    panic!("the disk is not full");
}

/// Every write is refused for lack of room, and every read is answered.
async fn assert_reads_only(server: &TestServer, robot: &mut TestRobot) {
    let content = vec![7; 1 << 16];
    let digest = Digest::of(&content);
    let request = |method: Method, path: &str| server.request(method, path);
    for (what, request) in [
        ("order", server.order("/api/v1/tasks/talker/stop", "key-2", &json!({ "selector": "*" }))),
        (
            "labels",
            request(Method::PATCH, "/api/v1/robots/atlas")
                .json(&json!({ "labels": { "site": "a" } })),
        ),
        ("token", request(Method::POST, "/api/v1/enrollment-tokens").json(&json!({}))),
        (
            "sign-in",
            server
                .bare(Method::POST, "/api/v1/login")
                .json(&json!({ "user": "eve", "password": PASSWORD })),
        ),
        (
            "session",
            server
                .bare(Method::POST, "/api/v1/session")
                .json(&json!({ "user": "eve", "password": PASSWORD })),
        ),
        ("revoke", request(Method::POST, "/api/v1/robots/atlas/revoke")),
    ] {
        let (status, body) = status_of(request).await;
        assert_eq!(
            (status.as_u16(), &body["error"]["code"]),
            (507, &json!("disk_full")),
            "{what}: {body}"
        );
    }
    let upload =
        request(Method::POST, &format!("/v2/talker/blobs/uploads/?digest={digest}")).body(content);
    let (status, body) = status_of(upload.header("content-type", "application/octet-stream")).await;
    assert_eq!((status.as_u16(), &body["errors"][0]["code"]), (507, &json!("DENIED")), "{body}");
    let state = server.desired(robot).await;
    let response = server.report(robot, &state, Phase::Running).await;
    assert_eq!(response.status(), 507, "a report that is not stored is not acknowledged");
    for path in
        ["/api/v1/robots", "/api/v1/deployments", "/api/v1/packages", "/api/v1/server/status"]
    {
        answer::<Value>(request(Method::GET, path)).await;
    }
    let (status, body) = status_of(server.bare(Method::GET, "/readyz")).await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{body}");
    assert!(body["disk"].as_str().is_some_and(|disk| disk.contains("full")), "{body}");
}

const PASSWORD: &str = "correct horse battery";

/// A server with a robot, a package, an order and a user.
async fn furnished(directory: TempDir) -> (TestServer, TestRobot) {
    let server = TestServer::start_in(directory, |_| {}).await;
    let robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "*", "key-1").await;
    // Its first use of the token is written.
    server.desired(&robot).await;
    let user = json!({ "name": "eve", "roles": ["operator"], "password": PASSWORD });
    let added =
        server.request(Method::POST, "/api/v1/users").json(&user).send().await.expect("an answer");
    assert!(added.status().is_success(), "{}", added.text().await.unwrap_or_default());
    (server, robot)
}

async fn until_full(server: &TestServer) {
    let full = async {
        loop {
            let (_, body) = status_of(server.bare(Method::GET, "/readyz")).await;
            if body["disk"].as_str().is_some_and(|disk| disk.contains("full")) {
                return;
            }
        }
    };
    tokio::time::timeout(std::time::Duration::from_secs(30), full).await.expect("/readyz says it");
}

#[test]
fn full_disk_refuses_writes_and_serves_reads() {
    on_small_disk("24m", async |directory| {
        let (server, mut robot) = furnished(directory).await;
        let filler = fill(server.directory.path());
        use_up(&server).await;
        until_full(&server).await;
        assert_reads_only(&server, &mut robot).await;
        std::fs::remove_file(filler).expect("removed");
        let state = server.desired(&robot).await;
        assert_eq!(
            server.report(&mut robot, &state, Phase::Running).await.status(),
            StatusCode::OK
        );
        server.stop().await;
    });
}

#[test]
fn server_starts_on_a_full_disk_and_serves_reads() {
    on_small_disk("24m", async |directory| {
        let (server, mut robot) = furnished(directory).await;
        let directory = server.stop().await;
        let filler = fill(directory.path());
        let server = TestServer::start_in(directory, |_| {}).await;
        assert_reads_only(&server, &mut robot).await;
        std::fs::remove_file(filler).expect("removed");
        let state = server.desired(&robot).await;
        assert_eq!(
            server.report(&mut robot, &state, Phase::Running).await.status(),
            StatusCode::OK
        );
        let directory = server.stop().await;
        // The next start is one as any other: other programs may read the database again.
        let server = TestServer::start_in(directory, |_| {}).await;
        assert!(server.data().join("taskd.sqlite-shm").exists());
        server.stop().await;
    });
}

#[test]
fn first_start_on_a_full_disk_names_the_needed_space() {
    on_small_disk("8m", async |directory| {
        fill(directory.path());
        let mut config = Config::with_data(directory.path().join("data"));
        config.http.set_port(0);
        config.mqtt.set_port(0);
        let refused =
            Server::start(config, Clock::system()).await.err().expect("refused").to_string();
        assert!(refused.contains("/data/") && refused.contains("free at least 16 MB"), "{refused}");
    });
}
