//! `task-agent doctor` on problems that show without a server, and its man pages.

use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Stdio;

use serde_json::{Value, json};
use task_agent::task::ledger::{Accepted, Ledger};
use task_proto::desired::DesiredState;
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use task_proto::{CaPin, Generation, RobotId};

struct Ran {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

#[expect(clippy::disallowed_methods, reason = "the test starts the program it tests")]
fn agent(arguments: &[&str], environment: &[(&str, &str)]) -> Ran {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_task-agent"));
    command.args(arguments).stdin(Stdio::null());
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("TASK_AGENT_")) {
        command.env_remove(name);
    }
    let output = command.envs(environment.iter().copied()).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    Ran { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
}

fn doctor(data: &Path, environment: &[(&str, &str)]) -> Vec<Value> {
    let ran = agent(&["doctor", "-o", "json", "--data", data.to_str().unwrap()], environment);
    assert_eq!(ran.code, Some(1), "{}{}", ran.stdout, ran.stderr);
    let checkup: Value = serde_json::from_str(&ran.stdout).unwrap();
    checkup["checks"].as_array().unwrap().clone()
}

#[track_caller]
fn assert_found(checks: &[Value], check: &str, verdict: &str, words: &str) {
    let matches = |found: &&Value| {
        found["check"] == check
            && found["verdict"] == verdict
            && found["found"].as_str().unwrap().contains(words)
    };
    assert!(
        checks.iter().any(|found| matches(&found)),
        "{check}: {verdict} with {words:?} is not in {checks:?}"
    );
}

pub fn write_identity(data: &Path, server: &str) {
    write_identity_with(data, server, json!({}));
}

fn write_identity_with(data: &Path, server: &str, more: Value) {
    let key = SigningKey::random().public_key();
    let mut identity = json!({
        "robot_id": RobotId::random(), "token": "tskr_x", "server": server, "server_key": key,
        "mac": "02:00:00:00:00:01", "mqtt": { "host": null, "port": 1, "prefix": "taskd/v1" },
    });
    identity.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    std::fs::write(data.join("identity.json"), identity.to_string()).unwrap();
}

#[test]
fn doctor_names_what_an_unconfigured_robot_lacks() {
    let dir = tempfile::tempdir().unwrap();
    let nowhere = dir.path().join("nowhere");
    assert_found(&doctor(&nowhere, &[]), "data", "bad", "nowhere");
    let checks = doctor(dir.path(), &[]);
    assert_found(&checks, "identity", "bad", "this robot is not registered");
    assert_found(&checks, "settings", "good", "can be used");
    assert!(
        checks.iter().all(|check| (check["verdict"] == "good") == check["mend"].is_null()),
        "{checks:?}"
    );
    let ran = agent(&["doctor", "--data", dir.path().to_str().unwrap()], &[]);
    assert!(
        ran.stdout.contains("✗ identity ") && ran.stdout.contains("→ enroll: task-agent enroll"),
        "{}",
        ran.stdout
    );
}

#[test]
fn doctor_names_the_directory_that_blocks_the_task_user() {
    if !nix::unistd::geteuid().is_root() {
        return eprintln!("unavailable: only root runs tasks under another account");
    }
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    std::fs::create_dir(&data).unwrap();
    std::fs::set_permissions(dir.path(), std::fs::Permissions::from_mode(0o700)).unwrap();
    let checks = doctor(&data, &[("TASK_AGENT_TASK_USER", "4711")]);
    assert_found(
        &checks,
        "task user",
        "bad",
        &format!("which may not enter {}, where", dir.path().display()),
    );
    std::fs::set_permissions(dir.path(), std::fs::Permissions::from_mode(0o711)).unwrap();
    let checks = doctor(&data, &[("TASK_AGENT_TASK_USER", "4711")]);
    assert_found(&checks, "task user", "good", "with the groups of 4711");
    assert_found(&checks, "seccomp", "good", "only an administrator needs");
    let off = [("TASK_AGENT_TASK_USER", "4711"), ("TASK_AGENT_SECCOMP", "off")];
    assert_found(&doctor(&data, &off), "seccomp", "notice", "all system calls");
}

#[test]
fn doctor_names_an_invalid_setting() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("agent.toml"), "poll_intervall_s = 3\n").unwrap();
    assert_found(&doctor(dir.path(), &[]), "settings", "bad", "poll_intervall_s");
    std::fs::remove_file(dir.path().join("agent.toml")).unwrap();
    let gone = [("TASK_AGENT_UNDERLAYS", "/nowhere/setup.bash")];
    assert_found(&doctor(dir.path(), &gone), "ros", "bad", "/nowhere/setup.bash does not exist");
    let nobody = [("TASK_AGENT_TASK_USER", "nobody-of-this-name")];
    assert_found(&doctor(dir.path(), &nobody), "task user", "bad", "nobody-of-this-name");
    let setup = dir.path().join("setup.bash");
    std::fs::write(&setup, "").unwrap();
    let checks = doctor(
        dir.path(),
        &[("PATH", "/nowhere"), ("TASK_AGENT_UNDERLAYS", setup.to_str().unwrap())],
    );
    assert_found(&checks, "build", "notice", "neither colcon nor catkin_make");
    assert!(checks.iter().any(|check| check["check"] == "disk"), "{checks:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn doctor_distinguishes_an_unreachable_server_from_another_program() {
    let dir = tempfile::tempdir().unwrap();
    // Bound and not listening: no other process gets the port either.
    let nobody = tokio::net::TcpSocket::new_v4().unwrap();
    nobody.bind("127.0.0.1:0".parse().unwrap()).unwrap();
    write_identity(dir.path(), &format!("http://{}", nobody.local_addr().unwrap()));
    let checks = doctor(dir.path(), &[]);
    assert_found(&checks, "http", "bad", "refused");
    assert_found(&checks, "agent", "bad", "does not run");
    write_identity(dir.path(), "http://nowhere.invalid:8080");
    assert_found(&doctor(dir.path(), &[]), "dns", "bad", "nowhere.invalid");

    // The server answers every request as one with a clock in another year and with other tokens.
    let date = [("date", "Sun, 06 Nov 1994 08:49:37 GMT")];
    let refusal = r#"{"error":{"code":"unauthorized","message":"no such token"}}"#;
    let routes = axum::Router::new()
        .route("/healthz", axum::routing::get(move || async move { (date, "{}") }))
        .fallback(move || async move {
            (axum::http::StatusCode::UNAUTHORIZED, [("content-type", "application/json")], refusal)
        });
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    write_identity(dir.path(), &format!("http://{}", listener.local_addr().unwrap()));
    tokio::spawn(async move { axum::serve(listener, routes).await });
    let data = dir.path().to_owned();
    let checks = tokio::task::spawn_blocking(move || doctor(&data, &[])).await.unwrap();
    assert_found(&checks, "http", "good", "answers");
    assert_found(&checks, "clock", "bad", "ahead of the server's");
    assert_found(&checks, "token", "bad", "no such token");
    assert_found(&checks, "mqtt", "notice", "cannot connect");
    assert_found(&checks, "websocket", "bad", "401");
}

#[tokio::test(flavor = "multi_thread")]
async fn pinned_token_is_never_sent_in_plain_text() {
    let dir = tempfile::tempdir().unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let pin = CaPin::of(b"an authority");
    write_identity_with(
        dir.path(),
        &format!("http://{}", listener.local_addr().unwrap()),
        json!({ "ca_pin": pin }),
    );
    let (asked, mut heard) = tokio::sync::mpsc::unbounded_channel();
    let routes = axum::Router::new().fallback(move || async move { asked.send(()).unwrap() });
    tokio::spawn(async move { axum::serve(listener, routes).await });
    let data = dir.path().to_owned();
    let checks = tokio::task::spawn_blocking(move || doctor(&data, &[])).await.unwrap();
    assert_found(&checks, "server", "bad", "https:// instead of http://");
    assert!(heard.try_recv().is_err(), "nothing is said in plain text");
}

#[tokio::test(flavor = "multi_thread")]
async fn doctor_checks_the_mqtt_endpoint_over_allowed_routes() {
    let dir = tempfile::tempdir().unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    write_identity(dir.path(), &format!("http://{address}"));
    // Neither way leads to MQTT.
    let endpoint = json!({ "host": null, "port": address.port(), "prefix": "taskd/v1" });
    let routes =
        axum::Router::new().route("/healthz", axum::routing::get(|| async { "{}" })).route(
            "/api/v1/robots/{id}/mqtt",
            axum::routing::get(move || async move { axum::Json(endpoint) }),
        );
    tokio::spawn(async move { axum::serve(listener, routes).await });
    let with = async |transport: &'static str| {
        let data = dir.path().to_owned();
        let doctor = move || doctor(&data, &[("TASK_AGENT_MQTT_TRANSPORT", transport)]);
        tokio::task::spawn_blocking(doctor).await.unwrap()
    };
    let silent = format!("{address} does not speak MQTT");
    let has = |checks: &[Value], check: &str| checks.iter().any(|found| found["check"] == check);
    let checks = with("auto").await;
    assert_found(&checks, "token", "good", "accepted");
    assert_found(&checks, "mqtt", "notice", &silent);
    assert_found(&checks, "websocket", "bad", "404");
    let checks = with("tcp").await;
    assert_found(&checks, "mqtt", "bad", &silent);
    assert!(!has(&checks, "websocket"), "{checks:?}");
    let checks = with("websocket").await;
    assert_found(&checks, "websocket", "bad", "404");
    assert!(!has(&checks, "mqtt"), "{checks:?}");
}

#[test]
fn doctor_checks_settings_from_the_server() {
    let dir = tempfile::tempdir().unwrap();
    let (robot_id, key) = (RobotId::random(), SigningKey::random());
    let identity = json!({ "robot_id": robot_id, "server_key": key.public_key() });
    write_identity_with(dir.path(), "http://nowhere.invalid:8080", identity);
    let state = DesiredState {
        robot_id,
        generation: Generation(1),
        issued_at_ms: 1,
        expires_at_ms: u64::MAX,
        tasks: Vec::new(),
        evidence: Default::default(),
        settings: serde_json::from_value(json!({ "workspace": "/nowhere/ws" })).unwrap(),
        robot: Default::default(),
    };
    let envelope = Envelope::seal(DESIRED_STATE_TYPE, &serde_json::to_vec(&state).unwrap(), &key);
    let mut ledger = Ledger::new(0);
    ledger.accepted = Some(Accepted { generation: state.generation, envelope });
    ledger.write(&dir.path().join("ledger.json")).unwrap();
    assert_found(
        &doctor(dir.path(), &[]),
        "ros",
        "bad",
        "/nowhere/ws/install/setup.bash does not exist",
    );
    let own = [("TASK_AGENT_WORKSPACE", "/elsewhere/ws")];
    assert_found(
        &doctor(dir.path(), &own),
        "ros",
        "bad",
        "/elsewhere/ws/install/setup.bash does not exist",
    );
}

#[test]
fn each_subcommand_has_a_man_page() {
    let dir = tempfile::tempdir().unwrap();
    let pages = dir.path().join("man1");
    assert_eq!(agent(&["man", pages.to_str().unwrap()], &[]).code, Some(0));
    for page in ["task-agent.1", "task-agent-enroll.1", "task-agent-doctor.1"] {
        assert!(
            std::fs::read_to_string(pages.join(page)).unwrap().contains(".SH SYNOPSIS"),
            "{page}"
        );
    }
    assert!(!pages.join("task-agent-shim.1").exists(), "nobody calls it");
}
