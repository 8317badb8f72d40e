//! The vitals of robots' machines: sent over MQTT or HTTP, remembered for an hour, requested on
//! demand. None of them are stored.

use reqwest::Method;
use serde_json::json;
use task_proto::api::{RobotView, VitalsView};
use task_proto::messages::request::{Answer, Ask};

use crate::harness::{NOW_MS, TestRobot, TestServer, answer, refusal};
use crate::uplink::Session;

fn said(robot: &TestRobot, cpu_percent: f32) -> serde_json::Value {
    let vitals = json!({ "at_ms": 7, "cpu_percent": cpu_percent, "load_1m": 0.5, "x_future": 1 });
    json!({ "robot_id": robot.id, "vitals": vitals })
}

async fn samples(server: &TestServer, robot: &str) -> Vec<(u64, Option<f32>)> {
    let view: VitalsView = server.get(&format!("/api/v1/robots/{robot}/vitals")).await;
    view.samples.iter().map(|sample| (sample.at_ms, sample.cpu_percent)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn vitals_are_shown_for_an_hour() {
    let server = TestServer::start().await;
    let (atlas, boreas) = (server.enroll("atlas").await, server.enroll("boreas").await);
    assert_eq!(
        (server.robot(&atlas).await.vitals, samples(&server, "atlas").await),
        (None, Vec::new())
    );
    let mut session = Session::open(&server, &atlas).await;
    for (minute, cpu) in [(0, 10.0), (1, 20.0), (2, 30.0)] {
        server.clock.advance_ms(if minute == 0 { 0 } else { 60_000 });
        session.publish("telemetry", said(&atlas, cpu).to_string().into_bytes()).await;
    }
    session.publish("telemetry", said(&boreas, 99.0).to_string().into_bytes()).await;
    session.publish("telemetry", b"{".to_vec()).await;
    let newest = server.robot(&atlas).await.vitals.expect("said");
    assert_eq!(
        (newest.at_ms, newest.cpu_percent),
        (NOW_MS + 120_000, Some(30.0)),
        "by the server's clock"
    );
    let minutes =
        [(NOW_MS, Some(10.0)), (NOW_MS + 60_000, Some(20.0)), (NOW_MS + 120_000, Some(30.0))];
    assert_eq!(samples(&server, "atlas").await, minutes);
    assert_eq!(samples(&server, "boreas").await, [], "in another's name");
    server.clock.advance_ms(3_600_000);
    assert_eq!(samples(&server, "atlas").await, minutes[2..]);
    let listed: task_proto::api::RobotList = server.get("/api/v1/robots").await;
    assert_eq!(listed.robots[0].vitals, Some(newest));
}

#[tokio::test]
async fn polling_robot_reports_vitals_over_http() {
    let server = TestServer::start().await;
    let (atlas, boreas) = (server.enroll("atlas").await, server.enroll("boreas").await);
    let say = |robot: &TestRobot, body: serde_json::Value| {
        let path = format!("/api/v1/robots/{}/telemetry", robot.id);
        server.bare(Method::POST, &path).bearer_auth(&robot.token).json(&body)
    };
    assert_eq!(say(&atlas, said(&atlas, 12.5)).send().await.expect("an answer").status(), 204);
    let view: RobotView = server.robot(&atlas).await;
    assert_eq!(
        (view.online, view.vitals.and_then(|vitals| vitals.cpu_percent)),
        (true, Some(12.5))
    );
    assert_eq!(refusal(say(&atlas, said(&boreas, 1.0))).await, (400, "invalid_request".to_owned()));
    let path = format!("/api/v1/robots/{}/telemetry", boreas.id);
    let other =
        server.bare(Method::POST, &path).bearer_auth(&atlas.token).json(&said(&boreas, 1.0));
    assert_eq!(refusal(other).await.0, 403);
    assert_eq!(samples(&server, "boreas").await, []);
    let gone =
        server.request(Method::DELETE, "/api/v1/robots/atlas").send().await.expect("an answer");
    assert_eq!(gone.status(), 204);
    assert_eq!(refusal(server.request(Method::GET, "/api/v1/robots/atlas/vitals")).await.0, 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn vitals_are_requested_from_the_robot() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let mut session = Session::open(&server, &robot).await;
    let request = server.request(Method::POST, "/api/v1/robots/atlas/ask").json(&Ask::Vitals);
    let (answered, ()) = tokio::join!(answer::<Answer>(request), async {
        let question = session.asked().await;
        assert_eq!(question["ask"], json!({ "type": "vitals" }));
        let told = json!({ "type": "vitals", "at_ms": 7, "cpu_percent": 250.0 });
        let reply = json!({ "robot_id": robot.id, "id": question["id"], "answer": told });
        session.publish("reply", reply.to_string().into_bytes()).await;
    });
    let Answer::Vitals(vitals) = answered else { panic!("{answered:?}") };
    assert_eq!(
        (vitals.at_ms, vitals.cpu_percent),
        (NOW_MS, Some(100.0)),
        "by our clock, within its bounds"
    );
    assert_eq!(server.robot(&robot).await.vitals, Some(vitals));
}
