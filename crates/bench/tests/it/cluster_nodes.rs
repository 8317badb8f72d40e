//! Several servers that use one Postgres at the same time. Robots connect to one of them, and
//! orders are given at another.

use std::time::Duration;

use serde_json::{Value, json};
use task_proto::api::RobotView;
use task_proto::messages::report::Phase;

use crate::cluster::{Cluster, copy_keys};
use crate::harness::{Robot, Server, eventually_within, within, write_package};
use crate::proxy::Proxy;

/// Time for what the servers tell each other. A robot that is not notified asks after minutes.
const SOON: Duration = Duration::from_secs(10);

impl Cluster {
    /// Starts the node `name` with these settings and the keys of `first`, if it is not the first.
    async fn node(&self, name: &str, first: Option<&Server>, more: &[(&str, &str)]) -> Server {
        let data = self.data(name);
        if let Some(first) = first {
            copy_keys(first.data(), &data);
        }
        Server::start_with(&data, &[&self.node_settings(name)[..], more].concat()).await
    }

    fn node_settings<'a>(&'a self, name: &'a str) -> [(&'a str, &'a str); 4] {
        [
            ("TASKD_DATABASE", &self.database),
            ("TASKD_BLOBS_STORE", &self.packages),
            ("TASKD_CLUSTER_NAME", name),
            ("TASKD_CLUSTER_URL", "http://127.0.0.1:1"),
        ]
    }

    async fn nodes(&self, more: &[(&str, &str)]) -> [Server; 2] {
        let a = self.node("a", None, more).await;
        let b = self.node("b", Some(&a), more).await;
        [a, b]
    }

    async fn robot(&self, node: &Server, number: u8) -> Robot {
        let robot =
            Robot::start(node, self.directory.path(), &format!("robot-{number}"), number).await;
        node.wait_online(&robot.name).await;
        robot
    }

    /// A package that runs `script`, and its directory.
    fn package(&self, version: &str, kind: &str, script: &str) -> std::path::PathBuf {
        let directory = self.directory.path().join(format!("worker-{version}"));
        write_package(&directory, "worker", version, kind, script);
        directory
    }

    fn service(&self, version: &str) -> std::path::PathBuf {
        self.package(version, "service", "exec sleep 1000\n")
    }

    async fn end_listeners(&self) {
        let end = "SELECT CAST(COUNT(pg_terminate_backend(pid)) AS BIGINT) FROM pg_stat_activity
            WHERE application_name = 'taskd listener' AND datname = current_database()";
        self.execute(end).await;
    }
}

/// Waits until `server` shows that the robot runs this version, but not until the robot asks.
async fn runs_soon(server: &Server, robot: &str, version: &str) {
    eventually_within(SOON, &format!("{version} to run on {robot}"), async || {
        let view = server.robot(robot).await?;
        runs(&view, version).then_some(())
    })
    .await;
}

fn runs(view: &RobotView, version: &str) -> bool {
    view.tasks.iter().any(|task| {
        let active = task.active.as_ref().map(|active| active.version.as_str());
        task.phase == Phase::Running && active == Some(version)
    })
}

/// The names of the robots with a session at this node.
async fn sessions(node: &Server) -> Option<Vec<String>> {
    let list = node.get("/api/v1/server/sessions").await?;
    let names = list["sessions"].as_array()?.iter();
    names.map(|session| Some(session["name"].as_str()?.to_owned())).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn order_at_one_node_reaches_a_robot_at_another() {
    let cluster = Cluster::new().await;
    let [a, b] = cluster.nodes(&[]).await;
    let robot = cluster.robot(&b, 1).await;
    eventually_within(SOON, "the robot to be online at the other node", async || {
        a.robot(&robot.name).await?.online.then_some(())
    })
    .await;
    a.push(&cluster.service("1.0.0"), "*").await;
    runs_soon(&a, &robot.name, "1.0.0").await;
    b.push(&cluster.service("2.0.0"), "*").await;
    runs_soon(&a, &robot.name, "2.0.0").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn sweep_finds_an_order_that_was_not_announced() {
    let cluster = Cluster::new().await;
    let [a, b] = cluster.nodes(&[("TASKD_CLUSTER_BUS", "off")]).await;
    let robot = cluster.robot(&b, 1).await;
    a.push(&cluster.service("1.0.0"), "*").await;
    runs_soon(&a, &robot.name, "1.0.0").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn order_arrives_while_listeners_are_cut() {
    let cluster = Cluster::new().await;
    let [a, b] = cluster.nodes(&[]).await;
    let robot = cluster.robot(&b, 1).await;
    let package = cluster.service("1.0.0");
    let cut = async {
        for _ in 0..10 {
            cluster.end_listeners().await;
        }
    };
    tokio::join!(cut, async { drop(a.push(&package, "*").await) });
    cluster.end_listeners().await;
    runs_soon(&a, &robot.name, "1.0.0").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_revoked_at_one_node_leaves_all() {
    let cluster = Cluster::new().await;
    let [a, b] = cluster.nodes(&[]).await;
    let robot = cluster.robot(&b, 1).await;
    eventually_within(SOON, "the session to begin", async || {
        (sessions(&b).await? == [robot.name.clone()]).then_some(())
    })
    .await;
    a.operate(["robot", "revoke", &robot.name, "--yes"]).await;
    eventually_within(SOON, "the session to end", async || {
        (sessions(&b).await? == Vec::<String>::new()).then_some(())
    })
    .await;
    for node in [&a, &b] {
        eventually_within(SOON, "the robot to be shown as offline", async || {
            (!node.robot(&robot.name).await?.online).then_some(())
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_node_costs_no_report_and_its_robot_comes_back_at_another() {
    let cluster = Cluster::new().await;
    let [http, mqtt] = [Proxy::nowhere().await, Proxy::nowhere().await];
    let port = mqtt.address.port().to_string();
    let [mut a, b] = cluster.nodes(&[("TASKD_PUBLIC_MQTT_PORT", &port)]).await;
    let lead_to = |node: &Server| {
        http.set_target(node.http);
        mqtt.set_target(node.mqtt);
    };
    lead_to(&a);
    let url = format!("http://{}", http.address);
    let robot = Robot::start_with(&a, cluster.directory.path(), "robot-1", 1, &url, &[]).await;
    a.wait_online(&robot.name).await;
    let job = cluster.package("1.0.0", "job", "sleep 2\n");
    b.push(&job, "*").await;
    b.wait_phase(&robot.name, "worker", Phase::Running).await;
    a.kill();
    lead_to(&b);
    eventually_within(SOON, "the robot to be back", async || {
        (sessions(&b).await? == [robot.name.clone()]).then_some(())
    })
    .await;
    let view = b.wait_phase(&robot.name, "worker", Phase::Succeeded).await;
    assert!(view.online);
    b.push(&cluster.service("2.0.0"), "*").await;
    runs_soon(&b, &robot.name, "2.0.0").await;
    // Nobody was away.
    let feed = b.get("/api/v1/feed").await.expect("a feed").to_string();
    assert!(!feed.contains("robot_offline"), "{feed}");
}

#[tokio::test(flavor = "multi_thread")]
async fn clones_at_two_nodes_displace_each_other_and_get_no_work() {
    let cluster = Cluster::new().await;
    let [a, b] = cluster.nodes(&[]).await;
    let robot = cluster.robot(&a, 1).await;
    let mut elsewhere = moved(&cluster, &robot, &a, &b);
    a.push(&cluster.service("1.0.0"), "*").await;
    runs_soon(&b, &robot.name, "1.0.0").await;
    elsewhere.restart();
    // Both want it, and only one at a time has it.
    eventually_within(SOON, "the session to be taken", async || {
        (sessions(&b).await? == [robot.name.clone()]).then_some(())
    })
    .await;
    eventually_within(SOON, "the duplicate to be seen", async || {
        let is_seen = async |node: &Server| {
            let view = node.robot(&robot.name).await?;
            view.conditions
                .iter()
                .any(|condition| condition.code == "duplicate_identity")
                .then_some(())
        };
        is_seen(&a).await?;
        is_seen(&b).await
    })
    .await;
    let started = elsewhere.data().join("tasks/worker");
    assert!(!started.exists(), "the copy got the order");
}

/// A copy of the robot that connects to `to` and not to `from`.
fn moved(cluster: &Cluster, robot: &Robot, from: &Server, to: &Server) -> Robot {
    let copy = robot.copied(cluster.directory.path(), "copy");
    for name in ["agent.toml", "identity.json"] {
        let path = copy.data().join(name);
        let text = std::fs::read_to_string(&path).expect("there");
        let text = text.replace(&from.http.to_string(), &to.http.to_string());
        let port = |server: &Server| format!("\"port\": {}", server.mqtt.port());
        std::fs::write(&path, text.replace(&port(from), &port(to))).expect("written");
    }
    copy
}

#[tokio::test(flavor = "multi_thread")]
async fn batches_follow_each_other_over_two_nodes() {
    let cluster = Cluster::new().await;
    let [a, b] = cluster.nodes(&[]).await;
    let robots = [cluster.robot(&a, 1).await, cluster.robot(&b, 2).await];
    let order = b.push_with(&cluster.service("1.0.0"), "*", &["--batch", "1"]).await;
    for robot in &robots {
        runs_soon(&a, &robot.name, "1.0.0").await;
    }
    let path = format!("/api/v1/deployments/{}?timeline=true", order.id);
    let deployment = a.get(&path).await.expect("known");
    let mut timelines: Vec<Vec<(u64, String)>> = Vec::new();
    for assignment in deployment["assignments"].as_array().expect("assignments") {
        let entry = |entry: &Value| {
            let phase = entry["phase"].as_str().expect("a phase").to_owned();
            (entry["at_ms"].as_u64().expect("a time"), phase)
        };
        let timeline = assignment["timeline"].as_array().expect("a timeline");
        timelines.push(timeline.iter().map(entry).collect());
    }
    timelines.sort();
    let (first_runs_ms, _) = timelines[0].last().expect("it runs");
    // The order and the begin of its batch.
    let is_assigned = |(_, phase): &&(u64, String)| phase == "assigned";
    assert_eq!(timelines[1].iter().filter(is_assigned).count(), 2, "{deployment}");
    assert!(timelines[1][1..].iter().all(|(at_ms, _)| at_ms >= first_runs_ms), "{deployment}");
    // Both nodes have seen it all, and one of them tells.
    let told = async |words: &str| {
        let feed = a.get("/api/v1/feed").await?;
        let texts = feed["entries"].as_array()?.iter().filter_map(|entry| entry["text"].as_str());
        Some(texts.filter(|text| text.contains(words)).count()).filter(|count| *count > 0)
    };
    for words in ["was started on", "has settled"] {
        let count = eventually_within(SOON, words, async || told(words).await).await;
        assert_eq!(count, 1, "{words}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn node_with_other_keys_or_outside_of_the_cluster_does_not_start() {
    let cluster = Cluster::new().await;
    let a = cluster.node("a", None, &[]).await;
    let (code, log) = Server::start_refused(&cluster.data("b"), &cluster.node_settings("b")).await;
    assert!(code == 1 && log.contains("this server's signing key "), "{code}: {log}");
    let database = [("TASKD_DATABASE", cluster.database.as_str())];
    let standby = [database[0], ("TASKD_STANDBY", "true")];
    let node = cluster.node_settings("e");
    let prefix = [&node[..], &[("TASKD_TOPIC_PREFIX", "other")]].concat();
    for (name, settings, words) in [
        ("c", &database[..], "is in use by a cluster of servers"),
        ("d", &standby[..], "is in use by a cluster of servers"),
        ("e", &prefix[..], "topic_prefix is other here"),
    ] {
        copy_keys(a.data(), &cluster.data(name));
        let (code, log) = Server::start_refused(&cluster.data(name), settings).await;
        assert!(code == 1 && log.contains(words), "{name}, {code}: {log}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn page_signed_in_at_one_node_is_signed_in_at_all() {
    let cluster = Cluster::new().await;
    let [a, b] = cluster.nodes(&[]).await;
    let (client, operator) = (reqwest::Client::new(), a.operator_token());
    let eve = json!({ "name": "eve", "roles": ["viewer"], "password": "a long password" });
    let added = client.post(a.url("/api/v1/users")).bearer_auth(&operator).json(&eve).send().await;
    assert_eq!(added.expect("an answer").status(), 201);
    let credentials = json!({ "user": "eve", "password": "a long password" });
    let answer = client.post(a.url("/api/v1/session")).json(&credentials).send().await;
    let answer = answer.expect("an answer");
    assert_eq!(answer.status(), 200);
    let cookie = answer.headers()["set-cookie"].to_str().expect("text");
    let cookie = cookie.split(';').next().expect("a pair").to_owned();
    let status = async |node: &Server| {
        let request = client.get(node.url("/api/v1/me")).header("cookie", &cookie);
        request.send().await.expect("an answer").status().as_u16()
    };
    assert_eq!((status(&a).await, status(&b).await), (200, 200));
    let removed = client.delete(a.url("/api/v1/users/eve")).bearer_auth(&operator).send().await;
    assert_eq!(removed.expect("an answer").status(), 204);
    assert_eq!(status(&a).await, 401);
    let ended = within(SOON, async || (status(&b).await == 401).then_some(())).await;
    assert!(ended.is_some(), "the session goes on at the other node");
}
