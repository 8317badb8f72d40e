//! The ways a package may take, as the operator's order names them, through the real programs.

use task_proto::api::DeploymentView;
use task_proto::desired::Delivery;
use task_proto::messages::report::Phase;

use crate::harness::{Robot, Server, add_ballast, eventually, write_package};
use crate::proxy::Proxy;

/// A package that does not compress.
fn package(dir: &std::path::Path, bytes: usize) -> std::path::PathBuf {
    let package = dir.join("worker");
    write_package(&package, "worker", "1.0.0", "service", "exec sleep 1000\n");
    add_ballast(&package, bytes);
    package
}

/// Deploys the package in this way, waits until the task runs, and returns the planned delivery of
/// its bytes.
async fn deliver(server: &Server, package: &std::path::Path, delivery: &str) -> Delivery {
    let package = package.to_str().expect("utf-8 path");
    let order = ["push", package, "--to", "robot-1", "--yes", "--delivery", delivery, "-o", "json"];
    let view: DeploymentView = serde_json::from_str(&server.operate(order).await).expect("json");
    server.wait_phase("robot-1", "worker", Phase::Running).await;
    let view = server.deployment(view.id.as_str()).await.expect("known");
    view.assignments.expect("assignments")[0]
        .delivery
        .clone()
        .expect("its batch has begun")
        .mechanism
}

#[tokio::test(flavor = "multi_thread")]
async fn small_package_arrives_inline_without_http() {
    const BYTES: usize = 24_000;
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let proxy = Proxy::start(server.http, u64::MAX).await;
    let _robot = Robot::start_with(
        &server,
        dir.path(),
        "robot-1",
        1,
        &format!("http://{}", proxy.address),
        &[],
    )
    .await;
    server.wait_online("robot-1").await;
    let package = package(dir.path(), BYTES);
    let before = proxy.bytes_to_clients();
    assert_eq!(deliver(&server, &package, "inline").await, Delivery::Inline);
    let passed = proxy.bytes_to_clients() - before;
    assert!(passed < BYTES as u64 / 2, "{passed} bytes came over HTTP");
}

#[tokio::test(flavor = "multi_thread")]
async fn unannounced_order_is_found_by_polling() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let often = [("TASK_AGENT_POLL_INTERVAL_S", "1")];
    let _robot =
        Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &often).await;
    let sent = async || Some(server.robot("robot-1").await?.mqtt?.traffic.messages_out);
    let package = package(dir.path(), 100);
    // A robot is sent its state when its agent identifies itself, over MQTT and over HTTP.
    eventually("the robot to be sent its state", async || sent().await.filter(|count| *count > 0))
        .await;
    let before = sent().await.expect("connected");
    assert_eq!(deliver(&server, &package, "poll").await, Delivery::Poll);
    assert_eq!(sent().await.expect("still connected"), before, "the order was announced");
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_without_mqtt_pulls_a_direct_push() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let alone = [("TASK_AGENT_MQTT", "false"), ("TASK_AGENT_POLL_INTERVAL_WITHOUT_MQTT_S", "1")];
    let _robot =
        Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &alone).await;
    // On a slow machine the server may have told it so meanwhile.
    let mechanism = deliver(&server, &package(dir.path(), 100_000), "direct-push").await;
    assert!(matches!(mechanism, Delivery::DirectPush | Delivery::PushPull), "{mechanism}");
}
