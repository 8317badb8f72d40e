//! `task-agent doctor` on a robot with a running agent and a reachable server: its findings about
//! the routes to the server, and that it disturbs neither.

use serde_json::Value;

use crate::harness::{Fleet, Robot, eventually, program};

async fn doctor(robot: &Robot) -> Value {
    #[expect(clippy::disallowed_methods, reason = "the robot's own command line")]
    let mut command = std::process::Command::new(program("task-agent"));
    command.args(["doctor", "-o", "json", "--data"]).arg(robot.data());
    let output = tokio::task::spawn_blocking(move || command.output().expect("runs"))
        .await
        .expect("no panic");
    serde_json::from_slice(&output.stdout).expect("json")
}

fn verdict(checkup: &Value, check: &str) -> String {
    let checks = checkup["checks"].as_array().expect("checks");
    let found = checks.iter().find(|found| found["check"] == check);
    found.and_then(|found| found["verdict"].as_str()).unwrap_or("absent").to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn doctor_reaches_the_server_over_http_and_mqtt() {
    let mut fleet = Fleet::start(1).await;
    // The enrollment is a request as well: it makes a robot online whose agent does not run yet.
    eventually("the agent's session", async || {
        fleet.server.robot("robot-1").await?.mqtt.is_some().then_some(())
    })
    .await;
    let checkup = doctor(&fleet.robots[0]).await;
    for check in [
        "settings",
        "data",
        "identity",
        "agent",
        "dns",
        "http",
        "clock",
        "token",
        "mqtt",
        "websocket",
    ] {
        assert_eq!(verdict(&checkup, check), "good", "{check}: {checkup}");
    }
    let before = fleet.server.robot("robot-1").await.expect("known");
    assert!(before.online, "its own session goes on");

    fleet.server.operate(["robot", "revoke", "robot-1", "--yes"]).await;
    assert_eq!(verdict(&doctor(&fleet.robots[0]).await, "token"), "bad");
    fleet.server.terminate();
    assert_eq!(verdict(&doctor(&fleet.robots[0]).await, "http"), "bad");
    fleet.robots[0].terminate();
    assert_eq!(verdict(&doctor(&fleet.robots[0]).await, "agent"), "bad");
}
