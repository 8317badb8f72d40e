//! An administrator's settings for a robot at the server take effect on the robot, without a
//! restart, and later without a server.

use nix::sys::signal::Signal;
use task_proto::messages::report::Phase;

use crate::harness::eventually;
use crate::ros::{Stage, activate, pid_of};

const READY: &str = "[ready]\nhold_s = 0\ntimeout_s = 60\nservices = ['/say']\n";

#[tokio::test(flavor = "multi_thread")]
async fn robot_takes_its_ros_settings_from_the_server() {
    let mut stage = Stage::with(|_| vec![("TASK_AGENT_VITALS_INTERVAL_S", "1".to_owned())]).await;
    stage.build().await;
    let underlays = format!("underlays={}", activate());
    let domain = format!("ros_domain_id={}", stage.domain.id);
    stage.server.operate(["robot", "edit", "robot-1", "--set", &underlays, "--set", &domain]).await;
    stage.push("talker", "--node talker --service /say", READY).await;
    let before = pid_of(&stage.runs("talker").await);
    assert_eq!(stage.say("/say").await, "0.05", "as a client in that domain hears");
    let effective =
        stage.server.robot("robot-1").await.expect("a robot").effective_settings.expect("said");
    assert_eq!(
        effective.values.ros_domain_id.map(|id| id.to_string()).as_ref(),
        Some(&stage.domain.id)
    );
    assert!(effective.own.is_empty() && effective.refused.is_empty(), "{effective:?}");
    eventually("how its machine does", async || {
        let vitals = stage.server.robot("robot-1").await?.vitals?;
        (vitals.memory_total_bytes? > vitals.memory_used_bytes? && vitals.cpu_percent? <= 100.0)
            .then_some(())
    })
    .await;

    // All of them die, and there is no server when the agent is back: the settings are known, and
    // the task runs by them.
    stage.server.kill();
    stage.robot.kill();
    stage.signal("talker", Signal::SIGKILL);
    stage.robot.restart();
    assert_eq!(stage.say("/say").await, "0.05", "by a new process");
    stage.server.restart().await;
    eventually("the new process to be known", async || {
        let task = stage.task("talker").await?;
        let runs = task.phase == Phase::Running && task.degraded.is_none();
        (runs && task.active.as_ref()?.pid != before).then_some(())
    })
    .await;
}
