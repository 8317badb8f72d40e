//! Client ids at an external broker: no client ends the session of the server or of a robot by
//! connecting with the same client id, and `taskd doctor` detects a broker that would permit this.
//! With a real mosquitto and a real NATS server.
#![expect(clippy::disallowed_methods, reason = "the broker is a process")]

use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::Command;

use nix::sys::signal::Signal;
use rumqttc::{AsyncClient, EventLoop, MqttOptions, Packet, QoS, SubscribeReasonCode};
use serde_json::Value;
use task_proto::api::LogsFrom;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::broker::{Mosquitto, PASSWORD, logs, next, runs, wait_connected, worker};
use crate::harness::{Process, Robot, Server, TIMEOUT, eventually, required};

/// The robot's identity file.
fn identity(robot: &Robot) -> Value {
    serde_json::from_slice(&std::fs::read(robot.data().join("identity.json")).expect("identity"))
        .expect("json")
}

/// Connects with this robot's account and the given client id, and is let in.
async fn connect_as(
    address: SocketAddr,
    robot: &Robot,
    client_id: &str,
) -> (AsyncClient, EventLoop) {
    let identity = identity(robot);
    let password =
        identity["mqtt"]["external"]["password"].as_str().expect("a password from the enrollment");
    let mut options = MqttOptions::new(client_id, address.ip().to_string(), address.port());
    options.set_credentials(robot.id.as_str(), password);
    let (client, mut events) = AsyncClient::new(options, 16);
    assert!(matches!(next(&mut events).await, Packet::ConnAck(_)), "{client_id}");
    (client, events)
}

/// The client ids that the server and this robot had before they were secret.
async fn known_ids(server: &Server, robot: &Robot) -> [String; 2] {
    let info = server.get("/api/v1/server").await.expect("it answers");
    let key = info["key"]
        .as_str()
        .expect("a key")
        .parse::<task_proto::trust::envelope::PublicKey>()
        .expect("a key");
    [format!("taskd-{}", key.id()), robot.id.to_string()]
}

/// The verdict of `taskd doctor` on client ids, and its words.
async fn doctor(server: &Server) -> (String, String) {
    let output = server.try_operate(["doctor", "-o", "json"]).await;
    let checkup: Value = serde_json::from_slice(&output.stdout).expect("json");
    let checks = checkup["checks"].as_array().expect("checks");
    let found = checks.iter().find(|check| check["check"] == "client-ids");
    let found = found.unwrap_or_else(|| panic!("{checkup}"));
    let text = |key: &str| found[key].as_str().unwrap_or_default().to_owned();
    (text("verdict"), format!("{} {}", text("found"), text("mend")))
}

/// The server and the robot talk over the broker.
async fn assert_undisturbed(server: &Server, robot: &str, robots: u64) {
    server.wait_ready().await;
    wait_connected(server, robots).await;
    assert_eq!(logs(server, robot).await.from, LogsFrom::Robot);
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_with_another_client_id_displaces_no_session_at_mosquitto() {
    let dir = TempDir::new().expect("temp dir");
    let mut mosquitto = Mosquitto::start(dir.path()).await;
    let server =
        Server::start_unready(&dir.path().join("server"), &[("TASKD_BROKER", &mosquitto.url())])
            .await;
    let mut attacker = Robot::start(&server, dir.path(), "robot-1", 1).await;
    let victim = Robot::start(&server, dir.path(), "robot-2", 2).await;
    attacker.terminate();
    assert_eq!(doctor(&server).await.0, "notice", "it does not know the accounts for the test yet");
    mosquitto.learn(&server).await;
    server.wait_ready().await;
    wait_connected(&server, 1).await;
    server.push(&worker(dir.path(), "1.0.0"), "robot-2").await;
    runs(&server, "robot-2", "1.0.0").await;

    // A mosquitto that tells clients apart by their ids: predictable ids no longer belong to any
    // session.
    let (verdict, words) = doctor(&server).await;
    assert!(
        verdict == "notice" && words.contains("use_username_as_clientid true"),
        "{verdict}: {words}"
    );
    let before = mosquitto.log().matches("already connected, closing old connection").count();
    let mut held = Vec::new();
    for id in known_ids(&server, &victim).await {
        held.push(connect_as(mosquitto.address, &attacker, &id).await);
    }
    let after = mosquitto.log().matches("already connected, closing old connection").count();
    assert_eq!(after, before, "somebody was displaced: {}", mosquitto.log());
    assert_undisturbed(&server, "robot-2", 1).await;
    drop(held);
    // The sessions' real ids, from the log, which only the broker's administrator sees.
    let log = mosquitto.log();
    let ids_of = |user: &str| {
        let line = log
            .lines()
            .rev()
            .find(|line| line.contains(&format!("u'{user}'")))
            .expect("a connection");
        line.split(" as ").nth(1).and_then(|rest| rest.split(' ').next()).expect("an id").to_owned()
    };
    let secret = [ids_of("taskd"), ids_of(victim.id.as_str())];

    // The configuration that the server prints: ids don't matter.
    mosquitto.kill();
    mosquitto.configure(&server).await;
    mosquitto.launch().await;
    assert_undisturbed(&server, "robot-2", 1).await;
    assert_eq!(doctor(&server).await.0, "good");
    let mut held = Vec::new();
    for id in
        known_ids(&server, &victim).await.iter().chain(&secret).map(String::as_str).chain(["taskd"])
    {
        // Each takes the place of the one before, which is the same user's.
        held.push(connect_as(mosquitto.address, &attacker, id).await);
    }
    assert_undisturbed(&server, "robot-2", 1).await;
    let log = mosquitto.log();
    let displaced = log.lines().filter(|line| line.contains("already connected"));
    let others: Vec<_> =
        displaced.skip(after).filter(|line| !line.contains(attacker.id.as_str())).collect();
    assert!(others.is_empty(), "{others:?}");
}

/// A NATS server with an MQTT listener and no state of its own.
struct Nats {
    process: Option<Process>,
    dir: PathBuf,
    mqtt: SocketAddr,
    client: SocketAddr,
}

impl Nats {
    fn new(dir: &Path) -> Self {
        let dir = dir.join("nats");
        std::fs::create_dir(&dir).expect("directory");
        // Another process is unlikely to take the ports before the server does: the server can't be
        // given bound ports.
        let free = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").expect("port"));
        let [mqtt, client] = free.each_ref().map(|listener| listener.local_addr().expect("bound"));
        let path = dir.display();
        let conf = format!(
            "server_name: nats\nlisten: \"{client}\"\nmax_payload: 4MB\n\
             jetstream {{ store_dir: \"{path}/js\" }}\nmqtt {{ listen: \"{mqtt}\" }}\n\
             log_file: \"{path}/log\"\ninclude ./taskd.conf\n"
        );
        std::fs::write(dir.join("nats.conf"), conf).expect("written");
        Self { process: None, dir, mqtt, client }
    }

    fn url(&self) -> String {
        format!("mqtt://taskd:{PASSWORD}@{}", self.mqtt)
    }

    /// The broker's log.
    fn log(&self) -> String {
        std::fs::read_to_string(self.dir.join("log")).expect("a log")
    }

    /// An operator's steps after robots were enrolled.
    async fn learn(&self, server: &Server) {
        let text = server.operate(["broker", "nats"]).await;
        assert!(!text.contains(PASSWORD));
        std::fs::write(self.dir.join("taskd.conf"), text).expect("written");
        if let Some(process) = &self.process {
            process.signal(Signal::SIGHUP);
        }
    }

    async fn launch(&mut self) {
        let mut command = Command::new(required("TASKD_TEST_NATS"));
        self.process = Some(Process::spawn(command.arg("-c").arg(self.dir.join("nats.conf"))));
        eventually("nats-server to listen", async || TcpStream::connect(self.mqtt).await.ok())
            .await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn fleet_works_through_nats_with_per_robot_subjects() {
    let dir = TempDir::new().expect("temp dir");
    let mut nats = Nats::new(dir.path());
    let server =
        Server::start_unready(&dir.path().join("server"), &[("TASKD_BROKER", &nats.url())]).await;
    nats.learn(&server).await;
    nats.launch().await;
    server.wait_ready().await;
    let mut attacker = Robot::start(&server, dir.path(), "robot-1", 1).await;
    let victim = Robot::start(&server, dir.path(), "robot-2", 2).await;
    attacker.terminate();
    nats.learn(&server).await;
    wait_connected(&server, 1).await;
    server.push(&worker(dir.path(), "1.0.0"), "robot-2").await;
    runs(&server, "robot-2", "1.0.0").await;

    // NATS ends a session for any client that knows the session's client id. No client knows one.
    let (verdict, words) = doctor(&server).await;
    assert!(
        verdict == "notice" && words.contains("NATS has no such setting"),
        "{verdict}: {words}"
    );
    let replaced = || nats.log().matches("Replacing old client").count();
    let before = replaced();
    assert!(before > 0, "the test's own session was replaced: {}", nats.log());
    let mut held = Vec::new();
    for id in known_ids(&server, &victim).await {
        held.push(connect_as(nats.mqtt, &attacker, &id).await);
    }
    assert_eq!(replaced(), before, "{}", nats.log());
    assert_undisturbed(&server, "robot-2", 1).await;

    let (client, mut events) = connect_as(nats.mqtt, &attacker, "spy").await;
    let own = format!("taskd/v1/r/{}/desired", attacker.id);
    let other = format!("taskd/v1/r/{}/desired", victim.id);
    let refused = [
        "#",
        "+/#",
        "taskd/v1/#",
        "taskd/v1/r/+/desired",
        &other,
        "$MQTT/#",
        "$MQTT/sub/+",
        "$JS/#",
        "$SYS/#",
    ];
    for (filter, code) in refused
        .map(|filter| (filter, SubscribeReasonCode::Failure))
        .into_iter()
        .chain([(own.as_str(), SubscribeReasonCode::Success(QoS::AtLeastOnce))])
    {
        client.subscribe(filter, QoS::AtLeastOnce).await.expect("queued");
        let answer = loop {
            if let Packet::SubAck(answer) = next(&mut events).await {
                break answer;
            }
        };
        assert_eq!(answer.return_codes, [code], "{filter}");
    }
    // With the same account over NATS' own protocol.
    let mut stream = TcpStream::connect(nats.client).await.expect("connected");
    let password = identity(&attacker)["mqtt"]["external"]["password"]
        .as_str()
        .expect("a password")
        .to_owned();
    let hello = format!(
        "CONNECT {{\"verbose\":false,\"user\":\"{}\",\"pass\":\"{password}\"}}\r\nPING\r\n",
        attacker.id
    );
    stream.write_all(hello.as_bytes()).await.expect("sent");
    let mut answer = String::new();
    let closing = tokio::time::timeout(TIMEOUT, stream.read_to_string(&mut answer)).await;
    closing.expect("NATS' own protocol is open to it").expect("it is closed");
    assert!(answer.contains("Authorization Violation") && !answer.contains("PONG"), "{answer}");
}
