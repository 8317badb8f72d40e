//! Attacks by a holder of a token without a key, and by a thief who has the server's key, a state
//! that the server signed once, or a robot's identity.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde_json::{Value, json};
use task_proto::DeploymentId;
use task_proto::api::{DeploymentView, RobotView};
use task_proto::desired::{BlobRef, DesiredState, PackageRef};
use task_proto::ids::digest::unhex;
use task_proto::messages::report::{FailureCode, Phase, Report, TaskReport};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use tokio::task::JoinHandle;

use crate::harness::{Server, eventually, from_restarted_agent, open_directory, write_package};
use crate::signing::{Site, new_key};

/// An impostor in the server's place, with a state for the robot and blobs, that records the
/// robot's requests.
#[derive(Clone, Default)]
struct Thief(Arc<Mutex<Loot>>);

#[derive(Default)]
struct Loot {
    state: Option<Envelope>,
    blobs: HashMap<String, Vec<u8>>,
    reports: Vec<Report>,
}

impl Thief {
    fn loot(&self) -> MutexGuard<'_, Loot> {
        self.0.lock().expect("no panic")
    }

    /// Answers at the address of a server that is gone.
    async fn serve(&self, address: SocketAddr) -> JoinHandle<std::io::Result<()>> {
        let router = Router::new()
            .route("/api/v1/robots/{robot}/desired", get(state))
            .route("/api/v1/robots/{robot}/report", post(report))
            .route("/v2/{*path}", get(blob))
            .with_state(self.clone());
        let listener = tokio::net::TcpListener::bind(address).await.expect("the server's own port");
        tokio::spawn(async move { axum::serve(listener, router).await })
    }

    /// Waits for a report of which `pick` makes something.
    async fn hears<T>(&self, what: &str, pick: impl Fn(&Report) -> Option<T>) -> T {
        eventually(what, async || self.loot().reports.iter().find_map(&pick)).await
    }
}

async fn state(State(thief): State<Thief>) -> Response {
    axum::Json(thief.loot().state.clone()).into_response()
}

async fn blob(State(thief): State<Thief>, Path(path): Path<String>) -> Response {
    let digest = path.rsplit('/').next().unwrap_or_default().to_owned();
    match thief.loot().blobs.get(&digest) {
        Some(bytes) => ([("docker-content-digest", digest)], bytes.clone()).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

async fn report(State(thief): State<Thief>, axum::Json(report): axum::Json<Report>) -> Response {
    let generation = report.observed_generation;
    thief.loot().reports.push(report);
    axum::Json(json!({ "name": "robot-1", "labels": {}, "generation": generation })).into_response()
}

fn has(robot: &RobotView, code: &str) -> bool {
    robot.conditions.iter().any(|condition| condition.code == code)
}

/// The server's desired state for the robot with the identity in `data`.
async fn desired_by(server: &Server, data: &std::path::Path) -> reqwest::Response {
    let identity = std::fs::read(data.join("identity.json")).expect("identity");
    let identity: Value = serde_json::from_slice(&identity).expect("json");
    let text = |key: &str| identity[key].as_str().expect("text");
    let desired = server.url(&format!("/api/v1/robots/{}/desired", text("robot_id")));
    let request = reqwest::Client::new().get(desired).bearer_auth(text("token"));
    from_restarted_agent(request, data).send().await.expect("an answer")
}

/// The robot's desired state as signed by the server.
async fn signed_state(site: &Site) -> Envelope {
    desired_by(&site.server, site.robot.data()).await.json().await.expect("an envelope")
}

/// The server's own key, which signs desired states.
fn stolen_key(server: &Server) -> SigningKey {
    let seed =
        std::fs::read_to_string(server.data().join("signing.key")).expect("the server's key");
    SigningKey::from_bytes(unhex(seed.trim()).expect("64 hex digits"))
}

async fn stolen_blob(server: &Server, blob: BlobRef) -> Vec<u8> {
    let request =
        reqwest::Client::new().get(server.url(&format!("/v2/worker/blobs/{}", blob.digest)));
    let answer = request.bearer_auth(server.operator_token()).send().await.expect("an answer");
    let bytes = answer.bytes().await.expect("a blob").to_vec();
    assert_eq!(BlobRef::of(&bytes), blob);
    bytes
}

#[tokio::test(flavor = "multi_thread")]
async fn publisher_token_without_a_trusted_key_runs_nothing() {
    let (site, keys) = Site::start(1, &["ada.key"]).await;
    let order = site.push("1.0", &["--sign", &keys[0].0]).await;
    let running = site.wait(&order, Phase::Running).await.tasks.remove(0).active;
    site.server
        .operate(["user", "add", "eve", "--role", "operator,publisher", "--no-password"])
        .await;
    let made = site.server.operate(["token", "create", "--user", "eve", "-o", "json"]).await;
    let made: Value = serde_json::from_str(&made).expect("json");
    let as_eve = async |args: &[&str]| {
        let mut command = site.server.command(args);
        command.env("TASKD_TOKEN", made["token"].as_str().expect("a token"));
        tokio::task::spawn_blocking(move || command.output().expect("taskd runs"))
            .await
            .expect("no panic")
    };
    let (key, public) = new_key(&site.server, site.dir.path(), "eve.key").await;
    let package = site.package("6.6");
    let push = [
        "push",
        package.to_str().expect("utf-8"),
        "--to",
        "robot-1",
        "--yes",
        "--sign",
        &key,
        "-o",
        "json",
    ];
    let is_refused = async || {
        let output = as_eve(&push).await;
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let order: DeploymentView = serde_json::from_slice(&output.stdout).expect("a deployment");
        let view = site.wait(order.id.as_str(), Phase::Failed).await;
        assert_eq!(
            view.tasks[0].failure.as_ref().expect("why").code,
            FailureCode::UNTRUSTED_PACKAGE
        );
        assert_eq!(view.tasks[0].active, running, "the signed task continues");
        view
    };
    is_refused().await;

    // A list that names her own key takes an admin's token as well, and is worth nothing with one.
    let list = site.dir.path().join("list").to_str().expect("utf-8").to_owned();
    site.server.operate(["key", "draft", &list, "--publisher", &public]).await;
    site.server.operate(["key", "sign", &list, "--key", &key]).await;
    let denied = as_eve(&["key", "publish", &list]).await;
    let told = String::from_utf8_lossy(&denied.stderr);
    assert!(!denied.status.success() && told.contains("no permission to administer"), "{told}");
    site.server.operate(["key", "publish", &list]).await;
    eventually("the robot to refuse the list", async || {
        let view = site.server.robot("robot-1").await?;
        has(&view, "publishers_refused").then_some(())
    })
    .await;
    assert_eq!(is_refused().await.host.expect("facts").publishers, Some(0), "by its own settings");
}

#[tokio::test(flavor = "multi_thread")]
async fn stolen_server_key_cannot_run_unsigned_packages() {
    let (mut site, keys) = Site::start(1, &["ada.key"]).await;
    let order = site.push("1.0", &["--sign", &keys[0].0]).await;
    let running = site.wait(&order, Phase::Running).await.tasks.remove(0).active;
    // Uploaded with an operator's token and without a signing key.
    let marker = site.dir.path().join("open");
    open_directory(&marker);
    let evil = site.dir.path().join("worker-evil");
    let script = format!("touch {}/was-here\nexec sleep 1000\n", marker.display());
    write_package(&evil, "worker", "1.0", "service", &script);
    let args = ["push", evil.to_str().expect("utf-8"), "--force", "-o", "json"];
    let evil: PackageRef =
        serde_json::from_str(&site.server.operate(args).await).expect("a package");

    let key = stolen_key(&site.server);
    let payload = signed_state(&site)
        .await
        .open(DESIRED_STATE_TYPE, &key.public_key())
        .expect("by the server's key");
    let good: DesiredState = serde_json::from_slice(&payload).expect("a state");
    let thief = Thief::default();
    for blob in [evil.config, evil.content].into_iter().chain(good.evidence.blobs()) {
        let bytes = stolen_blob(&site.server, blob).await;
        thief.loot().blobs.insert(blob.digest.to_string(), bytes);
    }
    site.server.kill();
    let serving = thief.serve(site.server.http).await;

    // All of the evil package; and the signed one's name, version and manifest, with the evil one's
    // bytes.
    let signed = good.tasks[0].package.clone();
    let mixed = PackageRef { config: evil.config, content: evil.content, ..signed };
    for (package, generation) in [evil, mixed].into_iter().zip(good.generation.0 + 1..) {
        let mut forged = good.clone();
        forged.generation.0 = generation;
        (forged.tasks[0].package, forged.tasks[0].deployment) = (package, DeploymentId::random());
        let payload = serde_json::to_vec(&forged).expect("json");
        thief.loot().state = Some(Envelope::seal(DESIRED_STATE_TYPE, &payload, &key));
        let is_refused = |task: &&TaskReport| {
            task.deployment == forged.tasks[0].deployment && task.phase == Phase::Failed
        };
        let refused = |report: &Report| report.tasks.iter().find(is_refused).cloned();
        let refused = thief.hears("the robot to refuse it", refused).await;
        assert_eq!(refused.failure.expect("why").code, FailureCode::UNTRUSTED_PACKAGE);
        assert_eq!(refused.active, running, "it goes on");
    }
    serving.abort();
    assert!(!marker.join("was-here").exists(), "it ran");
}

#[tokio::test(flavor = "multi_thread")]
async fn replayed_state_is_refused_even_after_an_agent_restart() {
    let (mut site, keys) = Site::start(1, &["ada.key"]).await;
    let sign = ["--sign", keys[0].0.as_str()];
    let order = site.push("1.0", &sign).await;
    site.wait(&order, Phase::Running).await;
    let old = signed_state(&site).await;
    let order = site.push("2.0", &sign).await;
    let running = site.wait(&order, Phase::Running).await.tasks.remove(0).active;

    let thief = Thief::default();
    thief.loot().state = Some(old);
    site.server.kill();
    let serving = thief.serve(site.server.http).await;
    for _ in 0..2 {
        let refused = |report: &Report| {
            let condition =
                report.conditions.iter().find(|condition| condition.code == "state_refused")?;
            Some((condition.text.clone(), report.tasks.clone()))
        };
        let (why, tasks) = thief.hears("the robot to refuse it", refused).await;
        assert!(why.contains("is older than"), "{why}");
        assert_eq!((tasks[0].phase, &tasks[0].active), (Phase::Running, &running), "it goes on");
        site.robot.kill();
        thief.loot().reports.clear();
        site.robot.restart();
    }
    serving.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn cloned_identity_is_shown_gets_no_work_and_ends_with_reenrollment() {
    let (mut site, keys) = Site::start(1, &["ada.key"]).await;
    let sign = ["--sign", keys[0].0.as_str()];
    let thief = site.robot.stolen(site.dir.path(), "thief");
    let is_shown =
        async || site.server.robot("robot-1").await.filter(|view| has(view, "duplicate_identity"));
    eventually("the server to see two of them", is_shown).await;
    let shown = site.server.operate(["robot", "info", "robot-1"]).await;
    assert!(shown.contains("duplicate_identity"), "{shown}");
    let order = site.push("1.0", &sign).await;

    let made =
        site.server.operate(["enroll-token", "create", "--robot", "robot-1", "-o", "json"]).await;
    let made: Value = serde_json::from_str(&made).expect("json");
    site.robot.terminate();
    site.robot.enroll_again(1, made["token"].as_str().expect("a token")).await;
    site.robot.restart();
    let view = site.wait(&order, Phase::Running).await;
    assert!(!has(&view, "duplicate_identity"));
    assert!(!thief.data().join("tasks/worker").exists(), "the thief got work");
    assert_eq!(desired_by(&site.server, thief.data()).await.status(), StatusCode::UNAUTHORIZED);
}

/// A server with a robot that has already reported.
async fn with_a_known_robot() -> (Site, Vec<(String, String)>) {
    let (site, keys) = Site::start(1, &["ada.key"]).await;
    let is_known = |view: &RobotView| view.online && view.host.is_some();
    eventually("the robot to be known", async || {
        site.server.robot("robot-1").await.filter(is_known)
    })
    .await;
    (site, keys)
}

/// Waits until the server shows that another agent has come with the robot's identity.
async fn is_noticed(site: &Site) {
    let noticed = |view: &RobotView| has(view, "instance_waits") || has(view, "duplicate_identity");
    eventually("the copy to be noticed", async || {
        site.server.robot("robot-1").await.filter(noticed)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn copied_robot_data_gets_no_order_while_the_original_is_online() {
    let (site, keys) = with_a_known_robot().await;
    let mut copy = site.robot.copied(site.dir.path(), "copy");
    let order = site.push("1.0", &["--sign", &keys[0].0]).await;
    site.wait(&order, Phase::Running).await;
    copy.restart();
    is_noticed(&site).await;
    // By then the robot has come back, and would have been told of the order again.
    let both = |view: &RobotView| has(view, "duplicate_identity");
    eventually("both to be seen", async || site.server.robot("robot-1").await.filter(both)).await;
    assert!(!copy.data().join("tasks/worker").exists(), "the copy got the order");
    assert_eq!(desired_by(&site.server, copy.data()).await.status(), StatusCode::CONFLICT);
}

#[tokio::test(flavor = "multi_thread")]
async fn copied_robot_data_gets_no_order_while_the_original_is_briefly_offline() {
    let (mut site, keys) = with_a_known_robot().await;
    let sign = ["--sign", keys[0].0.as_str()];
    let mut copy = site.robot.copied(site.dir.path(), "copy");
    site.robot.freeze();
    let order = site.push("1.0", &sign).await;
    copy.restart();
    is_noticed(&site).await;
    copy.kill();
    assert_eq!(desired_by(&site.server, copy.data()).await.status(), StatusCode::CONFLICT);
    assert!(!copy.data().join("tasks/worker").exists(), "the copy got the order");
    site.robot.thaw();
    site.wait(&order, Phase::Running).await;

    // Its own restart is not held up.
    site.robot.kill();
    site.robot.restart();
    let restarted = Instant::now();
    let order = site.push("2.0", &sign).await;
    site.wait(&order, Phase::Running).await;
    assert!(restarted.elapsed() < Duration::from_secs(25), "it waited for itself to fall silent");
}
