//! A flood over both routes with one robot's credentials: another robot's order arrives and is
//! carried out all the same, the flood is shown, and its robot comes back once its behaviour is
//! normal.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rumqttc::{AsyncClient, MqttOptions, QoS};
use serde_json::Value;
use task_proto::messages::report::Phase;
use tokio::task::JoinSet;

use crate::harness::{Robot, Server, eventually, write_package};

/// How many connections the flood has by each way.
const FLOODERS: usize = 4;

fn token_of(robot: &Robot) -> String {
    let identity = std::fs::read(robot.data().join("identity.json")).expect("identity");
    let identity: Value = serde_json::from_slice(&identity).expect("json");
    identity["token"].as_str().expect("a token").to_owned()
}

/// Publishes as fast as possible, and reconnects a hundred times a second.
async fn flood_mqtt(options: MqttOptions, topic: String) {
    let mut tick = tokio::time::interval(Duration::from_millis(10));
    loop {
        tick.tick().await;
        let (client, mut events) = AsyncClient::new(options.clone(), 100);
        let publish = async {
            while client.publish(&topic, QoS::AtMostOnce, false, vec![b'x'; 4096]).await.is_ok() {}
        };
        let poll = async { while events.poll().await.is_ok() {} };
        tokio::select! { () = publish => {}, () = poll => {} }
    }
}

/// Posts invalid reports as fast as possible. Counts the refusals for that reason.
async fn flood_http(client: reqwest::Client, url: String, token: String, refused: Arc<AtomicU64>) {
    loop {
        let request = client.post(&url).bearer_auth(&token).json(&serde_json::json!({}));
        if request.send().await.is_ok_and(|answer| answer.status() == 429) {
            refused.fetch_add(1, Ordering::SeqCst);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn flood_by_one_robot_does_not_delay_another() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = [
        ("TASKD_ROBOTS_PATIENCE", "1s"),
        ("TASKD_ROBOTS_BACKOFF", "500ms"),
        ("TASKD_ROBOTS_FORGIVE_AFTER", "2s"),
    ];
    let server = Server::start_with(&dir.path().join("server"), &settings).await;
    let mut bad = Robot::start(&server, dir.path(), "bad", 1).await;
    let _good = Robot::start(&server, dir.path(), "good", 2).await;
    let id = bad.id.to_string();
    let token = token_of(&bad);
    bad.terminate();

    let mut flood = JoinSet::new();
    let refused = Arc::new(AtomicU64::new(0));
    for number in 0..FLOODERS {
        let mut options = MqttOptions::new(&id, server.mqtt.ip().to_string(), server.mqtt.port());
        options.set_credentials(&id, &token);
        let topic = ["telemetry", "log", "reply", "status"][number % 4];
        flood.spawn(flood_mqtt(options, format!("taskd/v1/r/{id}/{topic}")));
        let url = server.url(&format!("/api/v1/robots/{id}/report"));
        flood.spawn(flood_http(reqwest::Client::new(), url, token.clone(), refused.clone()));
    }
    let trouble = async || {
        let view = server.robot("bad").await?;
        view.conditions
            .into_iter()
            .find(|condition| condition.code == "misbehaves")
            .map(|condition| condition.text)
    };
    eventually("the flood to be cut off", async || {
        trouble().await.filter(|text| text.contains("cut off"))
    })
    .await;
    eventually("reports to be refused", async || {
        (refused.load(Ordering::SeqCst) > 0).then_some(())
    })
    .await;

    // The flood goes on, and the other robot receives an order, carries the order out, and reports
    // that.
    let package = dir.path().join("steady");
    write_package(&package, "steady", "1.0.0", "service", "exec sleep 1000\n");
    server.push(&package, "good").await;
    server.wait_phase("good", "steady", Phase::Running).await;
    server.operate(["stop", "steady", "--on", "good", "--yes"]).await;
    server.wait_phase("good", "steady", Phase::Stopped).await;
    assert!(server.robot("good").await.expect("there").conditions.is_empty());
    assert!(trouble().await.is_some(), "it still floods");

    // Once the flood stops, its robot recovers without help.
    flood.shutdown().await;
    eventually("it to be forgiven", async || trouble().await.is_none().then_some(())).await;
    bad.restart();
    server.push(&package, "bad").await;
    server.wait_phase("bad", "steady", Phase::Running).await;
}
