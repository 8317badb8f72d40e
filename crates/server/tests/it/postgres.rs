//! An unreachable Postgres: the server waits for the database at start, and tells all clients so
//! while serving.

use std::net::SocketAddr;
use std::time::Duration;

use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use task_proto::messages::report::Phase;
use task_proto::messages::topic::RobotTopic;
use tempfile::TempDir;
use tokio::io::AsyncReadExt as _;
use tokio::net::{TcpListener, TcpStream};

use crate::harness::{TestRobot, TestServer, answer};
use crate::mqtt_harness::{Connect, Raw, publish, topic};
use crate::postgres_cluster::Postgres;
use crate::{database, postgres_cluster};

const PATIENCE: Duration = Duration::from_secs(30);

async fn server_at(postgres: &Postgres) -> TestServer {
    let directory = TempDir::new().expect("a directory");
    TestServer::start_in(directory, |config| config.database = Some(postgres.url())).await
}

/// A robot's MQTT session.
async fn session_of(server: &TestServer, robot: &TestRobot) -> Raw<TcpStream> {
    let address: SocketAddr = server.server.addresses().mqtt.parse().expect("an address");
    let mut session = Raw { stream: TcpStream::connect(address).await.expect("connects") };
    let login = Connect { password: Some(robot.token.clone()), ..Connect::robot(&robot.id) };
    session.send(&login.packet()).await;
    session.expect(&[0x20, 2, 0, 0]).await;
    session
}

pub async fn eventually(what: &str, mut is_so: impl AsyncFnMut() -> bool) {
    let wait = async { while !is_so().await {} };
    tokio::time::timeout(PATIENCE, wait).await.unwrap_or_else(|_| panic!("{what}"));
}

/// The state of the database in `/readyz`.
pub async fn database(server: &TestServer) -> (StatusCode, String) {
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
        status == StatusCode::SERVICE_UNAVAILABLE && database.starts_with("it does not answer")
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn server_waits_for_an_unreachable_database_at_start() {
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

/// A balancer closes each connection for which it has no server.
#[tokio::test(flavor = "multi_thread")]
async fn server_waits_for_a_database_behind_a_balancer() {
    let postgres = Postgres::create();
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("listens");
    let url = postgres_cluster::url(listener.local_addr().expect("an address").port());
    let port = postgres.port;
    tokio::spawn(async move {
        while let Ok((mut client, _)) = listener.accept().await {
            tokio::spawn(async move {
                match TcpStream::connect(("127.0.0.1", port)).await {
                    Ok(mut server) => {
                        let _ = tokio::io::copy_bidirectional(&mut client, &mut server).await;
                    }
                    // A socket that closes with unread bytes would reset the connection.
                    Err(_) => drop(client.read(&mut [0; 64]).await),
                }
            });
        }
    });
    let directory = TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.database = Some(url)).await;
    assert_away(&server).await;
    postgres.start();
    eventually("/readyz says so", async || database(&server).await.0 == StatusCode::OK).await;
    server.enroll("atlas").await;
    assert!(postgres.stop(), "it does not stop");
    assert_away(&server).await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn stop_ends_a_server_waiting_for_its_database() {
    let server = server_at(&Postgres::create()).await;
    tokio::time::timeout(Duration::from_secs(10), server.stop()).await.expect("in time");
}

#[tokio::test(flavor = "multi_thread")]
async fn database_restart_loses_no_session_and_no_report() {
    let postgres = Postgres::create();
    postgres.start();
    let server = server_at(&postgres).await;
    let mut robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "*", "key-1").await;
    let state = server.desired(&robot).await;
    let mut session = session_of(&server, &robot).await;

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

/// As in a failover, which may take more tries than a refused statement gets.
#[tokio::test(flavor = "multi_thread")]
async fn lost_connections_close_no_session_and_lose_no_report() {
    const LOSSES: u32 = 8;
    let database = database::postgres().await;
    let (directory, url) = (TempDir::new().expect("a directory"), database.url.clone());
    let server = TestServer::start_in(directory, |config| config.database = Some(url)).await;
    let mut robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "*", "key-1").await;
    let state = server.desired(&robot).await;
    let mut session = session_of(&server, &robot).await;

    database.lose_connections(LOSSES).await;
    let report = serde_json::to_vec(&robot.next_report(&state, Phase::Running)).expect("json");
    session.send(&publish(&topic(&robot.id, RobotTopic::Report), 1, 9, &report)).await;
    session.expect(&[0x40, 2, 0, 9]).await;
    assert_eq!(server.robot(&robot).await.tasks[0].phase, Phase::Running);
    assert_eq!(database.report_writes().await, i64::from(LOSSES) + 1);
    server.stop().await;
}
