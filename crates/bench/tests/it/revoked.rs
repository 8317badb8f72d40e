//! A robot is revoked while everything is under way: its session, a download, a request that is
//! being sent, and a pending next token. All of it ends at once; the robot's tasks go on, and the
//! robot reports the reason for its exclusion.

use rumqttc::{AsyncClient, ConnectReturnCode, ConnectionError, MqttOptions};
use serde_json::Value;
use task_proto::messages::report::Phase;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::harness::{
    Fleet, Robot, Server, TIMEOUT, add_ballast, eventually, from_restarted_agent, program,
};

/// More than all buffers between the server and a client that reads nothing.
const HEAVY_BYTES: usize = 64 << 20;

fn token_of(robot: &Robot) -> String {
    let identity = std::fs::read(robot.data().join("identity.json")).expect("identity");
    let identity: Value = serde_json::from_slice(&identity).expect("json");
    identity["token"].as_str().expect("a token").to_owned()
}

/// The output of `task-agent status`.
async fn status(robot: &Robot) -> Value {
    #[expect(clippy::disallowed_methods, reason = "the robot's own command line")]
    let mut command = std::process::Command::new(program("task-agent"));
    command.args(["status", "-o", "json", "--data"]).arg(robot.data());
    let output = tokio::task::spawn_blocking(move || command.output().expect("runs"))
        .await
        .expect("no panic");
    serde_json::from_slice(&output.stdout).expect("json")
}

/// The status and the code that a robot's token gets over HTTP.
async fn refused(server: &Server, robot: &str, token: &str) -> (u16, String) {
    let url = server.url(&format!("/api/v1/robots/{robot}/desired"));
    let answer =
        reqwest::Client::new().get(url).bearer_auth(token).send().await.expect("an answer");
    let status = answer.status().as_u16();
    let body: Value = answer.json().await.expect("json");
    (status, body["error"]["code"].as_str().unwrap_or_default().to_owned())
}

/// How the server answers the token over MQTT.
async fn refused_over_mqtt(server: &Server, robot: &str, token: &str) -> ConnectReturnCode {
    let mut options = MqttOptions::new(robot, server.mqtt.ip().to_string(), server.mqtt.port());
    options.set_credentials(robot, token);
    let (_client, mut events) = AsyncClient::new(options, 1);
    match tokio::time::timeout(TIMEOUT, events.poll()).await.expect("an answer") {
        Err(ConnectionError::ConnectionRefused(code)) => code,
        other => panic!("expected a refusal, got {other:?}"),
    }
}

/// A report of which only the first half comes.
async fn half_a_report(server: &Server, robot: &str, token: &str) -> TcpStream {
    let mut stream = TcpStream::connect(server.http).await.expect("listens");
    let head = format!(
        "POST /api/v1/robots/{robot}/report HTTP/1.1\r\nhost: x\r\n\
         authorization: Bearer {token}\r\ncontent-type: application/json\r\n\
         content-length: 100\r\nexpect: 100-continue\r\n\r\n"
    );
    stream.write_all(head.as_bytes()).await.expect("sent");
    // The server asks for the body once the robot is admitted.
    let mut go_on = [0; 25];
    stream.read_exact(&mut go_on).await.expect("100 Continue");
    assert!(go_on.starts_with(b"HTTP/1.1 100"), "{}", String::from_utf8_lossy(&go_on));
    stream.write_all(b"{").await.expect("sent");
    stream
}

/// Registers the first robot anew with its own command; the agent is stopped before.
async fn enroll_again(fleet: &mut Fleet) {
    let out =
        fleet.server.operate(["enroll-token", "create", "--robot", "robot-1", "--uses", "1"]).await;
    fleet.robots[0].terminate();
    let data = fleet.robots[0].data().to_owned();
    #[expect(clippy::disallowed_methods, reason = "the robot's own command line")]
    let mut enroll = std::process::Command::new(program("task-agent"));
    enroll.args([
        "enroll",
        "--force",
        "--mac",
        "02:00:00:00:00:01",
        "--server",
        &fleet.server.url(""),
        "--data",
    ]);
    enroll.arg(&data).env("TASK_AGENT_ENROLL_TOKEN", out.trim());
    let enrolled = tokio::task::spawn_blocking(move || enroll.output().expect("runs"))
        .await
        .expect("no panic");
    assert!(enrolled.status.success(), "{}", String::from_utf8_lossy(&enrolled.stderr));
}

#[tokio::test(flavor = "multi_thread")]
async fn revoked_robot_is_disconnected_and_its_task_keeps_running() {
    let mut fleet = Fleet::start(1).await;
    let steady = fleet.package("steady", "1.0.0", "service", "exec sleep 1000\n");
    fleet.server.push(&steady, "*").await;
    fleet.server.wait_phase("robot-1", "steady", Phase::Running).await;
    let heavy = fleet.package("heavy", "1.0.0", "service", "exec sleep 1000\n");
    add_ballast(&heavy, HEAVY_BYTES);
    fleet.server.operate(["push", heavy.to_str().expect("utf-8")]).await;
    // The robot itself must not download what this test downloads in its name. Its session lasts
    // half a minute.
    fleet.robots[0].freeze();
    let blob = fleet.server.push(&heavy, "*").await.package.content;
    let server = &fleet.server;
    let robot = &fleet.robots[0];
    let id = robot.id.to_string();
    let token = token_of(robot);

    let client = reqwest::Client::new();
    let url = server.url(&format!("/v2/heavy/blobs/{}", blob.digest));
    let mut download = client.get(url).bearer_auth(&token).send().await.expect("sent");
    assert_eq!(download.status(), 200);
    let mut got = download.chunk().await.expect("bytes").expect("bytes").len() as u64;
    let mut report = half_a_report(server, &id, &token).await;
    let next = client.post(server.url(&format!("/api/v1/robots/{id}/token"))).bearer_auth(&token);
    let next = from_restarted_agent(next, robot.data());
    let next: Value = next.send().await.expect("sent").json().await.expect("json");
    let next = next["token"].as_str().expect("a token").to_owned();
    assert!(server.robot("robot-1").await.expect("there").mqtt.is_some(), "it has a session");

    server.operate(["robot", "revoke", "robot-1", "--yes"]).await;

    let cut = tokio::time::timeout(TIMEOUT, async {
        loop {
            match download.chunk().await {
                Ok(Some(chunk)) => got += chunk.len() as u64,
                Ok(None) => return false,
                Err(_) => return true,
            }
        }
    });
    assert!(cut.await.expect("an end") && got < blob.size, "{got} of {} bytes came", blob.size);
    let mut rest = Vec::new();
    let ended = tokio::time::timeout(TIMEOUT, report.read_to_end(&mut rest)).await.expect("an end");
    assert!(
        ended.is_err() || rest.is_empty(),
        "the report was answered: {}",
        String::from_utf8_lossy(&rest)
    );
    eventually("the session to be gone", async || {
        server.robot("robot-1").await?.mqtt.is_none().then_some(())
    })
    .await;
    for token in [&token, &next] {
        assert_eq!(refused(server, &id, token).await, (401, "robot_revoked".to_owned()));
        assert_eq!(refused_over_mqtt(server, &id, token).await, ConnectReturnCode::NotAuthorized);
    }

    fleet.robots[0].thaw();
    let robot = &fleet.robots[0];
    let told = eventually("the robot to notice", async || {
        let status = status(robot).await;
        status["removed"].as_bool().expect("a flag").then_some(status)
    });
    let told = told.await;
    assert!(told["removed_because"].as_str().expect("a text").contains("revoked"), "{told}");
    let steady = told["tasks"]
        .as_array()
        .expect("tasks")
        .iter()
        .find(|task| task["task"] == "steady")
        .expect("there");
    assert_eq!(steady["phase"], "running", "{told}");
    let pid = steady["pid"].as_u64().expect("a pid");
    assert!(std::path::Path::new(&format!("/proc/{pid}")).exists(), "it runs on");
    let out = fleet.server.operate(["robot", "list"]).await;
    assert!(out.contains("offline revoked"), "{out}");

    // The robot comes back, and to the orders made meanwhile, once it is registered anew.
    enroll_again(&mut fleet).await;
    fleet.robots[0].restart();
    let view = fleet.server.wait_phase("robot-1", "heavy", Phase::Running).await;
    let conditions = &view.conditions;
    assert!(conditions.iter().all(|condition| condition.code != "revoked"), "{conditions:?}");
    let same = view.tasks.iter().find(|task| task.task.as_str() == "steady");
    let same_pid = same.and_then(|task| task.active.as_ref()).map(|active| u64::from(active.pid));
    assert_eq!(same_pid, Some(pid), "a running task is not started again");
}
