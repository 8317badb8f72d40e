//! A robot on MQTT: the robot is told its desired state, its reports are stored before they are
//! acknowledged, and the operator sees the robot come and go.

use std::time::Duration;

use reqwest::Method;
use rumqttc::{AsyncClient, Event, EventLoop, MqttOptions, Packet, QoS};
use serde_json::{Value, json};
use task_proto::api::{RobotToken, ServerInfo};
use task_proto::desired::{DesiredNotice, DesiredState};
use task_proto::messages::report::{Condition, MAX_REPORT_BYTES, Phase};
use taskd::store::{Store, sqlite_url};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::harness::{TestRobot, TestServer, answer, opened, refusal};

/// Time limit that only a hanging test exceeds.
const PATIENCE: Duration = Duration::from_secs(10);

/// A robot's MQTT session.
pub struct Session {
    client: AsyncClient,
    packets: EventLoop,
    topics: String,
}

impl Session {
    pub async fn open(server: &TestServer, robot: &TestRobot) -> Self {
        Self::open_at(&server.server.addresses().mqtt, robot.id.as_str(), &robot.token).await
    }

    /// The same with the server's MQTT address, `host:port`, and the robot's own details.
    pub async fn open_at(address: &str, id: &str, token: &str) -> Self {
        let mut session = Self::dial_at(address, id, token);
        session.until(|packet| matches!(packet, Packet::ConnAck(_))).await;
        session
            .client
            .subscribe(format!("{}/desired", session.topics), QoS::AtLeastOnce)
            .await
            .expect("queued");
        session
    }

    fn dial(server: &TestServer, id: &str, token: &str) -> Self {
        Self::dial_at(&server.server.addresses().mqtt, id, token)
    }

    fn dial_at(address: &str, id: &str, token: &str) -> Self {
        let (host, port) = address.rsplit_once(':').expect("host:port");
        let mut options = MqttOptions::new(id, host, port.parse().expect("a port"));
        options.set_credentials(id, token).set_max_packet_size(256 * 1024, 2 * MAX_REPORT_BYTES);
        let (client, packets) = AsyncClient::new(options, 16);
        Self { client, packets, topics: format!("taskd/v1/r/{id}") }
    }

    async fn is_let_in(server: &TestServer, robot: &TestRobot, token: &str) -> bool {
        let mut session = Self::dial(server, robot.id.as_str(), token);
        tokio::time::timeout(PATIENCE, session.packets.poll()).await.expect("an answer").is_ok()
    }

    async fn hung_up(&mut self) {
        let hung_up =
            tokio::time::timeout(PATIENCE, async { while self.packets.poll().await.is_ok() {} });
        hung_up.await.expect("the connection ends");
    }

    async fn until(&mut self, mut wanted: impl FnMut(&Packet) -> bool) -> Packet {
        tokio::time::timeout(PATIENCE, async {
            loop {
                if let Event::Incoming(packet) = self.packets.poll().await.expect("connected")
                    && wanted(&packet)
                {
                    return packet;
                }
            }
        })
        .await
        .expect("the packet comes")
    }

    /// Publishes on one of the robot's topics, and waits for the acknowledgement.
    pub async fn publish(&mut self, topic: &str, payload: Vec<u8>) {
        let topic = format!("{}/{topic}", self.topics);
        self.client.publish(topic, QoS::AtLeastOnce, false, payload).await.expect("queued");
        self.until(|packet| matches!(packet, Packet::PubAck(_))).await;
    }

    /// The next question to the robot.
    pub async fn asked(&mut self) -> Value {
        let topic = format!("{}/request", self.topics);
        self.client.subscribe(&topic, QoS::AtLeastOnce).await.expect("queued");
        let question = self
            .until(|packet| matches!(packet, Packet::Publish(publish) if publish.topic == topic))
            .await;
        let Packet::Publish(question) = question else { panic!("a question is published") };
        serde_json::from_slice(&question.payload).expect("json")
    }

    /// Answers each question with the result of `reply`, as long as the returned future is polled.
    /// When this function returns, the robot can be asked.
    pub async fn answer_all(
        mut self,
        reply: impl Fn(&[u8]) -> Vec<u8>,
    ) -> impl Future<Output = ()> {
        let topic = format!("{}/request", self.topics);
        self.client.subscribe(&topic, QoS::AtLeastOnce).await.expect("queued");
        // The broker handles packets in order: the acknowledgement comes after the subscription.
        let status =
            json!({ "online": true, "start": 1, "instance": "i00000000000000c3", "connection": 1 });
        self.publish("status", status.to_string().into_bytes()).await;
        async move {
            loop {
                // The server may be stopped before the robot is.
                let Ok(event) = self.packets.poll().await else { return };
                if let Event::Incoming(Packet::Publish(question)) = event
                    && question.topic == topic
                {
                    let reply = reply(&question.payload);
                    let topic = format!("{}/reply", self.topics);
                    self.client
                        .publish(topic, QoS::AtLeastOnce, false, reply)
                        .await
                        .expect("queued");
                }
            }
        }
    }

    /// Announces that the robot leaves, and returns when the broker has closed the connection.
    pub async fn leave(mut self) {
        self.client.disconnect().await.expect("queued");
        self.hung_up().await;
    }

    /// The next desired state that arrives, from `generation` on.
    async fn told(&mut self, server: &TestServer, generation: u64) -> DesiredState {
        loop {
            let Packet::Publish(publish) =
                self.until(|packet| matches!(packet, Packet::Publish(_))).await
            else {
                continue;
            };
            assert_eq!(publish.topic, format!("{}/desired", self.topics));
            let Ok(DesiredNotice::State { envelope, .. }) =
                serde_json::from_slice(&publish.payload)
            else {
                panic!("the whole state fits into a message");
            };
            let state = opened(server, &envelope).await;
            if state.generation.0 >= generation {
                return state;
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn connected_robot_gets_its_state_and_its_report_is_stored_before_the_puback() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let mut session = Session::open(&server, &robot).await;
    let first = session.told(&server, 0).await;
    assert!(first.tasks.is_empty());
    server.deploy(&package, "*", "key-1").await;
    let state = session.told(&server, first.generation.0 + 1).await;
    assert_eq!(state.tasks[0].package, package);

    let report = serde_json::to_vec(&robot.next_report(&state, Phase::Running)).expect("json");
    let topic = format!("{}/report", session.topics);
    session.client.publish(topic, QoS::AtLeastOnce, false, report).await.expect("queued");
    session.until(|packet| matches!(packet, Packet::PubAck(_))).await;
    let view = server.robot(&robot).await;
    assert_eq!(view.tasks[0].phase, Phase::Running);
    assert!(view.online && view.address.is_some());
    let mqtt = view.mqtt.expect("connected");
    assert_eq!((mqtt.traffic.messages_in, mqtt.traffic.acks_out), (1, 1));
    assert!(mqtt.since_ms > 0 && mqtt.traffic.bytes_out > 0);
    let info: ServerInfo = server.get("/api/v1/server").await;
    assert_eq!((info.traffic.robots_connected, info.traffic.connections_accepted), (1, 1));
}

#[tokio::test(flavor = "multi_thread")]
async fn report_of_an_old_generation_gets_the_state_again() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let mut session = Session::open(&server, &robot).await;
    let first = session.told(&server, 0).await;
    server.deploy(&package, "*", "key-1").await;
    let state = session.told(&server, first.generation.0 + 1).await;
    let report = serde_json::to_vec(&robot.next_report(&first, Phase::Running)).expect("json");
    session
        .client
        .publish(format!("{}/report", session.topics), QoS::AtLeastOnce, false, report)
        .await
        .expect("queued");
    assert_eq!(session.told(&server, state.generation.0).await.generation, state.generation);
}

#[tokio::test(flavor = "multi_thread")]
async fn largest_report_is_stored_and_acknowledged() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let mut session = Session::open(&server, &robot).await;
    let state = session.told(&server, 0).await;
    let mut report = serde_json::to_vec(&robot.next_report(&state, Phase::Running)).expect("json");
    // Trailing spaces behind a value are still valid JSON.
    report.resize(MAX_REPORT_BYTES, b' ');
    session.publish("report", report).await;
    assert!(server.robot(&robot).await.host.is_some());
}

#[tokio::test(flavor = "multi_thread")]
async fn report_fields_are_trimmed_to_their_limits() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let state = server.desired(&robot).await;
    let mut report = robot.next_report(&state, Phase::Running);
    let text = "\u{1b}ä".repeat(500);
    report.conditions = vec![Condition { code: text.clone(), text: text.clone() }; 40];
    report.host.hostname = text.clone();
    report.host.ros_distros = vec![text; 40];
    assert_eq!(server.send_report(&robot, &report).await.status(), 200);
    let view = server.robot(&robot).await;
    assert_eq!(view.conditions.len(), 32);
    let Condition { code, text } = &view.conditions[31];
    assert_eq!((code.chars().count(), text.as_str()), (64, " ä".repeat(250).as_str()));
    let host = view.host.expect("it has reported");
    assert_eq!((host.hostname.chars().count(), host.ros_distros.len()), (200, 32));
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_messages_are_acknowledged_and_dropped() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let other = server.enroll("boreas").await;
    let mut session = Session::open(&server, &robot).await;
    let state = session.told(&server, 0).await;
    let mut forged = robot.next_report(&state, Phase::Running);
    forged.robot_id = other.id.clone();
    for payload in [b"nonsense".to_vec(), Vec::new(), serde_json::to_vec(&forged).expect("json")] {
        let topic = format!("{}/report", session.topics);
        session.client.publish(topic, QoS::AtLeastOnce, false, payload).await.expect("queued");
        session.until(|packet| matches!(packet, Packet::PubAck(_))).await;
    }
    assert_eq!(server.robot(&other).await.host, None);
}

#[tokio::test(flavor = "multi_thread")]
async fn removed_robot_is_disconnected_and_not_admitted_again() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let mut session = Session::open(&server, &robot).await;
    session.told(&server, 0).await;
    let path = format!("/api/v1/robots/{}", robot.id);
    server.request(Method::DELETE, &path).send().await.expect("an answer");
    session.hung_up().await;
    assert!(!Session::is_let_in(&server, &robot, &robot.token).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn new_token_ends_the_old_session_at_its_first_use() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let mut session = Session::open(&server, &robot).await;
    let state = session.told(&server, 0).await;
    let path = format!("/api/v1/robots/{}/token", robot.id);
    let next = async |token: &str| -> RobotToken {
        answer(server.bare(Method::POST, &path).bearer_auth(token)).await
    };
    let report = serde_json::to_vec(&robot.next_report(&state, Phase::Running)).expect("json");
    let over_http = next(&robot.token).await.token;
    session
        .client
        .publish(format!("{}/report", session.topics), QoS::AtLeastOnce, false, report)
        .await
        .expect("queued");
    session.until(|packet| matches!(packet, Packet::PubAck(_))).await;

    // Used over HTTP: a client connected with the old token is disconnected and not admitted again.
    let old = std::mem::replace(&mut robot.token, over_http);
    server.desired(&robot).await;
    session.hung_up().await;
    assert_eq!(
        refusal(server.bare(Method::POST, &path).bearer_auth(&old)).await,
        (401, "unauthorized".to_owned())
    );
    assert!(!Session::is_let_in(&server, &robot, &old).await);

    // Used over MQTT: the new session takes over the old one.
    let over_mqtt = next(&robot.token).await.token;
    let mut session = Session::open(&server, &robot).await;
    session.told(&server, 0).await;
    let old = std::mem::replace(&mut robot.token, over_mqtt);
    let mut newer = Session::open(&server, &robot).await;
    newer.told(&server, 0).await;
    session.hung_up().await;
    assert!(!Session::is_let_in(&server, &robot, &old).await);
    assert!(server.report(&mut robot, &state, Phase::Running).await.status().is_success());
}

#[tokio::test(flavor = "multi_thread")]
async fn new_token_ends_the_old_session_even_if_its_first_request_is_aborted() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let mut session = Session::open(&server, &robot).await;
    session.told(&server, 0).await;
    let path = format!("/api/v1/robots/{}", robot.id);
    let next: RobotToken =
        answer(server.bare(Method::POST, &format!("{path}/token")).bearer_auth(&robot.token)).await;
    let requests = async || server.get::<ServerInfo>("/api/v1/server").await.http.requests;
    // During another write the token is not marked as used.
    let store = Store::open(&sqlite_url(&server.data().join("taskd.sqlite"))).await.expect("opens");
    let write = store.begin().await.expect("begins");
    let mut counted = requests().await;
    let request = format!(
        "GET {path}/desired HTTP/1.1\r\nHost: taskd\r\nAuthorization: Bearer {}\r\n\r\n",
        next.token
    );
    let mut line = TcpStream::connect(&server.server.addresses().http).await.expect("listens");
    line.write_all(request.as_bytes()).await.expect("sent");
    // Until this request is under way, only the counting requests arrive.
    while requests().await == counted + 1 {
        counted += 1;
    }
    line.shutdown().await.expect("hung up");
    assert_eq!(line.read(&mut [0]).await.expect("an end"), 0, "nobody answers it any more");
    drop(write);
    session.hung_up().await;
    assert!(!Session::is_let_in(&server, &robot, &robot.token).await);
}

/// A robot and another machine with its identity, which displace each other.
async fn two_of_one(server: &TestServer) -> (TestRobot, TestRobot) {
    let mut robot = server.enroll("atlas").await;
    let mut clone = TestRobot::new(robot.id.clone(), robot.token.clone());
    let state = server.desired(&robot).await;
    for _ in 0..3 {
        server.report(&mut robot, &state, Phase::Running).await;
        server.report(&mut clone, &state, Phase::Running).await;
    }
    (robot, clone)
}

#[tokio::test(flavor = "multi_thread")]
async fn instances_that_displace_each_other_get_no_more_work() {
    let server = TestServer::start().await;
    let (robot, _clone) = two_of_one(&server).await;
    let refused = server.ask_desired(&robot).await;
    assert_eq!(refused.status(), 409);
    let body: serde_json::Value = refused.json().await.expect("json");
    assert_eq!(body["error"]["code"], "duplicate_identity");
    assert_eq!(server.robot(&robot).await.conditions[0].code, "duplicate_identity");
    server.clock.advance_ms(10 * 60 * 1000);
    assert_eq!(server.ask_desired(&robot).await.status(), 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn first_use_of_a_token_over_mqtt_ends_sessions_of_the_old_one() {
    let server = TestServer::start().await;
    let (mut robot, clone) = two_of_one(&server).await;
    let path = format!("/api/v1/robots/{}", robot.id);
    let request = format!(
        "GET {path}/desired HTTP/1.1\r\nHost: taskd\r\nAuthorization: Bearer {}\r\n\r\n",
        clone.token
    );
    let mut line = TcpStream::connect(&server.server.addresses().http).await.expect("listens");
    line.write_all(request.as_bytes()).await.expect("sent");
    let mut status = [0; 12];
    line.read_exact(&mut status).await.expect("an answer");
    assert_eq!(&status, b"HTTP/1.1 409");

    let next: RobotToken =
        answer(server.bare(Method::POST, &format!("{path}/token")).bearer_auth(&robot.token)).await;
    robot.token = next.token;
    let mut session = Session::open(&server, &robot).await;
    session.told(&server, 0).await;
    // A reset counts as an end as well.
    let _ = tokio::time::timeout(PATIENCE, line.read_to_end(&mut Vec::new()))
        .await
        .expect("the old connection is cut");
    assert_eq!(server.ask_desired(&clone).await.status(), 401);
    assert_eq!(server.ask_desired(&robot).await.status(), 200);
    assert!(
        server
            .robot(&robot)
            .await
            .conditions
            .iter()
            .all(|condition| condition.code != "duplicate_identity")
    );
    // The new session has not been displaced meanwhile.
    session.publish("status", b"{}".to_vec()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn enrollment_token_or_foreign_robot_name_is_refused() {
    let server = TestServer::start().await;
    let (robot, other) = (server.enroll("atlas").await, server.enroll("boreas").await);
    let token: task_proto::api::EnrollmentToken =
        server.post("/api/v1/enrollment-tokens", &json!({})).await;
    for (id, token) in [(other.id.as_str(), &robot.token), (robot.id.as_str(), &token.token)] {
        let mut session = Session::dial(&server, id, token);
        assert!(
            tokio::time::timeout(PATIENCE, session.packets.poll())
                .await
                .expect("an answer")
                .is_err()
        );
    }
}
