//! `taskd database copy`: SQLite to Postgres and back, interrupted, and refused.

use std::path::Path;
use std::process::Stdio;

use reqwest::StatusCode;
use serde_json::{Value, json};
use task_proto::messages::report::Phase;
use taskd::config::Config;
use taskd::store::{CopyError, ServerIdentity, Sharing, Store, copy_database, sqlite_url};
use tempfile::TempDir;

use crate::cli::{Ran, command, run};
use crate::database::{self, TestDatabase};
use crate::harness::TestServer;
use crate::outputs::{Push, file, output};

/// A closed database with rows in every table.
async fn filled() -> TestDatabase {
    let database = database::sqlite().await;
    database.store.close().await;
    database::fill_all_tables(&database.url).await;
    database
}

async fn empty_postgres() -> TestDatabase {
    let database = database::postgres().await;
    database.store.close().await;
    database
}

async fn copy(from: &str, to: &str) -> Ran {
    run(command(&["database", "copy", from, to])).await
}

async fn refused(from: &str, to: &str) -> CopyError {
    copy_database(from, to, |_, _| {}).await.expect_err("refused")
}

/// The rows of every table, sorted, without the name of the server that used the database.
async fn contents(url: &str) -> Vec<String> {
    let mut lines = Vec::new();
    for table in database::tables(url).await {
        for row in database::rows(url, &table).await {
            lines.push(format!("{table}: {row}"));
        }
    }
    lines.sort();
    lines
}

/// The view that people have of the fleet.
async fn lists(server: &TestServer) -> Vec<Value> {
    let mut lists = Vec::new();
    for path in [
        "/api/v1/robots",
        "/api/v1/robots/atlas/tasks",
        "/api/v1/packages",
        "/api/v1/deployments",
        "/api/v1/outputs",
        "/api/v1/users",
        "/api/v1/tokens",
        "/api/v1/audit",
    ] {
        lists.push(server.get(path).await);
    }
    lists
}

fn sqlite_file(server: &TestServer) -> String {
    format!("sqlite:{}", server.data().join("taskd.sqlite").display())
}

async fn start_on(directory: TempDir, url: &str) -> TestServer {
    let set = |config: &mut Config| config.database = Some(url.to_owned());
    TestServer::start_in(directory, set).await
}

/// A fleet with a history.
async fn lived_in() -> TestServer {
    let server = TestServer::start().await;
    let mut atlas = server.enroll("atlas").await;
    server.enroll("Zorro").await;
    server.enroll("a-2").await;
    let first = server.push("talker", "1.0.0").await;
    server.deploy(&first, "*", "key-1").await;
    let state = server.desired(&atlas).await;
    for phase in [Phase::Fetching, Phase::Running] {
        assert_eq!(server.report(&mut atlas, &state, phase).await.status(), StatusCode::OK);
    }
    let second = server.push("talker", "2.0.0").await;
    server.deploy(&second, "atlas", "key-2").await;
    let state = server.desired(&atlas).await;
    assert_eq!(server.report(&mut atlas, &state, Phase::Failed).await.status(), StatusCode::OK);
    let push = Push::new(&server, &atlas, format!("outputs/{}/mapping", atlas.id));
    let map = push.blob("P5 1 1 255 é".as_bytes()).await;
    let set = output(&atlas.id, 1, vec![file("maps/corridor.pgm", map)]);
    assert_eq!(push.output(&set).await, StatusCode::CREATED);
    let user = json!({
        "name": "ada", "roles": ["operator"], "scope": "atlas", "password": "correct horse battery",
    });
    let _: Value = server.post("/api/v1/users", &user).await;
    let _: Value = server.post("/api/v1/tokens", &json!({ "user": "ada" })).await;
    server
}

#[tokio::test(flavor = "multi_thread")]
async fn database_is_copied_to_postgres_and_back_with_all_history() {
    let server = lived_in().await.restart().await;
    let (shown, file) = (lists(&server).await, sqlite_file(&server));
    copy(&file, "sqlite:/nonexistent/x").await.expect(1, "is in use by another program");
    let directory = server.stop().await;

    let postgres = empty_postgres().await;
    let ran = copy(&file, &postgres.url).await.expect(0, "");
    for line in ["robots                          3\n", &format!("database = \"{}\"", postgres.url)]
    {
        assert!(ran.stdout.contains(line), "{line:?} is not in {}", ran.stdout);
    }
    assert_eq!(contents(&postgres.url).await, contents(&file).await);

    let server = start_on(directory, &postgres.url).await;
    assert_eq!(lists(&server).await, shown);
    let data = server.data().to_str().expect("UTF-8").to_owned();
    let verified = run(command(&["audit", "--verify", "--data", &data])).await;
    verified.expect(0, "");
    let again = server
        .order("/api/v1/tasks/talker/stop", "key-3", &json!({ "selector": "*" }))
        .send()
        .await
        .expect("an answer");
    assert!(again.status().is_success(), "{}", again.status());
    let shown = lists(&server).await;
    let directory = server.stop().await;

    let back = sqlite_url(&directory.path().join("back.sqlite"));
    copy(&postgres.url, &back).await.expect(0, "");
    let held = |lines: Vec<String>| -> Vec<String> {
        lines.into_iter().filter(|line| !line.starts_with("write_lock: ")).collect()
    };
    assert_eq!(held(contents(&back).await), held(contents(&postgres.url).await));
    let lock = database::rows(&back, "write_lock").await;
    assert!(lock[0].ends_with(" None None"), "the holder stays behind: {lock:?}");
    let server = start_on(directory, &back).await;
    assert_eq!(lists(&server).await, shown);
    server.stop().await;
}

#[tokio::test]
async fn every_table_is_copied() {
    let (source, target) = (filled().await, empty_postgres().await);
    let mut copied = Vec::new();
    let count = |table: &str, rows| copied.push((table.to_owned(), rows));
    copy_database(&source.url, &target.url, count).await.expect("copied");
    copied.sort();
    let mut counted = Vec::new();
    for table in database::tables(&target.url).await {
        let rows = database::rows(&target.url, &table).await.len() as u64;
        assert!(rows > 0, "{table} has no row");
        counted.push((table, rows));
    }
    assert_eq!(copied, counted);
    assert_eq!(database::rows(&target.url, "write_lock").await, ["Some(1) Some(7) None None"]);
    let held = "write_lock: Some(1) Some(7) Some(\"rack-1\") Some(7)";
    let free = "write_lock: Some(1) Some(7) None None";
    let expected = contents(&source.url).await.into_iter();
    let expected: Vec<_> = expected.map(|line| line.replace(held, free)).collect();
    assert_eq!(contents(&target.url).await, expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn interrupted_copy_goes_on_without_duplicates() {
    let (source, target) = (filled().await, empty_postgres().await);
    // The last table can't be written, so all others are when the copy is killed.
    let obstacle = target.keep_from_writing("feed").await;
    let mut killed = command(&["database", "copy", &source.url, &target.url]);
    let mut killed = killed.stdout(Stdio::null()).spawn().expect("starts");
    target.sessions_wait_for_locks(1).await;
    killed.kill().expect("killed");
    killed.wait().expect("ended");
    drop(obstacle);
    let lines = contents(&target.url).await;
    assert!(lines.iter().all(|line| line.starts_with("write_lock: ")), "{lines:?}");
    copy(&source.url, &target.url).await.expect(0, "");
    let others = |line: &String| !line.starts_with("write_lock: ");
    let (mut copied, mut expected) = (contents(&target.url).await, contents(&source.url).await);
    copied.retain(others);
    expected.retain(others);
    assert_eq!(copied, expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn copy_to_a_used_database_is_refused() {
    let (source, used, postgres) = (filled().await, filled().await, empty_postgres().await);
    let before = contents(&used.url).await;
    let error = refused(&source.url, &used.url).await.to_string();
    let name = used.url.trim_end_matches("?mode=rwc");
    assert!(
        error.starts_with(&format!("database {name} is in use already: its table ")),
        "{error}"
    );
    assert_eq!(contents(&used.url).await, before);

    let identity = ServerIdentity {
        run: "rack-1".to_owned(),
        key_id: "key".to_owned(),
        topic_prefix: "taskd/v1".to_owned(),
        sharing: Sharing::Alone,
    };
    let server = Store::guarded(&postgres.url, identity);
    server.prepare().await.expect("prepared");
    let other = database::sqlite().await;
    for (from, to) in [(&source.url, &postgres.url), (&postgres.url, &other.url)] {
        let error = refused(from, to).await;
        assert!(matches!(error, CopyError::InUse { .. }), "{error}");
        assert!(error.to_string().contains(" is in use by server rack-1 (since "), "{error}");
    }
    server.close().await;
    // `other` is open in this process.
    let error = refused(&source.url, &other.url).await;
    assert!(matches!(error, CopyError::FileInUse { .. }), "{error}");
}

#[tokio::test]
async fn copy_of_no_database_is_refused() {
    let directory = TempDir::new().expect("a directory");
    let path = |name: &str| directory.path().join(name);
    let url = |path: &Path| format!("sqlite:{}", path.display());
    let (missing, empty) = (path("missing"), path("empty"));
    std::fs::write(&empty, "").expect("written");
    copy(&url(&missing), &url(&path("to"))).await.expect(1, "missing can't be opened");
    copy(&url(&empty), &url(&path("to"))).await.expect(1, "is not the database of a server");
    assert!(!path("to").exists() && !missing.exists());
    let secret = "postgres://ada:swordfish@db/taskd";
    let ran = copy(&url(&missing), secret).await.expect(2, "TO: every user of this machine");
    assert!(!ran.stderr.contains("swordfish"), "{}", ran.stderr);
    copy("mysql://db", &url(&empty)).await.expect(2, "FROM: expected a URL");
}
