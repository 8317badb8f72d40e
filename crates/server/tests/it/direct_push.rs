//! Packages inside MQTT messages, from the operator's order to the robots' last byte: robots that
//! stall, miss parts, come late or lose their right, and a server that restarts.

use std::collections::BTreeMap;
use std::time::Duration;

use reqwest::StatusCode;
use rumqttc::{AsyncClient, Event, EventLoop, MqttOptions, Packet, QoS, SubscribeReasonCode};
use serde_json::json;
use task_proto::api::DeploymentView;
use task_proto::desired::{Delivery, DesiredState, PackageRef};
use task_proto::messages::part::{Part, PartRange};
use task_proto::messages::report::Phase;
use task_proto::messages::topic::{Topic, TopicPrefix};
use taskd::config::Config;
use tempfile::TempDir;
use tokio::time::timeout;

use crate::harness::{TestRobot, TestServer, answer, archive_with};

/// Time limit that only a hanging test exceeds.
const PATIENCE: Duration = Duration::from_secs(40);
/// Quiet time after which a robot reports its missing parts.
const QUIET: Duration = Duration::from_millis(500);
const CONTENT_BYTES: usize = 4 * 1024 * 1024 + 17;

fn content() -> Vec<u8> {
    let bytes: Vec<u8> = (0..CONTENT_BYTES).map(|at| (at % 251) as u8).collect();
    archive_with(&bytes)
}

async fn deploy(
    server: &TestServer,
    package: &PackageRef,
    selector: &str,
    key: &str,
) -> DeploymentView {
    let body = json!({
        "package": package.name, "manifest": package.manifest.digest, "selector": selector,
        "delivery": "direct-push",
    });
    answer(server.order("/api/v1/deployments", key, &body)).await
}

async fn deployment(server: &TestServer, ordered: &DeploymentView) -> DeploymentView {
    server.get(&format!("/api/v1/deployments/{}", ordered.id)).await
}

/// A robot with an MQTT session that gathers parts.
struct Hearer {
    robot: TestRobot,
    client: AsyncClient,
    events: EventLoop,
    package: PackageRef,
    got: BTreeMap<u32, Vec<u8>>,
    count: u32,
    messages: usize,
}

impl Hearer {
    fn connect(server: &TestServer, robot: TestRobot, package: &PackageRef) -> Self {
        let address: std::net::SocketAddr =
            server.server.addresses().mqtt.parse().expect("an address");
        let mut options =
            MqttOptions::new(robot.id.as_str(), address.ip().to_string(), address.port());
        options
            .set_credentials(robot.id.as_str(), &robot.token)
            .set_max_packet_size(512 << 20, 1 << 20);
        let (client, events) = AsyncClient::new(options, 10);
        Self {
            robot,
            client,
            events,
            package: package.clone(),
            got: BTreeMap::new(),
            count: u32::MAX,
            messages: 0,
        }
    }

    /// Subscribes to the parts, and returns whether the subscription is granted.
    async fn subscribe(&mut self, qos: QoS) -> bool {
        let topic = TopicPrefix::default().format(&Topic::Package(self.package.content.digest));
        self.client.subscribe(topic, qos).await.expect("queued");
        loop {
            if let Event::Incoming(Packet::SubAck(ack)) =
                self.events.poll().await.expect("a session")
            {
                return ack.return_codes == [SubscribeReasonCode::Success(qos)];
            }
        }
    }

    /// Subscribes until the subscription is granted.
    async fn listen(&mut self, qos: QoS) {
        while !self.subscribe(qos).await {
            tokio::task::yield_now().await;
        }
    }

    /// Hears one part, unless nothing comes for a while.
    async fn hear(&mut self) -> Option<u32> {
        loop {
            match timeout(QUIET, self.events.poll()).await.ok()?.expect("a session") {
                Event::Incoming(Packet::Publish(message)) => {
                    let part =
                        Part::decode(&message.payload, self.package.content.size).expect("a part");
                    self.count = part.count;
                    self.messages += 1;
                    self.got.insert(part.index, part.bytes.to_vec());
                    return Some(part.index);
                }
                _ => continue,
            }
        }
    }

    /// Receives until all parts have arrived, and requests the missing parts when nothing comes.
    async fn gather(&mut self, server: &TestServer) {
        while self.got.len() < self.count as usize {
            if self.hear().await.is_none() {
                let all = if self.count == u32::MAX { 1 << 16 } else { self.count };
                let missing =
                    PartRange::runs((0..all).filter(|index| !self.got.contains_key(index)));
                self.report(server, Phase::Fetching, Some(missing)).await;
            }
        }
        let whole: Vec<u8> = self.got.values().flatten().copied().collect();
        assert!(whole == content(), "other bytes came");
        self.report(server, Phase::Running, None).await;
    }

    async fn report(&mut self, server: &TestServer, phase: Phase, missing: Option<Vec<PartRange>>) {
        let state: DesiredState = server.desired(&self.robot).await;
        let mut report = self.robot.next_report(&state, phase);
        report.tasks.iter_mut().for_each(|task| task.missing_parts = missing.clone());
        let path = format!("/api/v1/robots/{}/report", self.robot.id);
        let request =
            server.bare(reqwest::Method::POST, &path).bearer_auth(&self.robot.token).json(&report);
        assert_eq!(request.send().await.expect("an answer").status(), StatusCode::OK);
    }
}

async fn server_with(configure: impl FnOnce(&mut Config)) -> (TestServer, PackageRef) {
    let server = TestServer::start_in(TempDir::new().expect("a directory"), configure).await;
    let package = server.push_content("talker", "1.0.0", content()).await;
    (server, package)
}

#[tokio::test(flavor = "multi_thread")]
async fn stalled_robots_are_told_to_pull_while_others_finish() {
    let (server, package) = server_with(|_| {}).await;
    let mut hearers = Vec::new();
    for name in ["quick", "lossy", "late", "stalled"] {
        hearers.push(Hearer::connect(&server, server.enroll(name).await, &package));
    }
    let ordered = deploy(&server, &package, "*", "key-1").await;
    let [mut quick, mut lossy, mut late, mut stalled] = hearers.try_into().ok().expect("four");
    assert_eq!(server.desired(&quick.robot).await.tasks[0].delivery, Delivery::DirectPush);
    let all = async {
        tokio::join!(
            quick.listen(QoS::AtLeastOnce),
            lossy.listen(QoS::AtLeastOnce),
            stalled.listen(QoS::AtLeastOnce)
        );
        // From here on the last one reads nothing, and acknowledges nothing.
        while quick.hear().await.is_none() {}
        tokio::join!(
            quick.gather(&server),
            async {
                for _ in 0..10 {
                    let heard = lossy.hear().await;
                    heard.filter(|index| index % 3 == 0).and_then(|index| lossy.got.remove(&index));
                }
                lossy.gather(&server).await;
            },
            async {
                late.listen(QoS::AtLeastOnce).await;
                late.gather(&server).await;
            }
        );
        loop {
            let view = deployment(&server, &ordered).await;
            let assignments = view.assignments.expect("asked for");
            let of = |name: &str| {
                assignments.iter().find(|one| one.name.as_str() == name).expect("there").clone()
            };
            let decision = of("stalled").delivery.expect("decided");
            if decision.mechanism == Delivery::PushPull {
                assert_eq!(
                    (decision.rule.as_str(), decision.because.as_str()),
                    ("fell behind", "the robot held up the others")
                );
                for name in ["quick", "lossy", "late"] {
                    let one = of(name);
                    assert_eq!(
                        (one.phase, one.delivery.expect("decided").mechanism),
                        (Phase::Running, Delivery::DirectPush)
                    );
                }
                return;
            }
        }
    };
    timeout(PATIENCE, all).await.expect("all should settle");
    let state = server.desired(&stalled.robot).await;
    assert_eq!(state.tasks[0].delivery, Delivery::PushPull, "a new state says so");
}

#[tokio::test(flavor = "multi_thread")]
async fn only_robots_of_the_order_receive_parts_until_it_ends() {
    let (server, package) = server_with(|_| {}).await;
    let mut meant = Hearer::connect(&server, server.enroll("meant").await, &package);
    let mut other = Hearer::connect(&server, server.enroll("other").await, &package);
    let all = async {
        assert!(!meant.subscribe(QoS::AtLeastOnce).await, "there is no order yet");
        let ordered = deploy(&server, &package, "meant", "key-1").await;
        meant.listen(QoS::AtLeastOnce).await;
        assert!(!other.subscribe(QoS::AtLeastOnce).await);
        while meant.hear().await.is_none() {}
        let cancelled = server.order(
            &format!("/api/v1/deployments/{}/cancel", ordered.id),
            "key-2",
            &json!({}),
        );
        assert!(cancelled.send().await.expect("an answer").status().is_success());
        while meant.subscribe(QoS::AtLeastOnce).await {
            tokio::task::yield_now().await;
        }
        // Parts that were already under way have been received; no more come, and the robot's
        // request is not in vain.
        meant.report(&server, Phase::Fetching, Some(vec![PartRange { from: 0, to: 9 }])).await;
        assert_eq!(meant.hear().await, None);
        assert_eq!((other.hear().await, other.messages), (None, 0));
    };
    timeout(PATIENCE, all).await.expect("it should end");
}

#[tokio::test(flavor = "multi_thread")]
async fn interrupted_fan_out_begins_again_after_a_restart() {
    let (server, package) = server_with(|_| {}).await;
    let robot = server.enroll("patient").await;
    let again = TestRobot::new(robot.id.clone(), robot.token.clone());
    let ordered = deploy(&server, &package, "*", "key-1").await;
    let mut hearer = Hearer::connect(&server, robot, &package);
    let some = async {
        hearer.listen(QoS::AtLeastOnce).await;
        while hearer.hear().await.is_none() {}
    };
    timeout(PATIENCE, some).await.expect("parts come");
    drop(hearer);
    let server = server.restart().await;
    let mut hearer = Hearer::connect(&server, again, &package);
    let rest = async {
        hearer.listen(QoS::AtLeastOnce).await;
        hearer.gather(&server).await;
    };
    timeout(PATIENCE, rest).await.expect("the rest comes");
    let view = deployment(&server, &ordered).await;
    assert_eq!(view.assignments.expect("asked for")[0].phase, Phase::Running);
}

#[tokio::test(flavor = "multi_thread")]
async fn package_in_one_message_works_with_any_qos() {
    for (ours, its) in [(0, QoS::AtMostOnce), (1, QoS::AtLeastOnce), (2, QoS::ExactlyOnce)] {
        let configure = |config: &mut Config| {
            config.delivery.part_bytes = task_proto::messages::part::MAX_PART_BYTES;
            config.delivery.qos = ours;
        };
        let (server, package) = server_with(configure).await;
        let mut hearer = Hearer::connect(&server, server.enroll("atlas").await, &package);
        deploy(&server, &package, "*", "key-1").await;
        let all = async {
            hearer.listen(its).await;
            hearer.gather(&server).await;
        };
        timeout(PATIENCE, all).await.expect("it should come");
        assert_eq!((hearer.count, hearer.messages), (1, 1));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_that_never_subscribes_is_told_to_pull() {
    let (server, package) = server_with(|_| {}).await;
    let robot = server.enroll("atlas").await;
    let ordered = deploy(&server, &package, "*", "key-1").await;
    let before = server.desired(&robot).await;
    let told = async {
        loop {
            let assignments = deployment(&server, &ordered).await.assignments.expect("asked for");
            let decision = assignments[0].delivery.clone().expect("decided");
            if decision.mechanism == Delivery::PushPull {
                return decision.because;
            }
        }
    };
    assert_eq!(
        timeout(PATIENCE, told).await.expect("it should be told"),
        "the robot did not subscribe for 10 s"
    );
    let after = server.desired(&robot).await;
    assert!(after.generation > before.generation && after.tasks[0].delivery == Delivery::PushPull);
}
