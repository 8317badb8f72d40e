//! A balancer in front of both listeners begins each connection with the address of its client: a
//! real one, HAProxy, and headers that a test writes itself.

use std::net::{Ipv4Addr, SocketAddr};
use std::os::fd::OwnedFd;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value, json};
use task_transport::{Duplex, Route, Trust, secure};
use taskd::config::Config;
use taskd::net::proxy_protocol::LOCAL_HEADER;
use taskd::system::clock::Clock;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpSocket, TcpStream};
use tokio::process::{Child, Command};
use tokio::time::timeout;

use crate::harness::TestServer;
use crate::mqtt_harness::{Connect, PATIENCE, Raw};

/// The balancer's own address. The tests' other requests come from 127.0.0.1.
const BALANCER: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 9);
const REQUEST: &[u8] = b"GET /healthz HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n";

/// HAProxy in front of both listeners, configured as in docs/cluster.md without the checks, with
/// listeners that the test has opened.
struct HaProxy {
    _process: Child,
    http: SocketAddr,
    mqtt: SocketAddr,
}

impl HaProxy {
    #[expect(clippy::disallowed_methods, reason = "the test needs a balancer")]
    fn start(server: &TestServer) -> Self {
        let listeners = [(); 2].map(|()| std::net::TcpListener::bind("127.0.0.1:0").unwrap());
        let [http, mqtt] = listeners.each_ref().map(|listener| listener.local_addr().unwrap());
        let [standard_input, standard_output] =
            listeners.map(|listener| Stdio::from(OwnedFd::from(listener)));
        let addresses = server.server.addresses();
        let listen = |name: &str, descriptor: u8, address: &str| {
            format!(
                "listen {name}\n bind fd@{descriptor}\n \
                 server taskd {address} send-proxy-v2 source {BALANCER}\n"
            )
        };
        let config = format!(
            "defaults\n mode tcp\n timeout connect 5s\n timeout client 1m\n timeout server 1m\n{}{}",
            listen("taskd-http", 0, &addresses.http),
            listen("taskd-mqtt", 1, &addresses.mqtt),
        );
        let path = server.directory.path().join("haproxy.cfg");
        std::fs::write(&path, config).unwrap();
        let process = Command::new("haproxy")
            .args(["-db", "-f"])
            .arg(path)
            .stdin(standard_input)
            .stdout(standard_output)
            .kill_on_drop(true)
            .spawn()
            .expect("HAProxy starts: apt-get install haproxy");
        Self { _process: process, http, mqtt }
    }
}

async fn server(configure: impl FnOnce(&mut Config)) -> TestServer {
    TestServer::start_in(TempDir::new().unwrap(), |config| {
        config.proxies = vec![BALANCER.into()];
        configure(config);
    })
    .await
}

/// The addresses of the HTTP and the MQTT listener.
fn listeners(server: &TestServer) -> [SocketAddr; 2] {
    let addresses = server.server.addresses();
    [&addresses.http, &addresses.mqtt].map(|address| address.parse().unwrap())
}

/// A connection from an address of this machine.
async fn connect(from: Ipv4Addr, to: SocketAddr) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind((from, 0).into()).unwrap();
    socket.connect(to).await.expect("connects")
}

/// A connection from the balancer that begins with this header.
async fn connect_as_balancer(header: &[u8], to: SocketAddr) -> Raw {
    let mut raw = Raw { stream: connect(BALANCER, to).await };
    raw.send(header).await;
    raw
}

/// The header of a client with this address.
fn header(client: Ipv4Addr) -> Vec<u8> {
    let mut header = LOCAL_HEADER.to_vec();
    header[12..].copy_from_slice(&[0x21, 0x11, 0, 12]);
    header.extend(client.octets());
    header.extend([10, 0, 0, 1, 0xc0, 0x01, 0x1f, 0x90]);
    header
}

/// All that the other side sends until it closes.
async fn read_all(stream: &mut (impl tokio::io::AsyncRead + Unpin)) -> String {
    let mut rest = Vec::new();
    // A reset is an end as well.
    let _ = timeout(PATIENCE, stream.read_to_end(&mut rest)).await.expect("the connection ends");
    String::from_utf8_lossy(&rest).into_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn clients_behind_haproxy_have_their_own_addresses() {
    for encrypts in [false, true] {
        let server = server(|config| config.tls.private_ca = Some(encrypts)).await;
        let haproxy = HaProxy::start(&server);
        let pin = server.server.addresses().ca_pin;
        assert_eq!(pin.is_some(), encrypts);
        let tls = pin.map(|pin| Trust::by(Some(pin)).client_config(Clock::for_certificates()));
        let tls = tls.map(Arc::new);
        let reach = async |from: Ipv4Addr, to: SocketAddr| -> Box<dyn Duplex> {
            let (host, port) = (to.ip().to_string(), to.port());
            let route = Route { host, port, tls: tls.clone(), websocket: None };
            secure(connect(from, to).await, &route).await.expect("connects")
        };

        let mut person = reach(Ipv4Addr::new(127, 0, 0, 5), haproxy.http).await;
        let create = format!(
            "POST /api/v1/enrollment-tokens HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {}\r\n\
             content-type: application/json\r\ncontent-length: 2\r\nconnection: close\r\n\r\n{{}}",
            server.operator.reveal()
        );
        person.write_all(create.as_bytes()).await.expect("written");
        let answered = read_all(&mut person).await;
        assert!(answered.starts_with("HTTP/1.1 20"), "{answered}");
        let audit: Value = server.get("/api/v1/audit").await;
        assert_eq!(audit["records"][0]["entry"]["address"], "127.0.0.5");

        let robot = server.enroll("atlas").await;
        let login =
            Connect { password: Some(robot.token.clone()), ..Connect::robot(&robot.id) }.packet();
        let mut session = Raw { stream: reach(Ipv4Addr::new(127, 0, 0, 6), haproxy.mqtt).await };
        session.send(&login).await;
        session.expect(&[0x20, 2, 0, 0]).await;
        session.expect_nothing().await;
        let shown = server.robot(&robot).await.address.expect("connected");
        assert!(shown.starts_with("127.0.0.6:"), "{shown}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn failed_sign_ins_behind_a_balancer_are_counted_by_client() {
    let server = server(|_| {}).await;
    let [http, _] = listeners(&server);
    let sign_in = async |n: u8, client: Ipv4Addr| {
        let mut raw = connect_as_balancer(&header(client), http).await;
        let body = json!({ "user": format!("nobody{n}"), "password": "guess" }).to_string();
        let request = format!(
            "POST /api/v1/login HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\n\
             content-length: {}\r\nconnection: close\r\n\r\n{body}",
            body.len()
        );
        raw.send(request.as_bytes()).await;
        read_all(&mut raw.stream).await["HTTP/1.1 ".len()..][..3].to_owned()
    };
    let [first, second] = [7, 8].map(|last| Ipv4Addr::new(192, 0, 2, last));
    for n in 0..50 {
        assert_eq!(sign_in(n, first).await, "401");
    }
    assert_eq!(sign_in(50, first).await, "429");
    assert_eq!(sign_in(50, second).await, "401");
}

#[tokio::test(flavor = "multi_thread")]
async fn connection_of_a_balancer_without_a_header_is_closed() {
    let server = server(|_| {}).await;
    let [http, mqtt] = listeners(&server);
    let login = Connect::operator("").packet();
    for (address, bytes) in [(http, REQUEST), (mqtt, &login)] {
        connect_as_balancer(bytes, address).await.expect_close().await;
        let half = [&header(Ipv4Addr::LOCALHOST)[..20], b"\0\0\0"].concat();
        let mut cut_off = connect_as_balancer(&half, address).await;
        cut_off.stream.shutdown().await.expect("half closed");
        cut_off.expect_close().await;
    }
    // A health check of the balancer itself.
    let mut check = connect_as_balancer(&[&LOCAL_HEADER, REQUEST].concat(), http).await;
    assert!(read_all(&mut check.stream).await.starts_with("HTTP/1.1 200"));
    let mut check = connect_as_balancer(&[&LOCAL_HEADER[..], &login].concat(), mqtt).await;
    check.expect(&[0x20, 2, 0, 4]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn header_from_another_address_than_a_balancers_is_not_accepted() {
    let server = server(|_| {}).await;
    let [http, mqtt] = listeners(&server);
    let forged = header(Ipv4Addr::new(192, 0, 2, 7));
    let stranger = Ipv4Addr::new(127, 0, 0, 5);
    let mut raw = Raw { stream: connect(stranger, http).await };
    raw.send(&[&forged[..], REQUEST].concat()).await;
    let answered = read_all(&mut raw.stream).await;
    assert!(answered.is_empty() || answered.starts_with("HTTP/1.1 400"), "{answered}");
    let mut raw = Raw { stream: connect(stranger, mqtt).await };
    raw.send(&[forged, Connect::operator("").packet()].concat()).await;
    raw.expect_close().await;
    // Without a header the address is served.
    let mut raw = Raw { stream: connect(stranger, http).await };
    raw.send(REQUEST).await;
    assert!(read_all(&mut raw.stream).await.starts_with("HTTP/1.1 200"));
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_connections_behind_a_balancer_are_limited_by_client() {
    let server = server(|config| config.max_silent_per_address = 1).await;
    let [http, mqtt] = listeners(&server);
    let (crowd, other) = (header(Ipv4Addr::new(192, 0, 2, 7)), header(Ipv4Addr::new(192, 0, 2, 8)));
    let login = Connect::operator("").packet();
    for (address, bytes, answer) in
        [(http, REQUEST, &b"HTTP/1.1 200"[..]), (mqtt, &login, &[0x20, 2, 0, 4])]
    {
        let mut oldest = connect_as_balancer(&crowd, address).await;
        let mut quiet = connect_as_balancer(&other, address).await;
        let newcomers = async {
            let mut all = Vec::new();
            let mut ticks = tokio::time::interval(Duration::from_millis(200));
            loop {
                ticks.tick().await;
                all.push(connect_as_balancer(&crowd, address).await);
            }
        };
        // Sooner than a silent connection times out.
        let ended = timeout(Duration::from_secs(8), async {
            tokio::select! {
                () = oldest.expect_close() => {}
                () = newcomers => unreachable!("they go on coming"),
            }
        });
        ended.await.expect("the oldest connection of the crowd is closed");
        quiet.send(bytes).await;
        quiet.expect(answer).await;
    }
}
