//! `taskd doctor`, healthy and with one thing after another broken.

use axum::Router;
use serde_json::Value;
use taskd::system::clock::Clock;

use crate::cli::{Bench, Ran, command, run};
use crate::postgres_cluster::{Postgres, free_port, url};

/// The verdict on one check, and its findings.
fn found(ran: &Ran, check: &str) -> Vec<(String, String)> {
    let checks = ran.json()["checks"].as_array().unwrap().clone();
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let of = |value: &&Value| value["check"] == check;
    checks.iter().filter(of).map(|value| (text(&value["verdict"]), text(&value["found"]))).collect()
}

#[track_caller]
fn assert_found(ran: &Ran, check: &str, verdict: &str, words: &str) {
    let found = found(ran, check);
    let matches = found.iter().any(|(judged, said)| judged == verdict && said.contains(words));
    assert!(matches, "{check}: {verdict} with {words:?} is not in {found:?}: {}", ran.stdout);
}

#[tokio::test(flavor = "multi_thread")]
async fn healthy_server_passes_all_checks() {
    let bench = Bench::start().await;
    bench.enroll(1).await;
    let told = bench.taskd(&["doctor"]).await.expect(0, "").stdout;
    for line in [
        "✓ http ",
        "✓ database ",
        "✓ broker ",
        "✓ clock ",
        "✓ token ",
        "✓ mqtt ",
        "✓ websocket ",
        "✓ version ",
        "✓ robots ",
    ] {
        assert!(told.contains(line), "{line}: {told}");
    }
    assert!(!told.contains('✗') && !told.contains('\u{1b}'), "{told}");
    let ran = bench.taskd(&["doctor", "-o", "json"]).await.expect(0, "");
    assert_found(&ran, "data", "good", "is writable");
    assert_found(&ran, "tls", "good", "the connection stays on this machine");
    assert_found(&ran, "robots", "good", "0 of 1 online");
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn doctor_names_the_obstacle_to_the_server() {
    let bench = Bench::start().await;
    let at = async |server: &str| {
        bench.taskd(&["doctor", "-o", "json", "--server", server]).await.expect(1, "")
    };
    let nobody = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    assert_found(&at(&format!("http://{nobody}")).await, "http", "bad", "refused");
    assert_found(&at("http://nowhere.invalid:8080").await, "name", "bad", "nowhere.invalid");
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let portal = listener.local_addr().unwrap();
    tokio::spawn(async move { axum::serve(listener, Router::<()>::new()).await });
    assert_found(
        &at(&format!("http://{portal}")).await,
        "http",
        "bad",
        "is not taskd (status 404)",
    );
    bench.taskd(&["doctor", "--server", "nonsense"]).await.expect(2, "--server");

    let other =
        task_proto::trust::token::Token::random(task_proto::trust::token::TokenKind::Operator)
            .reveal();
    let ran = bench.taskd(&["doctor", "-o", "json", "--token", &other]).await.expect(1, "");
    assert_found(&ran, "token", "bad", "");
    assert_found(&ran, "http", "good", "answers");
    bench.taskd(&["user", "add", "eve", "--role", "viewer", "--no-password"]).await.expect(0, "");
    let viewer = bench
        .taskd(&["token", "create", "--user", "eve", "--ttl", "7d"])
        .await
        .expect(0, "")
        .stdout;
    let ran = bench.taskd(&["doctor", "-o", "json", "--token", viewer.trim()]).await.expect(0, "");
    assert_found(&ran, "token", "notice", "has permission to read; the token expires");
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn doctor_reports_clock_skew() {
    let ahead = Clock::fixed(Clock::system().now_ms() + 90_000);
    let bench = Bench::start_with(|_| {}, ahead).await;
    let ran = bench.taskd(&["doctor", "-o", "json"]).await.expect(0, "");
    assert_found(&ran, "clock", "notice", "behind the server's");
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn doctor_reports_the_certificate_expiry() {
    let bench =
        Bench::start_with(|config| config.tls.private_ca = Some(true), Clock::system()).await;
    let ran = bench.taskd(&["doctor", "-o", "json"]).await.expect(0, "");
    assert_found(&ran, "tls", "good", "trusted by the pinned authority, the certificate expires 2");
    assert_found(&ran, "mqtt", "good", "answers");
    assert_found(&ran, "websocket", "good", "answers");
    let url = format!("https://{}", bench.server().addresses().http);
    let mut stranger = command(&["doctor", "-o", "json", "--server", &url]);
    stranger.env("XDG_DATA_HOME", "/nonexistent");
    assert_found(&run(stranger).await.expect(1, ""), "http", "bad", "certificate");
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn doctor_reports_why_a_server_can_not_start() {
    let mut bench = Bench::start().await;
    bench.server.take().unwrap().stop().await;
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = listener.local_addr().unwrap().to_string();
    let with = async |variables: &[(&str, &str)]| {
        let mut command = command(&["doctor", "-o", "json", "--server", "http://127.0.0.1:1"]);
        command.env("TASKD_DATA", bench.data()).envs(variables.iter().copied());
        run(command).await.expect(1, "")
    };
    let (http, mqtt) = (("TASKD_HTTP", "127.0.0.1:0"), ("TASKD_MQTT", "127.0.0.1:0"));
    let ran = with(&[http, mqtt]).await;
    assert_found(&ran, "server", "bad", "no server is running on this directory");
    assert_found(&ran, "port", "good", "is free for --http");
    let ran = with(&[("TASKD_HTTP", &taken), mqtt]).await;
    assert_found(&ran, "port", "bad", &format!("{taken} is not available for --http"));
    assert_found(&ran, "port", "good", "is free for --mqtt");
    let ran = with(&[("TASKD_HTTP", "nonsense")]).await;
    assert_found(&ran, "settings", "bad", "TASKD_HTTP");
    assert!(found(&ran, "space")[0].1.contains(" free"), "{}", ran.stdout);
}

#[tokio::test(flavor = "multi_thread")]
async fn doctor_reports_the_postgres_servers_of_a_stopped_server() {
    let postgres = Postgres::create();
    postgres.start();
    let directory = tempfile::tempdir().unwrap();
    let with = async |database: &str| {
        let mut command = command(&["doctor", "-o", "json", "--server", "http://127.0.0.1:1"]);
        command.env("TASKD_DATA", directory.path()).env("TASKD_DATABASE", database);
        let ran = run(command).await.expect(1, "");
        assert!(!ran.stdout.contains("swordfish"), "{}", ran.stdout);
        ran
    };
    let absent = free_port();
    let ran = with(&[url(absent), postgres.url()].join(",")).await;
    let found = format!("127.0.0.1:{}/postgres answers and takes writes", postgres.port);
    assert_found(&ran, "database", "good", &found);
    let ran = with(&url(absent)).await;
    assert_found(&ran, "database", "bad", "Connection refused");
}
