//! Packages inside MQTT messages, with real agents: nothing is pulled but by those that can't keep
//! up, and a power cut costs time only.

use std::path::PathBuf;

use task_proto::api::{AssignmentView, DeploymentView};
use task_proto::desired::Delivery;
use task_proto::messages::report::Phase;
use tempfile::TempDir;

use crate::harness::{Fleet, Robot, Server, add_ballast, eventually, write_package};
use crate::proxy::Proxy;

const BALLAST_BYTES: usize = 8 * 1024 * 1024;
/// At this rate the package's transfer takes some seconds, in which the test can disturb the
/// transfer.
const SLOW_BYTES_PER_S: u64 = 2 * 1024 * 1024;
const FAST_BYTES_PER_S: u64 = 1 << 30;

/// Robots whose MQTT sessions and HTTP requests go through proxies.
struct Setting {
    fleet: Fleet,
    http: Proxy,
    mqtt: Proxy,
    package: PathBuf,
}

impl Setting {
    async fn start(robots: u8) -> Self {
        let dir = TempDir::new().expect("temp dir");
        let mut server = Server::start(&dir.path().join("server")).await;
        let http = Proxy::start(server.http, FAST_BYTES_PER_S).await;
        let mqtt = Proxy::start(server.mqtt, SLOW_BYTES_PER_S).await;
        server.set("TASKD_PUBLIC_MQTT_PORT", Some(&mqtt.address.port().to_string()));
        server.terminate();
        server.restart().await;
        let mut fleet = Fleet { robots: Vec::new(), server, dir };
        let url = format!("http://{}", http.address);
        for number in 1..=robots {
            let name = format!("robot-{number}");
            let robot =
                Robot::start_with(&fleet.server, fleet.dir.path(), &name, number, &url, &[]).await;
            fleet.robots.push(robot);
        }
        for robot in &fleet.robots {
            eventually("its session", async || fleet.server.robot(&robot.name).await?.mqtt).await;
        }
        let package = fleet.dir.path().join("heavy");
        write_package(&package, "heavy", "1.0.0", "service", "exec sleep 1000\n");
        add_ballast(&package, BALLAST_BYTES);
        Self { fleet, http, mqtt, package }
    }

    async fn push(&self) -> DeploymentView {
        self.fleet.server.push_with(&self.package, "*", &["--delivery", "direct-push"]).await
    }

    /// Waits until `bytes` have gone to robots over MQTT.
    async fn wait_for_parts(&self, bytes: usize) {
        eventually("parts to travel", async || {
            (self.mqtt.bytes_to_clients() > bytes as u64).then_some(())
        })
        .await;
    }

    async fn wait_running(&self, robot: &str) {
        self.fleet.server.wait_phase(robot, "heavy", Phase::Running).await;
    }

    async fn assignments(&self, ordered: &DeploymentView) -> Vec<AssignmentView> {
        let view = self.fleet.server.deployment(ordered.id.as_str()).await.expect("there");
        view.assignments.expect("asked for")
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn pushed_content_is_not_pulled() {
    let setting = Setting::start(3).await;
    let before = setting.http.bytes_to_clients();
    let ordered = setting.push().await;
    for robot in &setting.fleet.robots {
        setting.wait_running(&robot.name).await;
    }
    let pulled = setting.http.bytes_to_clients() - before;
    assert!(pulled < BALLAST_BYTES as u64 / 10, "{pulled} bytes went over HTTP");
    assert!(setting.mqtt.bytes_to_clients() > 3 * BALLAST_BYTES as u64);
    for assignment in setting.assignments(&ordered).await {
        assert_eq!(assignment.delivery.expect("decided").mechanism, Delivery::DirectPush);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn frozen_robot_does_not_delay_others_and_pulls_later() {
    let setting = Setting::start(3).await;
    let ordered = setting.push().await;
    setting.wait_for_parts(BALLAST_BYTES / 2).await;
    setting.fleet.robots[2].freeze();
    setting.wait_running("robot-1").await;
    setting.wait_running("robot-2").await;
    let told = eventually("the frozen robot to be told to pull", async || {
        let assignments = setting.assignments(&ordered).await;
        let frozen = assignments.into_iter().find(|one| one.name.as_str() == "robot-3")?.delivery?;
        (frozen.mechanism == Delivery::PushPull).then_some(frozen)
    })
    .await;
    assert_eq!(told.rule, "fell behind");
    setting.fleet.robots[2].thaw();
    setting.wait_running("robot-3").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn server_power_cut_during_fan_out_loses_nothing() {
    let mut setting = Setting::start(3).await;
    setting.push().await;
    setting.wait_for_parts(BALLAST_BYTES).await;
    setting.fleet.server.kill();
    setting.fleet.server.restart().await;
    for name in ["robot-1", "robot-2", "robot-3"] {
        setting.wait_running(name).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn late_robot_gets_the_missed_parts() {
    let mut setting = Setting::start(2).await;
    setting.fleet.robots[1].kill();
    setting.push().await;
    setting.wait_for_parts(BALLAST_BYTES / 4).await;
    setting.fleet.robots[1].restart();
    setting.wait_running("robot-1").await;
    setting.wait_running("robot-2").await;
}
