//! A cluster of real servers on one Postgres, of which a robot knows one: the other answers for it,
//! by passing requests on, and counts it in its figures.

#![expect(clippy::disallowed_methods, reason = "making a test's database takes SQL")]

use std::net::{SocketAddr, TcpListener};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use sqlx::Connection as _;
use task_proto::Digest;
use task_proto::api::{NodeList, NodeState, NodeView, ServerStatus, SessionList};
use task_proto::ids::NodeName;
use task_proto::messages::report::Phase;
use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt as _, BufReader};

use crate::harness::{Robot, Server, TIMEOUT, eventually, program, required, write_package};

/// Time in which a silent server is noticed, on a busy machine.
const SILENCE: Duration = Duration::from_secs(10);

/// A database, and the keys of its servers.
struct Cluster {
    directory: TempDir,
    database: String,
}

impl Cluster {
    async fn new() -> Self {
        sqlx::any::install_default_drivers();
        let server = required("TASKD_TEST_POSTGRES");
        let name = format!("taskd_test_{:016x}", rand::random::<u64>());
        let mut connection =
            sqlx::AnyConnection::connect(&format!("{server}/postgres")).await.expect("connects");
        let sql = sqlx::AssertSqlSafe(format!("CREATE DATABASE {name}"));
        sqlx::query(sql).execute(&mut connection).await.expect("created");
        let cluster = Self {
            directory: TempDir::new().expect("a directory"),
            database: format!("{server}/{name}"),
        };
        std::fs::create_dir(cluster.path("packages")).expect("a directory");
        cluster.export_keys().await;
        cluster
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// The keys of a server that has served alone.
    async fn export_keys(&self) {
        let mut single = Server::start(&self.path("single")).await;
        let data = single.data().display().to_string();
        let secrets = self.path("secrets").display().to_string();
        single.operate(["cluster", "export", &secrets, "--data", &data]).await;
        let again = single.try_operate(["cluster", "export", &secrets, "--data", &data]).await;
        let message = String::from_utf8_lossy(&again.stderr).into_owned();
        assert!(message.contains("never overwritten"), "{message}");
        assert_eq!(single.terminate(), Some(0));
    }

    async fn start(&self, name: &str) -> Server {
        let data = self.path(name);
        std::fs::create_dir(&data).expect("a directory");
        // For the commands of the test.
        let token = self.path("secrets").join("operator.token");
        std::fs::copy(token, data.join("operator.token")).expect("copied");
        let (http, mqtt) = (free_address(), free_address());
        let (url, secrets) = (format!("http://{http}"), self.path("secrets"));
        let packages = format!("file://{}", self.path("packages").display());
        let settings = [
            ("TASKD_DATABASE", self.database.as_str()),
            ("TASKD_BLOBS_STORE", &packages),
            ("TASKD_CLUSTER_NAME", name),
            ("TASKD_CLUSTER_URL", &url),
            ("TASKD_CLUSTER_SECRETS", secrets.to_str().expect("text")),
            ("TASKD_DRAIN", "1s"),
        ];
        Server::start_at(&data, &settings, http, mqtt).await
    }

    /// Two servers that know each other, and a robot at the first.
    async fn with_robot() -> (Self, Server, Server, Robot) {
        let cluster = Self::new().await;
        let one = cluster.start("one").await;
        let two = cluster.start("two").await;
        let robot = Robot::start(&one, cluster.directory.path(), "robot-1", 1).await;
        eventually("both servers to know the robot's session", async || {
            (robot_is_online(&one).await && robot_is_online(&two).await).then_some(())
        })
        .await;
        (cluster, one, two, robot)
    }
}

/// An address that was free a moment ago. A server of a cluster has to know its own URL.
fn free_address() -> SocketAddr {
    let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a free port");
    listener.local_addr().expect("bound")
}

async fn robot_is_online(server: &Server) -> bool {
    server.robot("robot-1").await.is_some_and(|robot| robot.online && robot.mqtt.is_some())
}

async fn nodes(server: &Server) -> Vec<NodeView> {
    let list = server.get("/api/v1/cluster/nodes").await.expect("an answer");
    serde_json::from_value::<NodeList>(list).expect("a list").nodes
}

async fn status(server: &Server) -> ServerStatus {
    let status = server.get("/api/v1/server/status").await.expect("an answer");
    serde_json::from_value(status).expect("a status")
}

/// The status and the code of an answer.
async fn answer(request: reqwest::RequestBuilder) -> (StatusCode, Value) {
    let response = request.send().await.expect("an answer");
    let status = response.status();
    (status, response.json().await.unwrap_or_default())
}

#[tokio::test(flavor = "multi_thread")]
async fn question_goes_to_the_server_with_the_robots_session() {
    let (_cluster, one, two, _robot) = Cluster::with_robot().await;
    let ask = |server: &Server| {
        let path = "/api/v1/robots/robot-1/ask";
        server.request(Method::POST, path).json(&json!({ "type": "vitals" }))
    };
    let (status, vitals) = answer(ask(&two)).await;
    assert_eq!((status, &vitals["type"]), (StatusCode::OK, &"vitals".into()), "{vitals}");
    // Both parts are in the memory of the other server.
    let robot = two.robot("robot-1").await.expect("a robot");
    assert!(robot.mqtt.is_some() && robot.vitals.is_some(), "{robot:?}");
    let shown = two.get("/api/v1/robots/robot-1/vitals").await.expect("an answer");
    assert!(!shown["samples"].as_array().expect("a list").is_empty(), "{shown}");
    let listed = two.get("/api/v1/robots?limit=10").await.expect("an answer");
    assert!(listed["robots"][0]["vitals"].is_object(), "{listed}");

    // A request is passed on once.
    let (status, refused) = answer(ask(&two).header("taskd-forwarded", "1")).await;
    assert_eq!(status, StatusCode::CONFLICT);
    assert_eq!(refused["error"]["code"], "robot_offline", "{refused}");
    // Rights are checked here, before another server is asked.
    let unknown = two.request(Method::POST, "/api/v1/robots/robot-2/ask");
    assert_eq!(answer(unknown.json(&json!({ "type": "vitals" }))).await.0, StatusCode::NOT_FOUND);

    one.signal(Signal::SIGSTOP);
    let asked = Instant::now();
    let (status, refused) = answer(ask(&two)).await;
    let elapsed = asked.elapsed();
    one.signal(Signal::SIGCONT);
    assert_eq!(status, StatusCode::CONFLICT, "{refused}");
    assert_eq!(refused["error"]["code"], "robot_offline", "{refused}");
    assert!(elapsed < SILENCE, "{elapsed:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn logs_stream_through_another_server() {
    let (cluster, one, two, _robot) = Cluster::with_robot().await;
    let package = cluster.path("ticker");
    write_package(
        &package,
        "ticker",
        "1.0.0",
        "service",
        "while :; do echo tick; sleep 0.1; done\n",
    );
    one.push(&package, "*").await;
    one.wait_phase("robot-1", "ticker", Phase::Running).await;
    let mut command = tokio::process::Command::from(two.command(["logs", "-f", "robot-1"]));
    let mut follower =
        command.stdout(Stdio::piped()).kill_on_drop(true).spawn().expect("taskd runs");
    let mut lines = BufReader::new(follower.stdout.take().expect("piped")).lines();
    for _ in 0..3 {
        let line = tokio::time::timeout(TIMEOUT, lines.next_line()).await.expect("in time");
        let line = line.expect("readable").expect("a line");
        assert!(line.contains("tick"), "{line}");
    }
    let recent = two.operate(["logs", "robot-1", "-o", "json"]).await;
    let recent: Value = serde_json::from_str(&recent).expect("json");
    assert_eq!(recent["from"], "robot", "{recent}");
}

#[tokio::test(flavor = "multi_thread")]
async fn figures_are_those_of_all_servers() {
    let (_cluster, mut one, two, _robot) = Cluster::with_robot().await;
    let seen = status(&two).await;
    let names: Vec<_> = seen.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(names, ["one", "two"]);
    assert!(seen.nodes.iter().all(|node| node.state == NodeState::Serving), "{:?}", seen.nodes);
    assert_eq!(seen.nodes.iter().map(|node| node.answers).collect::<Vec<_>>(), [false, true]);
    assert_eq!((seen.robots.online, seen.mqtt.robots_connected), (1, 1));
    let own = seen.nodes[1].figures.expect("its own");
    assert_eq!(own.mqtt.robots_connected, 0, "the robot is at the other");
    let sessions = eventually("the session to be listed", async || {
        let sessions = two.get("/api/v1/server/sessions").await?;
        let sessions: SessionList = serde_json::from_value(sessions).expect("a list");
        (sessions.total == 1).then_some(sessions)
    })
    .await;
    assert!(!sessions.sessions[0].subscriptions.is_empty(), "{sessions:?}");
    assert!(sessions.sessions[0].traffic.messages_in > 0, "{sessions:?}");
    assert_eq!(sessions.sessions[0].node.as_ref().map(NodeName::as_str), Some("one"));

    one.kill();
    let asked = Instant::now();
    let seen = nodes(&two).await;
    assert!(asked.elapsed() < SILENCE, "{:?}", asked.elapsed());
    assert!(matches!(seen[0].state, NodeState::Silent | NodeState::Lost), "{seen:?}");
    assert!(seen[0].figures.is_none() && seen[1].state == NodeState::Serving, "{seen:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn upload_begun_at_one_server_continues_at_another() {
    let cluster = Cluster::new().await;
    let mut one = cluster.start("one").await;
    let two = cluster.start("two").await;
    eventually("the servers to know each other", async || {
        let seen = nodes(&two).await;
        (seen.len() == 2 && seen.iter().all(|node| node.state == NodeState::Serving)).then_some(())
    })
    .await;
    let begin = async || {
        let begun = one.request(Method::POST, "/v2/talker/blobs/uploads/").send().await;
        let begun = begun.expect("an answer");
        assert_eq!(begun.status(), StatusCode::ACCEPTED);
        begun.headers()["location"].to_str().expect("text").to_owned()
    };
    let (location, left) = (begin().await, begin().await);
    let (first, second) = (vec![7; 300_000], vec![8; 200_000]);
    let digest = Digest::of(&[first.clone(), second.clone()].concat());
    let appended = two.request(Method::PATCH, &location).body(first).send().await;
    let appended = appended.expect("an answer");
    assert_eq!(appended.status(), StatusCode::ACCEPTED);
    assert_eq!(appended.headers()["range"], "0-299999");
    let finished = two
        .request(Method::PUT, &format!("{location}?digest={digest}"))
        .body(second)
        .send()
        .await
        .expect("an answer");
    assert_eq!(finished.status(), StatusCode::CREATED);
    let blob = one.request(Method::GET, &format!("/v2/talker/blobs/{digest}")).send().await;
    let blob = blob.expect("an answer").bytes().await.expect("a body");
    assert_eq!(Digest::of(&blob), digest);

    // With the digits of no server, and of one that is gone.
    let (path, id) = left.rsplit_once('/').expect("a path");
    let nowhere = format!("{path}/{}", id.replace(&id[..8], "00000000"));
    one.kill();
    for location in [nowhere, left] {
        let request = two.request(Method::PATCH, &location).body("more");
        let (status, refused) = answer(request).await;
        assert_eq!(status, StatusCode::NOT_FOUND, "{refused}");
        assert_eq!(refused["errors"][0]["code"], "BLOB_UPLOAD_UNKNOWN", "{refused}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn servers_question_without_the_clusters_proof_is_refused() {
    let cluster = Cluster::new().await;
    let one = cluster.start("one").await;
    let question = json!({ "robots": [] });
    for path in ["/peer/status", "/peer/sessions", "/peer/figures"] {
        let request = one.request(Method::POST, path).json(&question);
        assert_eq!(answer(request).await.0, StatusCode::FORBIDDEN, "an administrator's token");
        let forged = format!("{} {}", Digest::of(b"{}").hex(), "0".repeat(64));
        let request = reqwest::Client::new().post(one.url(path)).header("taskd-peer", forged);
        assert_eq!(answer(request.json(&question)).await.0, StatusCode::UNAUTHORIZED);
    }
    // The address of a client counts only with its proof.
    let order = json!({ "name": "eve", "roles": ["viewer"] });
    let forged = format!("192.0.2.7 {}", "0".repeat(64));
    let request = one.request(Method::POST, "/api/v1/users").header("taskd-client", forged);
    assert_eq!(answer(request.json(&order)).await.0, StatusCode::CREATED);
    let audit = one.operate(["audit", "-o", "json"]).await;
    assert!(audit.contains("127.0.0.1") && !audit.contains("192.0.2.7"), "{audit}");
}

#[tokio::test(flavor = "multi_thread")]
async fn drained_server_is_not_ready_and_ends_its_robots_sessions() {
    let (_cluster, one, two, _robot) = Cluster::with_robot().await;
    let before = one.robot("robot-1").await.expect("a robot").mqtt.expect("a session").since_ms;
    two.operate(["cluster", "drain", "one"]).await;
    assert_eq!(one.readiness().await.expect("an answer")["status"], "draining");
    assert_eq!(two.readiness().await.expect("an answer")["status"], "ready");
    let listed = two.operate(["cluster", "nodes"]).await;
    assert!(listed.contains("draining") && listed.contains("serving, answers"), "{listed}");
    // The robot knows this server only, so it comes back.
    eventually("the session to end", async || {
        let session = one.robot("robot-1").await?.mqtt?;
        (session.since_ms > before).then_some(())
    })
    .await;
    let audit = two.operate(["audit", "-o", "json"]).await;
    assert!(audit.contains("server.drain"), "{audit}");
    let unknown = two.try_operate(["cluster", "drain", "three"]).await;
    let message = String::from_utf8_lossy(&unknown.stderr).into_owned();
    assert!(message.contains("no server three lives in this cluster"), "{message}");
}

#[tokio::test]
async fn examples_are_accepted_by_their_programs() {
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
    let python = PathBuf::from(required("TASKD_TEST_ROS")).join("bin/python");
    let mut check = Command::new(format!("{root}/examples/cluster/check"));
    check.arg(program("taskd")).env("PYTHON", python).stdin(Stdio::null());
    let output = check.output().expect("it runs");
    let (out, error) =
        (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}{error}");
    assert_eq!(out.lines().filter(|line| line.contains(": accepted by ")).count(), 4, "{out}");
    assert!(out.contains("its variables are accepted by taskd"), "{out}");
}
