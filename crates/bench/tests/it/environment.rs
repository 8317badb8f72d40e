//! The environment of a running task: its own variables, the robot's name and labels, the order.

use std::collections::BTreeMap;

use task_proto::api::RobotView;
use task_proto::messages::report::Phase;

use crate::harness::{Fleet, eventually};

/// The environment of the running task `talker` of this robot.
fn environment(robot: &RobotView) -> Option<(u32, BTreeMap<String, String>)> {
    let pid = robot.tasks.first()?.active.as_ref()?.pid;
    let bytes = std::fs::read(format!("/proc/{pid}/environ")).ok()?;
    let text = String::from_utf8(bytes).expect("the task's environment is text");
    let pairs = text.split_terminator('\0').filter_map(|pair| pair.split_once('='));
    Some((pid, pairs.map(|(name, value)| (name.to_owned(), value.to_owned())).collect()))
}

#[tokio::test(flavor = "multi_thread")]
async fn task_knows_its_robot_and_order_and_a_new_label_restarts_nothing() {
    let fleet = Fleet::start(1).await;
    let robot = &fleet.robots[0];
    fleet.server.operate(["robot", "label", "robot-1", "site=lab", "rack.no=7"]).await;
    let package = fleet.package("talker", "1.0.0", "service", "exec sleep 1000\n");
    // The ROS setup of a package replaces what the agent has set; the package's own variables last.
    std::fs::write(package.join("local_setup.bash"), "export GREETING=hidden TZ=CET\n")
        .expect("written");
    let toml = std::fs::read_to_string(package.join("task.toml")).expect("readable");
    let own = "[run.env]\nGREETING = \"it's $HOME\"\nLANG = \"de_DE.UTF-8\"\n";
    std::fs::write(package.join("task.toml"), toml + own).expect("written");
    let deployment = fleet.server.push(&package, "*").await;
    let view = fleet.server.wait_phase("robot-1", "talker", Phase::Running).await;
    let (pid, found) = environment(&view).expect("a process");
    let expected = |name: &str| match name {
        "TASKD_ROBOT" => "robot-1".to_owned(),
        "TASKD_ROBOT_ID" => robot.id.to_string(),
        "TASKD_TASK" => "talker".to_owned(),
        "TASKD_VERSION" => "1.0.0".to_owned(),
        "TASKD_DEPLOYMENT" => deployment.id.to_string(),
        "TASKD_LABEL_SITE" => "lab".to_owned(),
        "TASKD_LABEL_RACK_NO" => "7".to_owned(),
        "GREETING" => "it's $HOME".to_owned(),
        "LANG" => "de_DE.UTF-8".to_owned(),
        "TZ" => "CET".to_owned(),
        other => panic!("{other} is not expected"),
    };
    let names = [
        "TASKD_ROBOT",
        "TASKD_ROBOT_ID",
        "TASKD_TASK",
        "TASKD_VERSION",
        "TASKD_DEPLOYMENT",
        "TASKD_LABEL_SITE",
        "TASKD_LABEL_RACK_NO",
        "GREETING",
        "LANG",
        "TZ",
    ];
    for name in names {
        assert_eq!(found.get(name), Some(&expected(name)), "{name}");
    }

    let generation = view.generation;
    fleet.server.operate(["robot", "label", "robot-1", "site=yard", "rack.no-"]).await;
    let told = eventually("the robot to have the new labels", async || {
        let view = fleet.server.robot("robot-1").await?;
        (view.observed_generation > generation).then_some(view)
    })
    .await;
    let (same, kept) = environment(&told).expect("a process");
    assert_eq!((same, &kept["TASKD_LABEL_SITE"][..]), (pid, "lab"));
    fleet.server.operate(["restart", "talker", "--on", "*"]).await;
    eventually("a process that was started with the new labels", async || {
        let (next, found) = environment(&fleet.server.robot("robot-1").await?)?;
        let is_new = next != pid && found.get("TASKD_LABEL_SITE")? == "yard";
        (is_new && !found.contains_key("TASKD_LABEL_RACK_NO")).then_some(())
    })
    .await;
}
