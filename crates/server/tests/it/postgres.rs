//! An unreachable Postgres: the server waits for the database at start, and tells all clients so
//! while serving.

#![expect(clippy::disallowed_methods, reason = "the test starts and stops a database server")]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use task_proto::report::Phase;
use task_proto::topic::RobotTopic;
use tempfile::TempDir;

use crate::harness::{TestServer, answer};
use crate::mqtt_harness::{Connect, Raw, publish, topic};

const PATIENCE: Duration = Duration::from_secs(30);

/// A Postgres of the test's own, which may be stopped and started.
struct Postgres {
    directory: TempDir,
    port: u16,
}

/// The newest there is.
fn program(name: &str) -> PathBuf {
    let versions = std::fs::read_dir("/usr/lib/postgresql")
        .expect("Postgres is installed: run ./scripts/test");
    let version =
        |path: &PathBuf| path.file_name().and_then(|name| name.to_str()?.parse::<u32>().ok());
    let newest =
        versions.flatten().map(|entry| entry.path()).max_by_key(version).expect("a version");
    newest.join("bin").join(name)
}

/// Runs the program as the account of Postgres, which refuses to run as root.
fn run(program: &Path, arguments: &[&str]) -> bool {
    let is_root = nix::unistd::geteuid().is_root();
    let mut command = Command::new(if is_root { Path::new("setpriv") } else { program });
    if is_root {
        command.args(["--reuid", "postgres", "--regid", "postgres", "--init-groups"]).arg(program);
    }
    command.args(arguments).current_dir("/").stdin(Stdio::null()).stdout(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

impl Postgres {
    fn create() -> Self {
        let directory = TempDir::new().expect("a directory");
        if nix::unistd::geteuid().is_root() {
            let postgres = nix::unistd::User::from_name("postgres")
                .expect("known")
                .expect("Postgres has an account");
            nix::unistd::chown(directory.path(), Some(postgres.uid), Some(postgres.gid))
                .expect("given away");
        }
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = listener.local_addr().expect("bound").port();
        let created = Self { directory, port };
        let arguments =
            ["-D", &created.data(), "-U", "postgres", "-A", "trust", "--no-sync", "-E", "UTF8"];
        assert!(run(&program("initdb"), &arguments), "initdb fails");
        created
    }

    fn data(&self) -> String {
        self.directory.path().join("data").to_str().expect("text").to_owned()
    }

    fn start(&self) {
        let options = format!(
            "-c listen_addresses=127.0.0.1 -c port={} -c unix_socket_directories= -c fsync=off",
            self.port
        );
        let log = self.directory.path().join("log").to_str().expect("text").to_owned();
        let arguments = ["-D", &self.data(), "-s", "-w", "-l", &log, "-o", &options, "start"];
        assert!(
            run(&program("pg_ctl"), &arguments),
            "it does not start: {}",
            std::fs::read_to_string(&log).unwrap()
        );
    }

    fn stop(&self) -> bool {
        run(&program("pg_ctl"), &["-D", &self.data(), "-s", "-w", "-m", "fast", "stop"])
    }

    fn url(&self) -> String {
        format!("postgres://postgres@127.0.0.1:{}/postgres", self.port)
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        if Path::new(&self.data()).join("postmaster.pid").exists() {
            self.stop();
        }
    }
}

async fn server_at(postgres: &Postgres) -> TestServer {
    let directory = TempDir::new().expect("a directory");
    TestServer::start_in(directory, |config| config.database = Some(postgres.url())).await
}

async fn eventually(what: &str, mut is_so: impl AsyncFnMut() -> bool) {
    let wait = async { while !is_so().await {} };
    tokio::time::timeout(PATIENCE, wait).await.unwrap_or_else(|_| panic!("{what}"));
}

/// The state of the database in `/readyz`.
async fn database(server: &TestServer) -> (StatusCode, String) {
    let response = server.bare(Method::GET, "/readyz").send().await.expect("an answer");
    let (status, body) = (response.status(), response.json::<Value>().await.expect("json"));
    (status, body["database"].as_str().unwrap_or_default().to_owned())
}

/// Every client is told that the server is at fault, and when to ask again.
async fn assert_away(server: &TestServer) {
    let request = |method: Method, path: &str| server.request(method, path);
    for (what, request) in [
        ("list", request(Method::GET, "/api/v1/robots")),
        ("order", server.order("/api/v1/tasks/talker/stop", "key-2", &json!({ "selector": "*" }))),
        ("status", request(Method::GET, "/api/v1/server/status")),
        (
            "sign-in",
            server
                .bare(Method::POST, "/api/v1/login")
                .json(&json!({ "user": "a", "password": "b" })),
        ),
        ("blob", request(Method::GET, "/v2/talker/tags/list")),
    ] {
        let response = request.send().await.expect("an answer");
        assert_eq!(response.status(), StatusCode::SERVICE_UNAVAILABLE, "{what}");
        assert!(response.headers().contains_key("retry-after"), "{what}");
        let body: Value = response.json().await.expect("json");
        let code = body.pointer("/error/code").or(body.pointer("/errors/0/code"));
        let code = code.and_then(Value::as_str).expect("a code").to_lowercase();
        assert_eq!(code, "unavailable", "{what}: {body}");
    }
    let healthz = server.bare(Method::GET, "/healthz").send().await.expect("an answer");
    assert_eq!(healthz.status(), StatusCode::OK);
    eventually("/readyz says it", async || {
        let (status, database) = database(server).await;
        status == StatusCode::SERVICE_UNAVAILABLE && database == "it does not answer"
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn server_waits_for_a_database_that_is_away_at_start() {
    let postgres = Postgres::create();
    let server = server_at(&postgres).await;
    assert_away(&server).await;
    postgres.start();
    eventually("it serves", async || {
        server
            .request(Method::GET, "/api/v1/robots")
            .send()
            .await
            .is_ok_and(|response| response.status().is_success())
    })
    .await;
    server.enroll("atlas").await;
    eventually("/readyz says so", async || database(&server).await.0 == StatusCode::OK).await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn stop_ends_a_server_that_waits_for_its_database() {
    let server = server_at(&Postgres::create()).await;
    tokio::time::timeout(Duration::from_secs(10), server.stop()).await.expect("in time");
}

#[tokio::test(flavor = "multi_thread")]
async fn database_that_is_restarted_costs_no_session_and_no_report() {
    let postgres = Postgres::create();
    postgres.start();
    let server = server_at(&postgres).await;
    let mut robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "*", "key-1").await;
    let state = server.desired(&robot).await;
    let address: std::net::SocketAddr = server.server.addresses().mqtt.parse().expect("an address");
    let stream = tokio::net::TcpStream::connect(address).await.expect("connects");
    let mut session = Raw { stream };
    let login = Connect { password: Some(robot.token.clone()), ..Connect::robot(&robot.id) };
    session.send(&login.packet()).await;
    session.expect(&[0x20, 2, 0, 0]).await;

    assert!(postgres.stop(), "it does not stop");
    assert_away(&server).await;
    session.expect_nothing().await;
    let response = server.report(&mut robot, &state, Phase::Starting).await;
    assert_eq!(response.status(), StatusCode::SERVICE_UNAVAILABLE, "it is not acknowledged");
    let report = serde_json::to_vec(&robot.next_report(&state, Phase::Running)).expect("json");
    session.send(&publish(&topic(&robot.id, RobotTopic::Report), 1, 9, &report)).await;
    postgres.start();
    // The same session, whose report is acknowledged when it is stored.
    session.expect(&[0x40, 2, 0, 9]).await;
    assert_eq!(server.robot(&robot).await.tasks[0].phase, Phase::Running);
    eventually("/readyz says so", async || database(&server).await.0 == StatusCode::OK).await;
    let stopped: Value =
        answer(server.order("/api/v1/tasks/talker/stop", "key-3", &json!({ "selector": "*" })))
            .await;
    assert!(stopped.is_object());
    server.stop().await;
}
