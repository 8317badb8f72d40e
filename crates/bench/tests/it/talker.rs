//! The foundation's promise: a real ROS 2 package travels from a directory to two robots, is built
//! there, runs and reports.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::path::Path;

use task_proto::messages::report::Phase;

use crate::harness::{Robot, Server, eventually, required};
use crate::leftovers::processes_with;

/// Calls the Trigger service `name` from a real rclpy node and gives the answer's text.
pub async fn trigger(venv: &Path, domain: &str, name: &str) -> String {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/trigger.py");
    let output = tokio::process::Command::new(venv.join("bin/python3"))
        .arg(script)
        .arg(name)
        .env("ROS_DOMAIN_ID", domain)
        .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        .output();
    let output = output.await.expect("python3 runs");
    let text = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    assert!(output.status.success(), "{name}: {text}\n{}", String::from_utf8_lossy(&output.stderr));
    text
}

#[tokio::test(flavor = "multi_thread")]
async fn talker_runs_on_two_robots_and_answers() {
    let venv = required("TASKD_TEST_ROS");
    let venv = Path::new(&venv);
    let activate = venv.join("bin/activate");
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let mut robots = Vec::new();
    for (number, domain) in [(1, "71"), (2, "72")] {
        let settings = [
            ("TASK_AGENT_UNDERLAYS", activate.to_str().expect("utf-8")),
            ("TASK_AGENT_ROS_DOMAIN_ID", domain),
        ];
        let name = format!("robot-{number}");
        robots.push(
            Robot::start_with(&server, dir.path(), &name, number, &server.url(""), &settings).await,
        );
    }
    let talker = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/talker");
    let talker = talker.to_str().expect("utf-8");
    let out = server
        .operate(["push", talker, "--to", "*", "--wait", "--timeout", "10m", "-o", "json"])
        .await;
    assert!(out.contains("\"running\""), "{out}");

    for domain in ["71", "72"] {
        let answer = trigger(venv, domain, "/say").await;
        assert!(!answer.is_empty());
    }

    // The same tree again: the same digest, and not a blob travels.
    let again = server.try_operate(["push", talker, "--to", "*", "--yes", "-o", "json"]).await;
    let manifest = |text: &[u8]| {
        serde_json::from_slice::<serde_json::Value>(text).expect("json")["package"]["manifest"]
            .clone()
    };
    assert_eq!(manifest(&again.stdout), manifest(out.as_bytes()));
    let progress = String::from_utf8_lossy(&again.stderr);
    assert!(progress.contains("nothing to upload"), "{progress}");

    server.operate(["stop", "talker", "--on", "*", "--yes"]).await;
    for robot in &robots {
        server.wait_phase(&robot.name, "talker", Phase::Stopped).await;
    }
    let data = dir.path().to_str().expect("utf-8").as_bytes().to_owned();
    eventually("every process of the task to be gone", async || {
        let left = processes_with(b"TASKD_ASSIGNMENT=");
        let ours = processes_with(&data);
        (!left.iter().any(|pid| ours.contains(pid))).then_some(())
    })
    .await;
}
