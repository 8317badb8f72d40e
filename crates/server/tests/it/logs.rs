//! Log lines that robots publish: remembered, shown when the robot can't be asked, streamed to
//! followers.

use std::time::Duration;

use futures_util::StreamExt as _;
use reqwest::Method;
use serde_json::{Value, json};
use task_proto::api::{LogsFrom, LogsView};

use crate::harness::{TestRobot, TestServer, refusal};
use crate::uplink::Session;

const PATIENCE: Duration = Duration::from_secs(10);

fn batch(robot: &TestRobot, level: &str, text: &str) -> Vec<u8> {
    let line = json!({
        "at_ms": 1_000, "level": level, "source": "stderr", "task": "talker", "text": text,
    });
    json!({ "robot_id": robot.id, "now_ms": 2_000, "lines": [line], "suppressed": 3 })
        .to_string()
        .into_bytes()
}

#[tokio::test(flavor = "multi_thread")]
async fn published_logs_are_shown_while_the_robot_is_offline() {
    let server = TestServer::start().await;
    let (robot, other) = (server.enroll("atlas").await, server.enroll("boreas").await);
    let mut session = Session::open(&server, &robot).await;
    session.publish("log", batch(&robot, "warn", "low\u{1b}[31m")).await;
    session.publish("log", batch(&robot, "error", "empty")).await;
    session.publish("log", batch(&other, "error", "in another's name")).await;
    session.publish("log", b"{".to_vec()).await;
    drop(session);
    server.clock.advance_ms(5_000);
    let shown = async |query: &str| -> LogsView {
        server.get(&format!("/api/v1/robots/atlas/logs{query}")).await
    };
    let texts =
        |view: &LogsView| view.lines.iter().map(|line| line.text.clone()).collect::<Vec<_>>();
    let view = shown("").await;
    assert_eq!((view.from, view.age_ms, view.suppressed), (LogsFrom::Server, 5_000, 6));
    assert!(view.reason.as_ref().is_some_and(|reason| !reason.is_empty()));
    assert_eq!(texts(&view), ["low\u{fffd}[31m", "empty"]);
    assert_eq!(texts(&shown("?level=error").await), ["empty"]);
    assert_eq!(texts(&shown("?task=other").await), Vec::<String>::new());
    assert_eq!(texts(&shown("?since_s=7&max_lines=1").await), ["empty"]);
    assert_eq!(
        texts(&shown("?since_s=5").await),
        Vec::<String>::new(),
        "by the robot's clock they are 6 s old"
    );
    let other: LogsView = server.get("/api/v1/robots/boreas/logs").await;
    assert_eq!((other.from, other.lines.len()), (LogsFrom::Server, 0));
    let wrong = refusal(server.request(Method::GET, "/api/v1/robots/atlas/logs?level=loud")).await;
    assert_eq!(wrong.0, 400);
    assert_eq!(refusal(server.request(Method::GET, "/api/v1/robots/nobody/logs")).await.0, 404);
}

/// The data of the next event.
async fn next_event(
    events: &mut (impl futures_util::Stream<Item = reqwest::Result<bytes::Bytes>> + Unpin),
) -> Value {
    let next = async {
        loop {
            let chunk = events.next().await.expect("goes on").expect("readable");
            let text = String::from_utf8_lossy(&chunk).into_owned();
            if let Some((_, data)) = text.split_once("data: ") {
                return serde_json::from_str(data.lines().next().expect("a line")).expect("json");
            }
        }
    };
    tokio::time::timeout(PATIENCE, next).await.expect("an event")
}

#[tokio::test(flavor = "multi_thread")]
async fn log_followers_get_presence_and_lines() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let follow = server.request(Method::GET, "/api/v1/robots/atlas/logs?follow=true&level=error");
    let mut events = follow.send().await.expect("an answer").bytes_stream();
    assert_eq!(next_event(&mut events).await["type"], "away");
    let mut session = Session::open(&server, &robot).await;
    let asked = session.asked().await;
    assert_eq!(
        (&asked["ask"]["type"], &asked["ask"]["level"]),
        (&json!("follow"), &json!("error"))
    );
    let reply =
        json!({ "robot_id": robot.id, "id": asked["id"], "answer": { "type": "following" } });
    session.publish("reply", reply.to_string().into_bytes()).await;
    while next_event(&mut events).await["type"] != "following" {}
    session.publish("log", batch(&robot, "warn", "not wanted")).await;
    session.publish("log", batch(&robot, "error", "wanted")).await;
    let counted = next_event(&mut events).await;
    assert_eq!((&counted["lines"], &counted["suppressed"]), (&json!([]), &json!(3)));
    assert_eq!(next_event(&mut events).await["lines"][0]["text"], "wanted");
    server.stop().await;
    let rest = tokio::time::timeout(PATIENCE, events.collect::<Vec<_>>());
    rest.await.expect("the stream ends with the server");
}
