//! A robot on MQTT that gives fixed answers to questions: a small graph, a few parameters, a few
//! lines of a log.

use std::time::Duration;

use serde_json::{Value, json};
use task_proto::ids::InstanceId;
use task_proto::ids::digest::unhex;
use task_proto::messages::request::{ACTION_TYPE, Action, Ask, Request};
use task_proto::telemetry::log::LogLevel;
use task_proto::telemetry::ros::Transition;
use task_proto::trust::envelope::{PublicKey, SigningKey};
use tokio::task::JoinHandle;

use crate::cli::{Bench, Robot};
use crate::uplink::Session;

/// Time limit that only a hanging test exceeds.
const PATIENCE: Duration = Duration::from_secs(10);
/// The fixed time of the robot's clock.
const NOW_MS: u64 = 1_700_000_060_000;

/// A robot that answers until this is dropped.
pub struct Answering(JoinHandle<()>);

impl Drop for Answering {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl Answering {
    pub async fn start(bench: &Bench, robot: &Robot) -> Self {
        let (id, key) = (robot.identity.robot_id.clone(), server_key(bench));
        let session = session(bench, robot).await;
        // As the session says.
        let instance: InstanceId = "i00000000000000c3".parse().expect("an instance");
        let reply = move |question: &[u8]| {
            let Request { id: question, ask, signed, .. } =
                serde_json::from_slice(question).expect("a question");
            assert_eq!(ask.changes_something(), signed.is_some());
            if let Some(signed) = signed {
                let action = signed.open(ACTION_TYPE, &key).expect("signed by the server");
                let action: Action = serde_json::from_slice(&action).expect("an action");
                let meant = Action {
                    robot_id: id.clone(),
                    instance: instance.clone(),
                    id: question.clone(),
                    ask: ask.clone(),
                };
                assert_eq!(action, meant);
            }
            let (outcome, told) = match answer(&ask) {
                Ok(answer) => ("answer", answer),
                Err((code, text)) => ("refusal", json!({ "code": code, "text": text })),
            };
            json!({ "robot_id": id, "id": question, outcome: told }).to_string().into_bytes()
        };
        Self(tokio::spawn(session.answer_all(reply).await))
    }
}

fn server_key(bench: &Bench) -> PublicKey {
    let seed = std::fs::read_to_string(bench.data().join("signing.key")).expect("the server's key");
    SigningKey::from_bytes(unhex(seed.trim()).expect("64 hex digits")).public_key()
}

async fn session(bench: &Bench, robot: &Robot) -> Session {
    let identity = &robot.identity;
    Session::open_at(&bench.server().addresses().mqtt, identity.robot_id.as_str(), &identity.token)
        .await
}

/// Robot `robot` publishes its log and goes, and the server knows that.
pub async fn publish_log_and_go(bench: &Bench, robot: &Robot) {
    let mut session = session(bench, robot).await;
    let id = &robot.identity.robot_id;
    let batch = json!({ "robot_id": id, "now_ms": NOW_MS, "lines": lines(), "suppressed": 7 });
    session.publish("log", batch.to_string().into_bytes()).await;
    session.leave().await;
    let id = robot.identity.robot_id.as_str();
    let is_there =
        async || !bench.taskd(&["robot", "info", id, "-o", "json"]).await.json()["mqtt"].is_null();
    tokio::time::timeout(PATIENCE, async { while is_there().await {} }).await.expect("it is gone");
}

fn lines() -> Value {
    json!([
        { "at_ms": NOW_MS - 50_000, "level": "debug", "source": "stdout", "task": "mapping",
            "text": "reading map.yaml" },
        { "at_ms": NOW_MS - 40_000, "level": "info", "source": "rosout", "task": "mapping",
            "node": "/mapper", "text": "1204 scans" },
        { "at_ms": NOW_MS - 30_000, "level": "warn", "source": "diagnostics",
            "text": "battery: 11 %" },
        { "at_ms": NOW_MS - 20_000, "level": "error", "source": "stderr", "task": "camera",
            "text": "no \u{1b}[31mframe" },
        { "at_ms": NOW_MS - 10_000, "level": "fatal", "source": "agent", "task": "camera",
            "text": "gave up" },
    ])
}

type Refusal = (&'static str, String);

fn answer(ask: &Ask) -> Result<Value, Refusal> {
    match ask {
        Ask::Nodes => Ok(json!({ "type": "nodes", "age_ms": 300, "nodes": [
            { "name": "/camera", "task": "camera" },
            { "name": "/mapper", "task": "mapping", "lifecycle": "active" },
            { "name": "/rviz" },
        ] })),
        Ask::Node { name } => node(known(name.as_str())?),
        Ask::Topics => Ok(json!({ "type": "topics", "age_ms": 1250, "topics": [
            { "name": "/map", "types": ["nav_msgs/msg/OccupancyGrid"], "publishers": ["/mapper"],
                "subscriptions": [] },
            { "name": "/scan", "types": ["sensor_msgs/msg/LaserScan", "std_msgs/msg/String"],
                "publishers": ["/camera"], "subscriptions": ["/mapper", "/rviz"] },
        ] })),
        Ask::Parameters { node } => known(node.as_str()).map(|_| {
            json!({ "type": "parameters", "parameters": [
            { "name": "frame", "value": "map" },
            { "name": "ranges", "value": [0.5, 12.0] },
            { "name": "resolution", "value": 0.05 },
            { "name": "seed", "value": null },
            { "name": "use_sim_time", "value": false },
        ] })
        }),
        Ask::Parameter { node, name } => match (known(node.as_str())?, name.as_str()) {
            (_, "resolution") => {
                Ok(json!({ "type": "parameters", "parameters": [{ "name": name, "value": 0.05 }] }))
            }
            (node, _) => Err(("no_such_parameter", format!("{node} has no parameter {name}"))),
        },
        Ask::SetParameter { node, parameter } => {
            match (known(node.as_str())?, parameter.value.is_string()) {
                (_, false) => Ok(json!({ "type": "parameter_set", "parameter": parameter })),
                (node, true) => {
                    let (name, value) = (&parameter.name, &parameter.value);
                    Err((
                        "rejected",
                        format!(
                            "{node} does not accept {name} = {value}: it gives no \u{1b}[31mreason"
                        ),
                    ))
                }
            }
        }
        Ask::Lifecycle { node, transition } => match (known(node.as_str())?, transition) {
            (_, Transition::Deactivate) => Ok(json!({ "type": "lifecycle", "state": "inactive" })),
            (_, Transition::Shutdown) => Ok(json!({ "type": "lifecycle", "state": "finalized" })),
            (node, other) => {
                Err(("rejected", format!("{node} does not {}: it is active", other.as_str())))
            }
        },
        Ask::Logs { task, level, since_ms, max_lines } => {
            logs(task.as_ref().map(|task| task.as_str()), *level, *since_ms, *max_lines)
        }
        Ask::Follow { .. } | Ask::Vitals | Ask::Unknown => {
            Err(("unsupported", "that is not answered".to_owned()))
        }
    }
}

/// The name of a node, if there is such a node.
fn known(name: &str) -> Result<&str, Refusal> {
    let is_there = ["/camera", "/mapper", "/rviz"].contains(&name);
    let absent = || {
        ("no_such_node", format!("there is no node {name}; on the graph: /camera, /mapper, /rviz"))
    };
    is_there.then_some(name).ok_or_else(absent)
}

fn node(name: &str) -> Result<Value, Refusal> {
    let endpoint = |name: &str, kind: &str| json!({ "name": name, "type": kind });
    let bare = json!({
        "name": name, "publishers": [], "subscriptions": [], "services": [], "clients": [],
    });
    let nodes = match name {
        "/mapper" => json!([{
            "name": name, "task": "mapping", "lifecycle": "active",
            "publishers": [
                endpoint("/map", "nav_msgs/msg/OccupancyGrid"),
                endpoint("/rosout", "rcl_interfaces/msg/Log"),
            ],
            "subscriptions": [endpoint("/scan", "sensor_msgs/msg/LaserScan")],
            "services": [endpoint("/mapper/change_state", "lifecycle_msgs/srv/ChangeState")],
            "clients": [],
        }]),
        "/camera" => json!([{
            "name": name, "task": "camera", "publishers": [], "subscriptions": [], "services": [],
            "clients": [endpoint("/locate", "a\u{1b}[31m/srv/B")],
        }]),
        // Two have the same name.
        "/rviz" => json!([bare, bare]),
        _ => json!([bare]),
    };
    Ok(json!({ "type": "node", "age_ms": 300, "nodes": nodes }))
}

fn logs(
    task: Option<&str>,
    level: LogLevel,
    since_ms: Option<u64>,
    max_lines: u64,
) -> Result<Value, Refusal> {
    if let Some(task) = task.filter(|task| !["mapping", "camera"].contains(task)) {
        return Err(("no_such_task", format!("there is no task {task}")));
    }
    let wanted = |line: &Value| {
        let lines_level: LogLevel = serde_json::from_value(line["level"].clone()).expect("a level");
        let age_ms = NOW_MS - line["at_ms"].as_u64().expect("a time");
        lines_level >= level
            && task.is_none_or(|task| line["task"] == task)
            && since_ms.is_none_or(|since_ms| age_ms <= since_ms)
    };
    let lines: Vec<Value> =
        lines().as_array().expect("lines").iter().filter(|line| wanted(line)).cloned().collect();
    let newest =
        &lines[lines.len().saturating_sub(usize::try_from(max_lines).expect("a small number"))..];
    let suppressed = if level == LogLevel::Debug { 2 } else { 0 };
    Ok(json!({
        "type": "logs", "robot_id": "r0000000000000000", "now_ms": NOW_MS, "lines": newest,
        "suppressed": suppressed,
    }))
}
