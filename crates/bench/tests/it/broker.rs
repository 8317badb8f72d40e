//! The whole system through an external broker: a real mosquitto, with the files that the server
//! writes for that broker.
#![expect(clippy::disallowed_methods, reason = "the broker is a process")]

use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::Command;

use nix::sys::signal::Signal;
use rumqttc::{AsyncClient, Event, EventLoop, MqttOptions, Packet, QoS};
use serde_json::Value;
use task_proto::api::{LogsFrom, LogsView, ServerInfo};
use task_proto::desired::Delivery;
use task_proto::messages::report::Phase;
use task_proto::{CaPin, RobotId};
use taskbench::programs::encryption::Certificate;
use tempfile::TempDir;
use tokio::net::TcpStream;

use crate::harness::{Process, Robot, Server, TIMEOUT, add_ballast, eventually, write_package};
use crate::proxy::Proxy;

pub const PASSWORD: &str = "the-servers-password";

/// A mosquitto without persistent state, on one port for the duration of the test.
pub struct Mosquitto {
    process: Option<Process>,
    dir: PathBuf,
    pub address: SocketAddr,
    scheme: &'static str,
}

impl Mosquitto {
    pub async fn start(dir: &Path) -> Self {
        let mut mosquitto = Self::new(dir);
        mosquitto.launch().await;
        mosquitto
    }

    /// Prepares a broker without starting it.
    pub fn new(dir: &Path) -> Self {
        Self::named(dir, "mosquitto")
    }

    /// Prepares one of several brokers.
    pub fn named(dir: &Path, name: &str) -> Self {
        let dir = dir.join(name);
        std::fs::create_dir(&dir).expect("directory");
        // Mosquitto can't be given a bound port. Another process is unlikely to take the port
        // before mosquitto does.
        let free = TcpListener::bind("127.0.0.1:0").expect("port");
        let address = free.local_addr().expect("bound");
        let path = dir.display();
        let user = if nix::unistd::geteuid().is_root() { "user root\n" } else { "" };
        let conf = format!(
            "listener {} 127.0.0.1\n{user}allow_anonymous false\npersistence false\n\
             acl_file {path}/acl\npassword_file {path}/passwd\nlog_dest file {path}/log\n",
            address.port()
        );
        for (name, text) in [("conf", conf.as_str()), ("acl", ""), ("passwd", "")] {
            std::fs::write(dir.join(name), text).expect("written");
        }
        Self { process: None, dir, address, scheme: "mqtt" }
    }

    /// Turns on TLS from the next start on; returns the pin of the authority behind the
    /// certificate.
    fn encrypt(&mut self) -> CaPin {
        let certificate = Certificate::new().expect("a certificate");
        let chain = self.dir.join("chain.pem");
        let key = self.dir.join("key.pem");
        let conf = self.dir.join("conf");
        let mut text = std::fs::read_to_string(&conf).expect("written");
        text.push_str(&format!("certfile {}\nkeyfile {}\n", chain.display(), key.display()));
        for (path, text) in [(chain, certificate.chain), (key, certificate.key), (conf, text)] {
            std::fs::write(path, text).expect("written");
        }
        self.scheme = "mqtts";
        certificate.pin
    }

    pub async fn launch(&mut self) {
        // Mosquitto is not on every user's path.
        let mut command = ["/usr/sbin/mosquitto", "/usr/local/sbin/mosquitto"]
            .iter()
            .find(|path| Path::new(path).exists())
            .map_or_else(|| Command::new("mosquitto"), Command::new);
        self.process = Some(Process::spawn(command.arg("-c").arg(self.dir.join("conf"))));
        eventually("mosquitto to listen", async || TcpStream::connect(self.address).await.ok())
            .await;
    }

    /// Sends `kill -9`: all of the broker's state is gone.
    pub fn kill(&mut self) {
        self.process.take().expect("it runs").kill();
    }

    /// The broker's URL as in the server's setting.
    pub fn url(&self) -> String {
        format!("{}://taskd:{PASSWORD}@{}", self.scheme, self.address)
    }

    /// Writes the configuration for the next start: that of `taskd broker conf`, with this
    /// directory and on loopback only.
    pub async fn configure(&self, server: &Server) {
        let conf = server.operate(["broker", "conf"]).await;
        let port = self.address.port();
        let path = self.dir.display().to_string();
        let conf =
            conf.replace(&format!("listener {port}\n"), &format!("listener {port} 127.0.0.1\n"));
        let conf = conf.replace("/etc/mosquitto/taskd.", &format!("{path}/"));
        let user = if nix::unistd::geteuid().is_root() { "user root\n" } else { "" };
        std::fs::write(self.dir.join("conf"), format!("{conf}{user}log_dest file {path}/log\n"))
            .expect("written");
    }

    /// The broker's log.
    pub fn log(&self) -> String {
        std::fs::read_to_string(self.dir.join("log")).expect("a log")
    }

    /// Removes one account from the broker's files.
    fn forget(&self, user: &str) {
        let path = self.dir.join("passwd");
        let accounts = std::fs::read_to_string(&path).expect("written");
        let others = accounts.lines().filter(|line| !line.starts_with(&format!("{user}:")));
        std::fs::write(path, others.map(|line| format!("{line}\n")).collect::<String>())
            .expect("written");
    }

    /// An operator's steps after robots were enrolled: new files, then SIGHUP.
    pub async fn learn(&self, server: &Server) {
        for file in ["acl", "passwd"] {
            let text = server.operate(["broker", file]).await;
            assert!(!text.contains(PASSWORD));
            std::fs::write(self.dir.join(file), text).expect("written");
        }
        if let Some(process) = &self.process {
            process.signal(Signal::SIGHUP);
        }
    }
}

/// Number of robots that the server knows to be connected to the broker.
async fn connected(server: &Server) -> Option<u64> {
    let info: ServerInfo = serde_json::from_value(server.get("/api/v1/server").await?).ok()?;
    Some(info.traffic.robots_connected)
}

pub async fn wait_connected(server: &Server, robots: u64) {
    eventually(&format!("{robots} robots at the broker"), async || {
        (connected(server).await? == robots).then_some(())
    })
    .await;
}

pub async fn says(server: &Server, what: &str) {
    eventually(&format!("/readyz to say {what:?}"), async || {
        let said = server.readiness().await?;
        (said["status"] == "not_ready" && said["broker"].as_str()?.contains(what)).then_some(())
    })
    .await;
}

/// A service that writes to both streams.
pub fn worker(dir: &Path, version: &str) -> PathBuf {
    let package = dir.join(format!("worker-{version}"));
    let script = format!("echo hello {version}; echo oops {version} >&2; exec sleep 1000\n");
    write_package(&package, "worker", version, "service", &script);
    package
}

pub async fn runs(server: &Server, robot: &str, version: &str) {
    eventually(&format!("{robot} to run {version}"), async || {
        let view = server.robot(robot).await?;
        let task = view.tasks.into_iter().find(|task| task.task.as_str() == "worker")?;
        (task.phase == Phase::Running && task.active?.version.as_str() == version).then_some(())
    })
    .await;
}

pub async fn logs(server: &Server, robot: &str) -> LogsView {
    let out = server.operate(["logs", robot, "-o", "json"]).await;
    serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}"))
}

fn server_log(server: &Server) -> String {
    std::fs::read_to_string(server.data().with_extension("server.log")).expect("log")
}

#[tokio::test(flavor = "multi_thread")]
async fn fleet_works_through_mosquitto_and_survives_lost_sessions() {
    let dir = TempDir::new().expect("temp dir");
    let mut mosquitto = Mosquitto::start(dir.path()).await;
    let mut server =
        Server::start_unready(&dir.path().join("server"), &[("TASKD_BROKER", &mosquitto.url())])
            .await;
    says(&server, "does not accept the user taskd with the password in `broker`").await;
    mosquitto.learn(&server).await;
    server.wait_ready().await;

    let mut robots = Vec::new();
    for number in 1..=2 {
        robots.push(Robot::start(&server, dir.path(), &format!("robot-{number}"), number).await);
    }
    // The robots are refused until the broker has learned of them.
    mosquitto.learn(&server).await;
    wait_connected(&server, 2).await;
    server.push(&worker(dir.path(), "1.0.0"), "*").await;
    for robot in ["robot-1", "robot-2"] {
        runs(&server, robot, "1.0.0").await;
        let view = eventually("its lines", async || {
            let view = logs(&server, robot).await;
            (view.lines.len() >= 2).then_some(view)
        })
        .await;
        assert_eq!(view.from, LogsFrom::Robot, "asked over the broker");
    }

    // The broker dies in the middle of an order and comes back without any session.
    server.push(&worker(dir.path(), "2.0.0"), "*").await;
    mosquitto.kill();
    says(&server, "the broker at").await;
    mosquitto.launch().await;
    for robot in ["robot-1", "robot-2"] {
        runs(&server, robot, "2.0.0").await;
    }
    server.wait_ready().await;
    wait_connected(&server, 2).await;

    // The server returns to a broker where the robots have stayed connected.
    server.kill();
    server.restart().await;
    wait_connected(&server, 2).await;
    server.operate(["stop", "worker", "--on", "robot-1"]).await;
    server.wait_phase("robot-1", "worker", Phase::Stopped).await;

    // The will of a disconnected robot, and its earlier publications.
    robots[1].kill();
    wait_connected(&server, 1).await;
    eventually("the server's memory of robot-2", async || {
        let output = server.try_operate(["logs", "robot-2", "-o", "json"]).await;
        let view: LogsView = serde_json::from_slice(&output.stdout).ok()?;
        (view.from == LogsFrom::Server).then_some(())
    })
    .await;
    assert!(!server_log(&server).contains(PASSWORD));
}

#[tokio::test(flavor = "multi_thread")]
async fn direct_push_works_through_mosquitto() {
    let dir = TempDir::new().expect("temp dir");
    let mosquitto = Mosquitto::start(dir.path()).await;
    let server =
        Server::start_unready(&dir.path().join("server"), &[("TASKD_BROKER", &mosquitto.url())])
            .await;
    let proxy = Proxy::start(server.http, u64::MAX).await;
    let url = format!("http://{}", proxy.address);
    let robot = Robot::start_with(&server, dir.path(), "robot-1", 1, &url, &[]).await;
    mosquitto.learn(&server).await;
    server.wait_ready().await;
    wait_connected(&server, 1).await;
    let ways = [
        ("inline", Delivery::Inline, 24_000),
        ("direct-push", Delivery::DirectPush, 4 * 1024 * 1024),
    ];
    for (number, (name, delivery, bytes)) in ways.into_iter().enumerate() {
        let version = format!("{}.0.0", number + 1);
        let package = worker(dir.path(), &version);
        add_ballast(&package, bytes);
        let before = proxy.bytes_to_clients();
        let ordered = server.push_with(&package, "*", &["--delivery", name]).await;
        runs(&server, &robot.name, &version).await;
        let pulled = proxy.bytes_to_clients() - before;
        assert!(pulled < bytes as u64 / 2, "{name}: {pulled} bytes came over HTTP");
        let view = server.deployment(ordered.id.as_str()).await.expect("known");
        let chosen =
            view.assignments.expect("asked for")[0].delivery.clone().expect("its batch has begun");
        assert_eq!(chosen.mechanism, delivery, "{chosen:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn encrypted_mosquitto_is_verified_by_its_pin() {
    let dir = TempDir::new().expect("temp dir");
    let mut mosquitto = Mosquitto::new(dir.path());
    let pin = mosquitto.encrypt();
    mosquitto.launch().await;
    let wrong = CaPin::of(b"another authority").to_string();
    let settings = [("TASKD_BROKER", mosquitto.url()), ("TASKD_BROKER_PIN", wrong)];
    let settings = settings.each_ref().map(|(name, value)| (*name, value.as_str()));
    let mut server = Server::start_unready(&dir.path().join("server"), &settings).await;
    says(&server, "not the server whose certificate authority was pinned").await;
    server.restart_with("TASKD_BROKER_PIN", Some(&pin.to_string())).await;
    mosquitto.learn(&server).await;
    server.wait_ready().await;
    let _robot = Robot::start(&server, dir.path(), "robot-1", 1).await;
    mosquitto.learn(&server).await;
    wait_connected(&server, 1).await;
    server.push(&worker(dir.path(), "1.0.0"), "*").await;
    runs(&server, "robot-1", "1.0.0").await;
    // A server that trusts only the system's roots does not trust this broker.
    server.restart_with("TASKD_BROKER_PIN", None).await;
    says(&server, "the TLS handshake with").await;
}

/// A client with a robot's own name and password at the broker.
pub async fn spy(mosquitto: &Mosquitto, robot: &Robot, id: &str) -> (AsyncClient, EventLoop) {
    let identity: Value = serde_json::from_slice(
        &std::fs::read(robot.data().join("identity.json")).expect("identity"),
    )
    .expect("json");
    let password =
        identity["mqtt"]["external"]["password"].as_str().expect("a password from the enrollment");
    assert_ne!(identity["token"], password, "the token is not shown to the broker");
    let mut options =
        MqttOptions::new(id, mosquitto.address.ip().to_string(), mosquitto.address.port());
    options.set_credentials(robot.id.as_str(), password);
    AsyncClient::new(options, 16)
}

pub async fn next(events: &mut EventLoop) -> Packet {
    loop {
        if let Event::Incoming(packet) =
            tokio::time::timeout(TIMEOUT, events.poll()).await.expect("in time").expect("a session")
        {
            return packet;
        }
    }
}

fn status(online: bool) -> String {
    format!(r#"{{"online":{online},"start":1000,"instance":"i00000000000000a1","connection":1}}"#)
}

async fn publish(
    client: &AsyncClient,
    events: &mut EventLoop,
    robot: &RobotId,
    topic: &str,
    text: String,
) {
    client
        .publish(format!("taskd/v1/r/{robot}/{topic}"), QoS::AtLeastOnce, false, text)
        .await
        .expect("queued");
    while !matches!(next(events).await, Packet::PubAck(_)) {}
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_password_at_mosquitto_opens_only_its_own_topics() {
    let dir = TempDir::new().expect("temp dir");
    let mosquitto = Mosquitto::start(dir.path()).await;
    let server =
        Server::start_unready(&dir.path().join("server"), &[("TASKD_BROKER", &mosquitto.url())])
            .await;
    let mut robots = Vec::new();
    for number in 1..=2 {
        let mut robot = Robot::start(&server, dir.path(), &format!("robot-{number}"), number).await;
        robot.terminate();
        robots.push(robot);
    }
    mosquitto.learn(&server).await;
    server.wait_ready().await;
    let own = &robots[0].id;
    let other = &robots[1].id;
    let (client, mut events) = spy(&mosquitto, &robots[0], own.as_str()).await;
    for filter in
        ["#", "taskd/v1/#", "taskd/v1/r/+/desired", "taskd/v1/r/+/status", "taskd/v1/server"]
    {
        // Mosquitto grants any filter, and forwards only messages that the ACL allows.
        client.subscribe(filter, QoS::AtLeastOnce).await.expect("queued");
        while !matches!(next(&mut events).await, Packet::SubAck(_)) {}
    }

    // The status of the other robot is not accepted from this client, its own is.
    publish(&client, &mut events, other, "status", status(true)).await;
    publish(&client, &mut events, own, "status", status(true)).await;
    wait_connected(&server, 1).await;
    server.wait_online(own.as_str()).await;
    // The notice of the other robot's order is sent first, and does not arrive here; its own does.
    server.push(&worker(dir.path(), "1.0.0"), "robot-2").await;
    server.push(&worker(dir.path(), "1.1.0"), "robot-1").await;
    let desired = format!("taskd/v1/r/{own}/desired");
    let mut rung = 0;
    // Its state at the time of the connection, and the state with the order.
    while rung < 2 {
        if let Packet::Publish(message) = next(&mut events).await {
            assert_eq!(message.topic, desired);
            rung += 1;
        }
    }
    publish(&client, &mut events, own, "status", status(false)).await;
    wait_connected(&server, 0).await;
}

/// Whether the server is connected to this broker.
async fn is_at(server: &Server, broker: &Mosquitto) -> bool {
    let info = server.get("/api/v1/server").await.expect("it answers");
    info["mqtt"] == broker.address.to_string()
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_moves_to_the_servers_broker() {
    let dir = TempDir::new().expect("temp dir");
    let mut brokers =
        [Mosquitto::named(dir.path(), "first"), Mosquitto::named(dir.path(), "second")];
    let list = format!("{}, {}", brokers[0].url(), brokers[1].url());
    let server =
        Server::start_unready(&dir.path().join("server"), &[("TASKD_BROKER", &list)]).await;
    let robot = Robot::start(&server, dir.path(), "robot-1", 1).await;
    // The second broker accepts the robot and refuses the server.
    brokers[1].learn(&server).await;
    brokers[1].forget("taskd");
    brokers[1].launch().await;
    let is_there = format!(" as {}-", robot.id);
    eventually("the robot to be at the second broker", async || {
        brokers[1].log().contains(&is_there).then_some(())
    })
    .await;
    brokers[0].learn(&server).await;
    brokers[0].launch().await;
    server.wait_ready().await;
    assert!(is_at(&server, &brokers[0]).await, "the second one refuses it");
    // The server names the same endpoints in the same order as before.
    wait_connected(&server, 1).await;
    server.push(&worker(dir.path(), "1.0.0"), "*").await;
    runs(&server, "robot-1", "1.0.0").await;
    assert_eq!(logs(&server, "robot-1").await.from, LogsFrom::Robot, "asked over the first broker");
}

#[tokio::test(flavor = "multi_thread")]
async fn server_and_robots_fail_over_to_the_next_broker_of_the_list() {
    let dir = TempDir::new().expect("temp dir");
    let mut brokers =
        [Mosquitto::named(dir.path(), "first"), Mosquitto::named(dir.path(), "second")];
    let list = format!("{}, {}", brokers[0].url(), brokers[1].url());
    let server =
        Server::start_unready(&dir.path().join("server"), &[("TASKD_BROKER", &list)]).await;
    let robot = Robot::start(&server, dir.path(), "robot-1", 1).await;
    // Server and robot may find different brokers at first.
    for broker in &mut brokers {
        broker.learn(&server).await;
        broker.launch().await;
    }
    server.wait_ready().await;
    wait_connected(&server, 1).await;
    let is_at = async |broker: &Mosquitto| is_at(&server, broker).await;
    let (at, other) = if is_at(&brokers[0]).await { (0, 1) } else { (1, 0) };
    server.push(&worker(dir.path(), "1.0.0"), "*").await;
    runs(&server, "robot-1", "1.0.0").await;

    brokers[at].kill();
    eventually("the server to be at the other broker", async || {
        is_at(&brokers[other]).await.then_some(())
    })
    .await;
    server.wait_ready().await;
    wait_connected(&server, 1).await;
    server.push(&worker(dir.path(), "2.0.0"), "*").await;
    runs(&server, "robot-1", "2.0.0").await;
    let view = logs(&server, "robot-1").await;
    assert_eq!(view.from, LogsFrom::Robot, "asked over the second broker");

    // An agent that knows one address is told the server's current broker.
    let token: Value = serde_json::from_slice(
        &std::fs::read(robot.data().join("identity.json")).expect("identity"),
    )
    .expect("json");
    let url = server.url(&format!("/api/v1/robots/{}/mqtt", robot.id));
    let token = token["token"].as_str().expect("a token");
    let told = reqwest::Client::new().get(url).bearer_auth(token).send().await.expect("an answer");
    let told: Value = told.json().await.expect("an endpoint");
    assert_eq!(told["port"], brokers[other].address.port(), "{told}");
    assert_eq!(told["alternatives"][0]["port"], brokers[at].address.port(), "{told}");
}

#[tokio::test(flavor = "multi_thread")]
async fn robots_follow_the_server_to_another_broker_without_reenrollment() {
    let dir = TempDir::new().expect("temp dir");
    let mut mosquitto = Mosquitto::new(dir.path());
    let mut server = Server::start(&dir.path().join("server")).await;
    let refused = server.try_operate(["broker", "passwd"]).await;
    assert!(String::from_utf8_lossy(&refused.stderr).contains("no_external_broker"), "{refused:?}");
    let often =
        [("TASK_AGENT_POLL_INTERVAL_S", "3"), ("TASK_AGENT_POLL_INTERVAL_WITHOUT_MQTT_S", "2")];
    let _robot =
        Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &often).await;
    wait_connected(&server, 1).await;

    // The broker is down: HTTP works, robots poll, and the connection recovers by itself.
    server.restart_with("TASKD_BROKER", Some(&mosquitto.url())).await;
    says(&server, "can't be reached").await;
    server.push(&worker(dir.path(), "1.0.0"), "*").await;
    runs(&server, "robot-1", "1.0.0").await;
    mosquitto.learn(&server).await;
    mosquitto.launch().await;
    server.wait_ready().await;
    wait_connected(&server, 1).await;
    server.push(&worker(dir.path(), "2.0.0"), "*").await;
    runs(&server, "robot-1", "2.0.0").await;

    // Back to the built-in broker, while mosquitto lives on and holds the robot's session.
    server.restart_with("TASKD_BROKER", None).await;
    server.wait_ready().await;
    wait_connected(&server, 1).await;
    server.push(&worker(dir.path(), "3.0.0"), "*").await;
    runs(&server, "robot-1", "3.0.0").await;
}
