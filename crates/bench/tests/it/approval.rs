//! A robot enrolls with a token that requires approval: its command waits, over a restart and
//! without the token, and goes on by itself; so does an agent that was started too early. A
//! rejected robot is told so.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::path::Path;
use std::process::{ExitStatus, Stdio};

use serde_json::Value;
use task_proto::messages::report::Phase;

use crate::harness::{Robot, Server, TIMEOUT, eventually, program, write_package};

/// The output of the robot's command.
fn printed(data: &Path) -> String {
    std::fs::read_to_string(data.with_extension("enroll.log")).unwrap_or_default()
}

fn enroll(data: &Path, more: &[&str], token: Option<&str>) -> tokio::process::Child {
    let log = std::fs::File::create(data.with_extension("enroll.log")).expect("a log");
    let mut command = tokio::process::Command::new(program("task-agent"));
    command.args(["enroll", "--data"]).arg(data).args(more).stdin(Stdio::null());
    command.stdout(log.try_clone().expect("log")).stderr(log).kill_on_drop(true);
    if let Some(token) = token {
        command.env("TASK_AGENT_ENROLL_TOKEN", token);
    }
    command.spawn().expect("task-agent starts")
}

async fn wait_until_pending(data: &Path) {
    eventually("the command to wait", async || {
        printed(data).contains("is waiting for approval").then_some(())
    })
    .await;
}

async fn ended(mut child: tokio::process::Child) -> ExitStatus {
    tokio::time::timeout(TIMEOUT, child.wait()).await.expect("it ends").expect("reaped")
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_waits_for_approval_across_restarts_and_then_continues() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let token = server.operate(["enroll-token", "create", "--approval"]).await.trim().to_owned();
    let data = dir.path().join("atlas");
    let url = server.url("");
    let more = ["--server", &url, "--name", "atlas", "--mac", "02:00:00:00:00:01"];

    let mut first = enroll(&data, &more, Some(&token));
    wait_until_pending(&data).await;
    first.kill().await.expect("killed");
    let again = enroll(&data, &[], None);
    wait_until_pending(&data).await;
    // An agent that is started meanwhile has nothing, and keeps asking.
    let id = server.robot("atlas").await.expect("listed").id;
    let mut robot = Robot::enrolled(dir.path(), "atlas", id, &[]);
    robot.restart();
    eventually("the agent to be told", async || {
        let log = std::fs::read_to_string(data.with_extension("agent.log")).unwrap_or_default();
        log.contains("awaits_approval").then_some(())
    })
    .await;
    let pending: Value =
        serde_json::from_str(&server.operate(["robot", "pending", "-o", "json"]).await)
            .expect("json");
    assert_eq!(pending["robots"][0]["name"], "atlas", "{pending}");
    assert!(server.operate(["robot", "list"]).await.contains("offline awaits_approval"));

    server.operate(["robot", "approve", "atlas"]).await;
    assert!(ended(again).await.success(), "{}", printed(&data));
    assert!(printed(&data).contains("is registered at"), "{}", printed(&data));
    let package = dir.path().join("steady");
    write_package(&package, "steady", "1.0.0", "service", "exec sleep 1000\n");
    server.push(&package, "atlas").await;
    server.wait_phase("atlas", "steady", Phase::Running).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn rejected_robot_is_informed_and_forgotten() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server =
        Server::start_with(&dir.path().join("server"), &[("TASKD_ENROLMENT_APPROVAL", "true")])
            .await;
    let token = server.enrollment_token().await;
    let data = dir.path().join("atlas");
    let url = server.url("");
    let child = enroll(
        &data,
        &["--server", &url, "--name", "atlas", "--mac", "02:00:00:00:00:01"],
        Some(&token),
    );
    wait_until_pending(&data).await;
    server.operate(["robot", "reject", "atlas"]).await;
    assert!(!ended(child).await.success());
    assert!(printed(&data).contains("did not approve this robot"), "{}", printed(&data));
    assert!(!data.join("identity.json").exists());
    assert!(server.robot("atlas").await.is_none());
}
