//! Robots that misbehave: slowed on their own connection, cut off, banned and shown, until the
//! penalty expires. Other clients notice nothing.

use std::time::Duration;

use reqwest::{Method, Response};
use task_proto::RobotId;
use task_proto::api::{RobotView, ServerInfo};
use task_proto::messages::report::Phase;
use task_proto::messages::topic::RobotTopic;
use taskd::domain::limits::robot_limiter::RobotLimits;
use tempfile::TempDir;
use tokio::io::AsyncWriteExt as _;
use tokio::time::timeout;

use crate::harness::{TestRobot, TestServer};
use crate::mqtt_harness::{Connect, PATIENCE, TestBroker, framed, publish, subscribe, topic};

const HOUR: Duration = Duration::from_secs(3600);

/// CONNACK: the server is not available (to this robot, now).
const NOT_NOW: [u8; 4] = [0x20, 2, 0, 3];

#[tokio::test(flavor = "multi_thread")]
async fn message_flood_is_disconnected_and_others_are_served() {
    let limits = RobotLimits {
        messages_per_s: 10,
        patience: Duration::from_millis(300),
        backoff: HOUR,
        ..RobotLimits::default()
    };
    let broker = TestBroker::with_robot_limits(|_| {}, limits).await;
    let robot = RobotId::random();
    let mut raw = broker.robot(&robot).await;
    let message = publish(&topic(&robot, RobotTopic::Telemetry), 0, 0, b"flood");
    let flood = async { while raw.stream.write_all(&message.repeat(1000)).await.is_ok() {} };
    let (flooded, ()) = tokio::join!(timeout(PATIENCE, flood), broker.assert_serves());
    flooded.expect("the flood should be cut off");
    let text = broker.robot_limiter.penalty(&robot).expect("it is shown");
    assert!(text.contains("exceeds its MQTT rate limit") && text.contains("cut off"), "{text}");
    // A new connection does not reset the robot's record, and costs no other client anything.
    broker.raw_with(&Connect::robot(&robot).packet()).await.expect(&NOT_NOW).await;
    let totals = broker.robot_limiter.totals();
    assert_eq!((totals.slowed, totals.cut, totals.turned_away), (1, 1, 1));
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn message_no_agent_sends_disconnects_the_robot() {
    let limits = RobotLimits { backoff: HOUR, ..RobotLimits::default() };
    let broker = TestBroker::with_robot_limits(|_| {}, limits).await;
    let other = topic(&RobotId::random(), RobotTopic::Report);
    let refused: Vec<(String, u8)> =
        (0..17).map(|number| (format!("taskd/v1/r/{number}/#"), 0)).collect();
    let refused: Vec<(&str, u8)> =
        refused.iter().map(|(filter, qos)| (filter.as_str(), *qos)).collect();
    let cases = [
        (publish(&other, 1, 1, b"{}"), "publishes to a topic that it may not write"),
        (framed(0x30, &vec![0; 2_000_000]), "packet of 2000000 bytes"),
        (vec![0x36, 2, 0, 0], "not valid MQTT"),
        (subscribe(1, &refused), "keeps subscribing to topics that it may not read"),
    ];
    for (packet, shown) in cases {
        let robot = RobotId::random();
        let mut raw = broker.robot(&robot).await;
        raw.send(&packet).await;
        raw.expect_close().await;
        let text = broker.robot_limiter.penalty(&robot).expect("it is shown");
        assert!(text.contains(shown), "{text}");
        broker.raw_with(&Connect::robot(&robot).packet()).await.expect(&NOT_NOW).await;
    }
    broker.assert_serves().await;
    // A client without the robot's token can't cause it a penalty.
    let robot = RobotId::random();
    let stranger = Connect { password: Some("pw-".to_owned()), ..Connect::robot(&robot) };
    broker
        .raw_with(&[stranger.packet(), framed(0x30, &vec![0; 2_000_000])].concat())
        .await
        .expect(&[0x20, 2, 0, 4])
        .await;
    assert_eq!(broker.robot_limiter.penalty(&robot), None);
}

async fn server(limits: RobotLimits) -> TestServer {
    TestServer::start_in(TempDir::new().expect("a directory"), |config| config.robots = limits)
        .await
}

/// Reports until the requested wait is longer than a slowed connection would be held; returns that
/// answer.
async fn report_until_refused(server: &TestServer, robot: &mut TestRobot) -> Response {
    let state = server.desired(robot).await;
    for _ in 0..1_000 {
        let response = server.report(robot, &state, Phase::Running).await;
        match response.status().as_u16() {
            200 => {}
            429 => return response,
            other => panic!("{other}"),
        }
    }
    panic!("it may report as often as it likes");
}

#[tokio::test(flavor = "multi_thread")]
async fn frequent_reports_are_refused_and_desired_states_are_not() {
    let limits = RobotLimits {
        requests_per_s: 2,
        patience: Duration::from_millis(1),
        backoff: HOUR,
        ..RobotLimits::default()
    };
    let server = server(limits).await;
    let (mut atlas, mut boreas) = (server.enroll("atlas").await, server.enroll("boreas").await);
    let refused = report_until_refused(&server, &mut atlas).await;
    let wait_s: u64 =
        refused.headers()["retry-after"].to_str().expect("text").parse().expect("seconds");
    assert!((3000..=3601).contains(&wait_s), "{wait_s}");
    let view: RobotView = server.robot(&atlas).await;
    let condition = &view.conditions[0];
    assert_eq!(condition.code, "misbehaves");
    assert!(condition.text.contains("exceeds its HTTP request rate limit"), "{}", condition.text);
    assert_eq!(server.ask_desired(&atlas).await.status(), 200, "an order to stop would reach it");
    // The other one is none the worse.
    let state = server.desired(&boreas).await;
    assert_eq!(server.report(&mut boreas, &state, Phase::Running).await.status(), 200);
    assert!(server.robot(&boreas).await.conditions.is_empty());
    let info: ServerInfo = server.get("/api/v1/server").await;
    assert_eq!((info.conduct.slowed, info.conduct.cut), (1, 1));
    let shown = server.request(Method::GET, "/api/v1/robots").send().await.expect("an answer");
    assert!(shown.text().await.expect("text").contains("misbehaves"));
}

#[tokio::test(flavor = "multi_thread")]
async fn frequent_pushes_are_refused_and_reports_are_not() {
    let limits = RobotLimits { requests_per_s: 2, ..RobotLimits::default() };
    let server = server(limits).await;
    let mut atlas = server.enroll("atlas").await;
    let path = format!("/v2/outputs/{}/mapping/blobs/uploads/{}", atlas.id, "0".repeat(16));
    let push = || server.bare(Method::PATCH, &path).bearer_auth(&atlas.token).body("").send();
    crate::tls::allow_open_files();
    // A run's files go at once: ten seconds' worth of ten times as many as other requests.
    for _ in 0..200 {
        assert_eq!(push().await.expect("an answer").status(), 404);
    }
    let many = futures_util::future::join_all((0..600).map(|_| push())).await;
    let refused = many
        .into_iter()
        .map(|answer| answer.expect("an answer"))
        .find(|answer| answer.status() == 429);
    let refused = refused.expect("it may push as often as it likes");
    assert!(refused.headers().contains_key("retry-after"));
    assert!(refused.text().await.expect("text").contains("TOOMANYREQUESTS"));
    let state = server.desired(&atlas).await;
    assert_eq!(server.report(&mut atlas, &state, Phase::Running).await.status(), 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn violations_expire_by_themselves() {
    let limits = RobotLimits {
        requests_per_s: 2,
        patience: Duration::from_millis(1),
        backoff: Duration::from_millis(1),
        // Events are collected for a moment before their subject is read.
        penalty_lifetime: Duration::from_secs(2),
        ..RobotLimits::default()
    };
    let server = server(limits).await;
    let mut atlas = server.enroll("atlas").await;
    let mut events = server.request(Method::GET, "/api/v1/events").send().await.expect("an answer");
    report_until_refused(&server, &mut atlas).await;
    // Subscribers are told both of the robot's penalty and of its end.
    let mut heard = String::new();
    let expired = timeout(PATIENCE, async {
        loop {
            match timeout(Duration::from_secs(1), events.chunk()).await {
                Ok(chunk) => heard.push_str(&String::from_utf8_lossy(
                    &chunk.expect("a stream").expect("goes on"),
                )),
                // Expired before an observer saw the penalty.
                Err(_) if !heard.contains("misbehaves") => {
                    drop(report_until_refused(&server, &mut atlas).await)
                }
                Err(_) => {}
            }
            let last = heard.rfind("misbehaves");
            if last.is_some_and(|last| heard[last..].contains("\"conditions\":[]")) {
                return;
            }
        }
    });
    expired.await.expect("expired");
    assert!(server.robot(&atlas).await.conditions.is_empty());
}
