//! Encryption through the real programs: one token is all a robot needs, a proxy's one port is
//! enough, and a server other than the one of the robot's enrollment gets nothing.
#![expect(clippy::disallowed_methods, reason = "a test starts a proxy")]

use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;

use nix::sys::signal::Signal;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use task_proto::messages::report::Phase;

use crate::harness::{Process, Robot, Server, eventually, program, write_package};

const ENCRYPTED: (&str, &str) = ("TASKD_TLS_PRIVATE_CA", "true");
const KEYED: (&str, &str) = ("TASKD_TLS_CLIENT_CERTIFICATES", "true");

/// Pushes a package to `robot-1` and waits until the task runs.
async fn run_something(server: &Server, dir: &Path, version: &str) {
    let package = dir.join(format!("worker-{version}"));
    write_package(&package, "worker", version, "service", "exec sleep 1000\n");
    let package = package.to_str().expect("utf-8 path");
    let order = [
        "push",
        package,
        "--to",
        "robot-1",
        "--yes",
        "--delivery",
        "push-pull",
        "--wait",
        "--timeout",
        "80s",
    ];
    server.operate(order).await;
    server.wait_phase("robot-1", "worker", Phase::Running).await;
}

async fn connected(server: &Server) {
    eventually("the robot to be connected", async || server.robot("robot-1").await?.mqtt).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn token_pins_its_server_and_another_server_gets_nothing() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mut server = Server::start_with(&dir.path().join("server"), &[ENCRYPTED, KEYED]).await;
    let _robot = Robot::start(&server, dir.path(), "robot-1", 1).await;
    connected(&server).await;
    run_something(&server, dir.path(), "1.0.0").await;
    // At the same addresses there is now an impostor with all the knowledge of the robot that a
    // copy of the database reveals.
    server.terminate();
    let copy = dir.path().join("impostor");
    std::fs::create_dir(&copy).expect("made");
    for name in ["taskd.sqlite", "operator.token", "signing.key"] {
        std::fs::copy(server.data().join(name), copy.join(name)).expect("copied");
    }
    let mut impostor = Server::start_at(&copy, &[ENCRYPTED], server.http, server.mqtt).await;
    let log = dir.path().join("robot-1.agent.log");
    eventually("the robot to refuse the impostor", async || {
        let said = std::fs::read_to_string(&log).ok()?;
        said.contains("not the server whose certificate authority was pinned").then_some(())
    })
    .await;
    let seen = impostor.robot("robot-1").await.expect("it is in the database");
    assert!(!seen.online && seen.mqtt.is_none(), "{seen:?}");
    impostor.terminate();
    server.restart().await;
    connected(&server).await;
    run_something(&server, dir.path(), "2.0.0").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn token_for_an_encrypted_server_is_not_sent_in_plain_text() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start_with(&dir.path().join("server"), &[ENCRYPTED]).await;
    let token = server.enrollment_token().await;
    let plain = format!("http://{}", server.http);
    let agent = async |arguments: &[&str]| {
        let mut command = Command::new(program("task-agent"));
        command
            .args(arguments)
            .arg("--data")
            .arg(dir.path().join("robot-1"))
            .env("TASK_AGENT_SERVER", &plain);
        tokio::task::spawn_blocking(move || command.output().expect("task-agent runs"))
            .await
            .expect("no panic")
    };
    let enroll =
        |server| ["enroll", "--token", &token, "--mac", "02:00:00:00:00:01", "--server", server];
    let refused = agent(&enroll(&plain)).await;
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(
        !refused.status.success()
            && said.contains("--server: the token requires an encrypted server"),
        "{said}"
    );
    // The robot's own server is not trusted either, with any of the robot's settings.
    assert!(agent(&enroll(&server.url(""))).await.status.success());
    let refused = agent(&["run"]).await;
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(
        !refused.status.success()
            && said.contains("server: the token requires an encrypted server"),
        "{said}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn own_certificate_is_reloaded_without_a_restart() {
    let dir = tempfile::tempdir().expect("temp dir");
    let certificate = dir.path().join("own.pem");
    let key = dir.path().join("own.key");
    let authority = Authority::new(&dir.path().join("root.pem"));
    let put_in_place = || {
        let (chain, own_key) = authority.issue();
        std::fs::write(&certificate, chain).expect("written");
        std::fs::write(&key, own_key).expect("written");
    };
    put_in_place();
    let files = [
        ("TASKD_TLS_CERTIFICATE", certificate.to_str().expect("utf-8")),
        ("TASKD_TLS_KEY", key.to_str().expect("utf-8")),
    ];
    let server = Server::start_with(&dir.path().join("server"), &files).await;
    let roots = [("SSL_CERT_FILE", authority.root.to_str().expect("utf-8"))];
    let _robot =
        Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &roots).await;
    connected(&server).await;
    let since =
        server.robot("robot-1").await.and_then(|robot| robot.mqtt).expect("connected").since_ms;
    put_in_place();
    server.signal(Signal::SIGHUP);
    let log = dir.path().join("server.server.log");
    eventually("the server to take the new certificate", async || {
        std::fs::read_to_string(&log).ok()?.contains("loaded the new certificate").then_some(())
    })
    .await;
    run_something(&server, dir.path(), "1.0.0").await;
    let session =
        server.robot("robot-1").await.and_then(|robot| robot.mqtt).expect("still connected");
    assert_eq!(session.since_ms, since, "the session went on");
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_works_through_a_proxy_with_one_port() {
    let dir = tempfile::tempdir().expect("temp dir");
    let authority = Authority::new(&dir.path().join("root.pem"));
    // The MQTT port announced to robots has no listener, as behind a firewall.
    let closed = free_address().port().to_string();
    let server =
        Server::start_with(&dir.path().join("server"), &[("TASKD_PUBLIC_MQTT_PORT", &closed)])
            .await;
    let proxy = Proxy::start(&server, &authority, dir.path()).await;
    let roots = [("SSL_CERT_FILE", authority.root.to_str().expect("utf-8"))];
    let url = format!("https://{}", proxy.address);
    let _robot = Robot::start_with(&server, dir.path(), "robot-1", 1, &url, &roots).await;
    connected(&server).await;
    run_something(&server, dir.path(), "1.0.0").await;
    // The announcement came through the proxy as well.
    let session = server.robot("robot-1").await.and_then(|robot| robot.mqtt).expect("connected");
    assert!(session.traffic.messages_out > 0, "{session:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn mqtt_over_the_http_port_is_selected_by_a_setting() {
    let dir = tempfile::tempdir().expect("temp dir");
    let closed = free_address().port().to_string();
    let server = Server::start_with(
        &dir.path().join("server"),
        &[ENCRYPTED, KEYED, ("TASKD_PUBLIC_MQTT_PORT", &closed)],
    )
    .await;
    let only_http = [("TASK_AGENT_MQTT_TRANSPORT", "websocket")];
    let _robot =
        Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &only_http).await;
    connected(&server).await;
    run_something(&server, dir.path(), "1.0.0").await;
}

/// An authority that robots know by its root certificate.
struct Authority {
    issuer: Issuer<'static, KeyPair>,
    root: std::path::PathBuf,
}

impl Authority {
    fn new(root: &Path) -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect("no names");
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        let key = KeyPair::generate().expect("a key");
        std::fs::write(root, params.self_signed(&key).expect("signed").pem()).expect("written");
        Self { issuer: Issuer::new(params, key), root: root.to_owned() }
    }

    /// Certificate and key for this machine.
    fn issue(&self) -> (String, String) {
        let params = CertificateParams::new(vec!["127.0.0.1".to_owned()]).expect("a name");
        let key = KeyPair::generate().expect("a key");
        (params.signed_by(&key, &self.issuer).expect("signed").pem(), key.serialize_pem())
    }
}

fn free_address() -> SocketAddr {
    std::net::TcpListener::bind("127.0.0.1:0")
        .and_then(|listener| listener.local_addr())
        .expect("a port")
}

/// nginx, configured as in docs/tls.md.
struct Proxy {
    _process: Process,
    address: SocketAddr,
}

impl Proxy {
    async fn start(server: &Server, authority: &Authority, dir: &Path) -> Self {
        let address = free_address();
        let prefix = dir.join("nginx");
        std::fs::create_dir(&prefix).expect("made");
        let (certificate, key) = authority.issue();
        std::fs::write(prefix.join("proxy.pem"), certificate).expect("written");
        std::fs::write(prefix.join("proxy.key"), key).expect("written");
        // One process alone: a worker would outlive a master that is killed.
        let configuration = format!(
            "daemon off; master_process off; pid nginx.pid; error_log error.log; events {{}}
             http {{
                 access_log off; client_body_temp_path .; proxy_temp_path .;
                 fastcgi_temp_path .; uwsgi_temp_path .; scgi_temp_path .;
                 map $http_upgrade $connection_upgrade {{ default upgrade; '' ''; }}
                 server {{
                     listen {address} ssl;
                     ssl_certificate proxy.pem; ssl_certificate_key proxy.key;
                     client_max_body_size 0; proxy_request_buffering off; proxy_buffering off;
                     location / {{
                         proxy_pass http://{}; proxy_http_version 1.1; proxy_read_timeout 1h;
                         proxy_set_header Host $http_host;
                         proxy_set_header Upgrade $http_upgrade;
                         proxy_set_header Connection $connection_upgrade;
                     }}
                 }}
             }}\n",
            server.http
        );
        std::fs::write(prefix.join("nginx.conf"), configuration).expect("written");
        let path = format!("{}:/usr/sbin", std::env::var("PATH").unwrap_or_default());
        let mut command = Command::new("nginx");
        command.env("PATH", path).args(["-e", "error.log", "-c", "nginx.conf", "-p"]).arg(&prefix);
        let proxy = Self { _process: Process::spawn(&mut command), address };
        eventually("nginx to listen", async || tokio::net::TcpStream::connect(address).await.ok())
            .await;
        proxy
    }
}
