//! A SQLite file with damaged pages: refused at start, detected while served, never written to.

#![expect(clippy::disallowed_methods, reason = "SQLite knows the pages of a table")]

use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use reqwest::Method;
use serde_json::{Value, json};
use sqlx::Connection as _;
use task_proto::api::ServerStatus;
use task_proto::messages::report::Phase;
use taskd::config::Config;
use taskd::serve::Server;
use taskd::store::sqlite_url;
use taskd::system::clock::Clock;
use tempfile::TempDir;

use crate::cli;
use crate::harness::{TestRobot, TestServer, answer, refusal};

/// Time limit for the server to notice damage that is checked in the background.
const PATIENCE: Duration = Duration::from_secs(60);

fn database(data: &Path) -> PathBuf {
    data.join("taskd.sqlite")
}

/// Where the root page of a table or an index begins, and the size of a page.
async fn root_page(data: &Path, name: &str) -> (u64, usize) {
    sqlx::any::install_default_drivers();
    let mut connection = sqlx::AnyConnection::connect(&sqlite_url(&database(data))).await.unwrap();
    let root = sqlx::query_scalar::<_, i64>("SELECT rootpage FROM sqlite_schema WHERE name = $1")
        .bind(name);
    let root: u64 = root.fetch_one(&mut connection).await.unwrap().try_into().unwrap();
    let size: i64 =
        sqlx::query_scalar("PRAGMA page_size").fetch_one(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    let size: usize = size.try_into().unwrap();
    ((root - 1) * size as u64, size)
}

fn file(data: &Path) -> std::fs::File {
    std::fs::File::options().read(true).write(true).open(database(data)).unwrap()
}

/// Inverts the head of a page, which holds the page's type.
fn flip_head((at, _): (u64, usize), data: &Path) {
    let mut head = [0; 16];
    file(data).read_exact_at(&mut head, at).unwrap();
    file(data).write_all_at(&head.map(|byte| !byte), at).unwrap();
}

/// Flips one bit at the end of a text in a page, which stays well formed.
fn flip_text((at, size): (u64, usize), data: &Path, text: &str) {
    let mut page = vec![0; size];
    file(data).read_exact_at(&mut page, at).unwrap();
    let place = page
        .windows(text.len())
        .position(|bytes| bytes == text.as_bytes())
        .expect("the text is in the page");
    let last = place + text.len() - 1;
    file(data).write_all_at(&[page[last] ^ 1], at + last as u64).unwrap();
}

/// A stopped server's directory, with all data in the database's file, and a robot that the server
/// knows.
async fn stopped() -> (TempDir, TestRobot) {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "*", "key-1").await;
    // The first use of its token is written.
    server.desired(&robot).await;
    (server.stop().await, robot)
}

async fn status(server: &TestServer) -> ServerStatus {
    server.get("/api/v1/server/status").await
}

pub async fn eventually(what: &str, mut is_so: impl AsyncFnMut() -> bool) {
    let wait = async { while !is_so().await {} };
    tokio::time::timeout(PATIENCE, wait).await.unwrap_or_else(|_| panic!("{what}"));
}

/// Orders and reports are refused with that reason and nothing is half done; intact data can be
/// read still.
async fn assert_nothing_is_changed(server: &TestServer, robot: &mut TestRobot) {
    let corrupt = (503, "database_corrupt".to_owned());
    let order = json!({ "selector": "*" });
    assert_eq!(refusal(server.order("/api/v1/tasks/talker/stop", "key-2", &order)).await, corrupt);
    assert_eq!(
        refusal(server.request(Method::POST, "/api/v1/enrollment-tokens").json(&json!({}))).await,
        corrupt
    );
    let state = server.desired(robot).await;
    assert_eq!(state.tasks.len(), 1, "nothing was stopped");
    let response = server.report(robot, &state, Phase::Running).await;
    assert_eq!(response.status(), 503, "the report is not acknowledged");
    assert_eq!(response.json::<Value>().await.unwrap()["error"]["code"], "database_corrupt");
    let push = server
        .request(
            Method::POST,
            "/v2/talker/blobs/uploads/?digest=sha256:\
        9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
        )
        .body("test");
    let response = push.header("content-type", "application/octet-stream").send().await.unwrap();
    assert_eq!(response.status(), 503);
    assert_eq!(response.json::<Value>().await.unwrap()["errors"][0]["code"], "DATABASE_CORRUPT");
    let ready = async || {
        let response = server.bare(Method::GET, "/readyz").send().await.unwrap();
        (response.status(), response.json::<Value>().await.unwrap())
    };
    eventually("/readyz says it", async || {
        let (status, body) = ready().await;
        status == 503 && body["database"].as_str().unwrap().contains("corrupt")
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn damaged_table_at_rest_is_refused_at_start() {
    let (directory, _) = stopped().await;
    let data = directory.path().join("data");
    flip_head(root_page(&data, "robots").await, &data);
    let mut config = Config::with_data(data.clone());
    config.http.set_port(0);
    config.mqtt.set_port(0);
    let refused = Server::start(config, Clock::system()).await.err().expect("refused").to_string();
    assert!(refused.contains(database(&data).to_str().unwrap()), "{refused}");
    assert!(refused.contains("is corrupt") && refused.contains("docs/server.md"), "{refused}");
    let mut doctor = cli::command(&["doctor", "--server", "http://127.0.0.1:1"]);
    doctor.env("TASKD_DATA", &data);
    let ran = cli::run(doctor).await.expect(1, "");
    assert!(ran.stdout.contains("✗ integrity"), "{}", ran.stdout);
}

#[tokio::test(flavor = "multi_thread")]
async fn damaged_index_is_found_while_serving_and_orders_are_refused() {
    let (directory, mut robot) = stopped().await;
    let data = directory.path().join("data");
    let index = root_page(&data, "robots_by_name").await;
    let check_often =
        |config: &mut Config| config.database_check_interval = Duration::from_millis(100);
    let server = TestServer::start_in(directory, check_often).await;
    eventually("a full check is done", async || {
        status(&server).await.database.fully_checked_at_ms.is_some()
    })
    .await;
    assert_eq!(status(&server).await.database.problem, None);
    flip_text(index, &data, "atlas");
    eventually("the damage is found", async || status(&server).await.database.problem.is_some())
        .await;
    let problem = status(&server).await.database.problem.unwrap();
    assert!(problem.contains("it is corrupt") && problem.contains("robots_by_name"), "{problem}");
    assert_nothing_is_changed(&server, &mut robot).await;
    let mut doctor = cli::command(&["doctor", "--data"]);
    doctor.arg(&data);
    let ran = cli::run(doctor).await.expect(1, "");
    assert!(ran.stdout.contains("✗ integrity"), "{}", ran.stdout);
}

#[tokio::test(flavor = "multi_thread")]
async fn damaged_index_at_rest_is_found_soon_after_start() {
    let (directory, mut robot) = stopped().await;
    let data = directory.path().join("data");
    flip_text(root_page(&data, "robots_by_name").await, &data, "atlas");
    let server = TestServer::start_in(directory, |_| {}).await;
    eventually("the damage is found", async || status(&server).await.database.problem.is_some())
        .await;
    assert_nothing_is_changed(&server, &mut robot).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn damage_found_by_a_request_refuses_all_orders() {
    let (directory, mut robot) = stopped().await;
    let data = directory.path().join("data");
    let table = root_page(&data, "audit").await;
    let server = TestServer::start_in(directory, |_| {}).await;
    eventually("a full check is done", async || {
        status(&server).await.database.fully_checked_at_ms.is_some()
    })
    .await;
    flip_head(table, &data);
    let met = refusal(server.request(Method::GET, "/api/v1/audit")).await;
    assert_eq!(met, (503, "database_corrupt".to_owned()));
    assert_nothing_is_changed(&server, &mut robot).await;
    let robots: Value = answer(server.request(Method::GET, "/api/v1/robots")).await;
    assert_eq!(robots["robots"].as_array().unwrap().len(), 1);
}
