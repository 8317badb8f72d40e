//! TLS on both ports: clients' trust, the certificates they are shown, and that neither a change of
//! certificate nor a slow handshake disturbs other clients.

use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use nix::sys::resource::{Resource, getrlimit, setrlimit};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use reqwest::{Method, StatusCode};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject as _;
use rustls::{ClientConfig, RootCertStore};
use serde_json::json;
use task_proto::CaPin;
use task_proto::api::{EnrollResponse, EnrollmentToken, RobotToken};
use task_proto::trust::token::Token;
use task_transport::{ClientKey, Duplex, Route, Trust, dial};
use taskd::config::Config;
use taskd::http::connection::listener::{Limits, Service, serve};
use taskd::net::proxy_protocol::ProxyProtocol;
use taskd::system::clock::Clock;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;

use crate::harness::{NOW_MS, TestRobot, TestServer, client};
use crate::mqtt_harness::{Connect, PATIENCE, Raw};

/// Shorter than the limit of a handshake: a client served within this time has not waited for
/// another client's handshake.
const IN_TIME: Duration = Duration::from_secs(6);
/// The first bytes of a handshake record; the rest never arrives.
const BEGUN: [u8; 11] = [0x16, 0x03, 0x01, 0x02, 0x00, 0x01, 0x00, 0x01, 0xfc, 0x03, 0x03];

/// An authority that the operator has got certificates from.
struct Authority {
    issuer: Issuer<'static, KeyPair>,
    certificate: CertificateDer<'static>,
}

impl Authority {
    fn new() -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect("no names");
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        let key = KeyPair::generate().expect("a key");
        let certificate = params.self_signed(&key).expect("signed").der().clone();
        Self { issuer: Issuer::new(params, key), certificate }
    }

    /// Certificate and key, in PEM, for this machine.
    fn issue(&self) -> (String, String) {
        let params = CertificateParams::new(vec!["localhost".to_owned(), "127.0.0.1".to_owned()])
            .expect("names");
        let key = KeyPair::generate().expect("a key");
        (params.signed_by(&key, &self.issuer).expect("signed").pem(), key.serialize_pem())
    }

    fn client_config(&self) -> Arc<ClientConfig> {
        by_root(self.certificate.clone())
    }
}

/// A client that knows only this root, with a clock that matches the server's.
fn by_root(root: CertificateDer<'static>) -> Arc<ClientConfig> {
    let mut roots = RootCertStore::empty();
    roots.add(root).expect("an authority");
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let clock = Arc::new(task_transport::Clock { now_ms: || NOW_MS, earliest_ms: 0 });
    let builder =
        ClientConfig::builder_with_details(provider, clock).with_safe_default_protocol_versions();
    Arc::new(builder.expect("suites").with_root_certificates(roots).with_no_client_auth())
}

fn pinned(pin: CaPin) -> Arc<ClientConfig> {
    Arc::new(Trust::Pinned(pin).client_config(Clock::for_certificates()))
}

fn private(config: &mut Config) {
    config.tls.private_ca = Some(true);
}

async fn encrypted() -> TestServer {
    TestServer::start_in(TempDir::new().expect("a directory"), private).await
}

fn pin_of(server: &TestServer) -> CaPin {
    server.server.addresses().ca_pin.expect("it encrypts")
}

fn http_of(server: &TestServer) -> SocketAddr {
    server.server.addresses().http.parse().expect("an address")
}

fn mqtt_of(server: &TestServer) -> SocketAddr {
    server.server.addresses().mqtt.parse().expect("an address")
}

fn route(address: SocketAddr, tls: Option<Arc<ClientConfig>>) -> Route {
    Route { host: address.ip().to_string(), port: address.port(), tls, websocket: None }
}

/// A robot's session that was let in.
async fn session(route: &Route, robot: &TestRobot) -> Raw<Box<dyn Duplex>> {
    let stream = timeout(PATIENCE, dial(route)).await.expect("in time").expect("connected");
    let mut raw = Raw { stream };
    let connect = Connect { password: Some(robot.token.clone()), ..Connect::robot(&robot.id) };
    raw.send(&connect.packet()).await;
    raw.expect(&[0x20, 2, 0, 0]).await;
    raw
}

/// The certificate that a new connection is shown.
async fn shown(address: SocketAddr, tls: Arc<ClientConfig>) -> CertificateDer<'static> {
    let stream = TcpStream::connect(address).await.expect("connected");
    let name = "localhost".try_into().expect("a name");
    let stream = TlsConnector::from(tls).connect(name, stream).await.expect("shaken hands");
    stream.get_ref().1.peer_certificates().expect("shown")[0].clone().into_owned()
}

async fn asked_anew(address: SocketAddr, tls: &Arc<ClientConfig>) -> std::io::Result<String> {
    let stream = dial(&route(address, Some(tls.clone()))).await;
    let mut stream = stream.map_err(std::io::Error::other)?;
    stream.write_all(b"GET /healthz HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n").await?;
    stream.flush().await?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await?;
    Ok(answer)
}

#[tokio::test(flavor = "multi_thread")]
async fn enrollment_token_is_enough_to_trust_the_server() {
    let server = encrypted().await;
    let token: EnrollmentToken = server.post("/api/v1/enrollment-tokens", &json!({})).await;
    let token: Token = token.token.parse().expect("a token");
    assert_eq!(token.ca_pin(), Some(pin_of(&server)));
    let robot = server.enroll("atlas").await;
    assert_eq!(server.ask_desired(&robot).await.status(), StatusCode::OK);
    let endpoint = server
        .bare(Method::GET, &format!("/api/v1/robots/{}/mqtt", robot.id))
        .bearer_auth(&robot.token);
    let endpoint: task_proto::api::MqttEndpoint = crate::harness::answer(endpoint).await;
    assert!(endpoint.tls);
    let mut session =
        session(&route(mqtt_of(&server), Some(pinned(pin_of(&server)))), &robot).await;
    session.expect_nothing().await;
    // Nor does the page's cookie leave in plain text.
    let sign_in = server
        .bare(Method::POST, "/api/v1/session")
        .json(&json!({ "token": server.operator.reveal() }));
    let signed_in = sign_in.send().await.expect("an answer");
    assert!(
        signed_in.headers()["set-cookie"].to_str().expect("text").ends_with("; Secure"),
        "{signed_in:?}"
    );
    // Nothing is said in plain text, on neither port.
    for address in [http_of(&server), mqtt_of(&server)] {
        let mut plain = TcpStream::connect(address).await.expect("connected");
        plain.write_all(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n").await.expect("written");
        let mut answer = Vec::new();
        // A reset is no answer either.
        let _ = timeout(PATIENCE, plain.read_to_end(&mut answer)).await.expect("it ends");
        assert!(!answer.starts_with(b"HTTP"), "{answer:x?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn websocket_has_the_same_checks_as_the_mqtt_port() {
    let server = encrypted().await;
    let robot = server.enroll("atlas").await;
    let tls = Some(pinned(pin_of(&server)));
    let websocket = Route { websocket: Some("/mqtt".to_owned()), ..route(http_of(&server), tls) };
    session(&websocket, &robot).await.expect_nothing().await;
    for password in [None, Some(robot.token.replace("tskr", "tsko"))] {
        let mut raw = Raw { stream: dial(&websocket).await.expect("connected") };
        raw.send(&Connect { password, ..Connect::robot(&robot.id) }.packet()).await;
        raw.expect(&[0x20, 2, 0, 4]).await;
    }
    // Before authentication, a client gets as little room as there.
    let mut raw = Raw { stream: dial(&websocket).await.expect("connected") };
    raw.send(&[0x10, 0xff, 0xff, 0x7f]).await;
    let mut nothing = Vec::new();
    let _ = timeout(IN_TIME, raw.stream.read_to_end(&mut nothing)).await.expect("it ends at once");
    assert_eq!(nothing, b"");
    let plain = server.bare(Method::GET, "/mqtt").send().await.expect("an answer");
    assert_eq!(plain.status(), StatusCode::UPGRADE_REQUIRED);
    assert_eq!(plain.headers()["upgrade"], "websocket");
    assert_eq!(plain.headers()["sec-websocket-version"], "13");
}

#[tokio::test(flavor = "multi_thread")]
async fn pinned_robot_refuses_another_servers_certificate() {
    let (own, other) = (encrypted().await, encrypted().await);
    let requests = own.server.addresses().clone();
    assert_ne!(pin_of(&own), pin_of(&other));
    for trust in [Trust::Pinned(pin_of(&other)), Trust::System] {
        let refused = client(trust).get(own.url("/healthz")).send().await.expect_err("refused");
        assert!(refused.is_connect(), "{refused:?}");
        let tls = Arc::new(trust.client_config(Clock::for_certificates()));
        for address in [http_of(&own), mqtt_of(&own)] {
            let refused = dial(&route(address, Some(tls.clone()))).await.err().expect("refused");
            let said = format!("{:#}", anyhow::Error::from(refused));
            let by_pin = said.contains("not the server whose certificate authority was pinned");
            assert_eq!(by_pin, trust != Trust::System, "{said}");
        }
    }
    assert_eq!(requests, *own.server.addresses());
    assert!(
        asked_anew(http_of(&own), &pinned(pin_of(&own)))
            .await
            .expect("an answer")
            .starts_with("HTTP/1.1 200")
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn authority_is_created_once_and_can_be_imported() {
    let server = encrypted().await;
    let mode =
        |name: &str| server.data().join(name).metadata().expect(name).permissions().mode() & 0o777;
    assert_eq!((mode("ca.key"), mode("ca.pem")), (0o600, 0o600));
    let read = |server: &TestServer| std::fs::read(server.data().join("ca.pem")).expect("there");
    let (pin, file) = (pin_of(&server), read(&server));
    let server = TestServer::start_in(server.stop().await, private).await;
    assert_eq!((pin_of(&server), read(&server)), (pin, file.clone()));
    let root = CertificateDer::from_pem_slice(&file).expect("PEM");
    assert_eq!(task_transport::pin_of(&root), Some(pin));
    let answer = asked_anew(http_of(&server), &by_root(root)).await.expect("an answer");
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    let directory = server.stop().await;
    std::fs::write(directory.path().join("data/ca.pem"), Authority::new().issue().0)
        .expect("written");
    let mut config = Config::with_data(directory.path().join("data"));
    private(&mut config);
    let refused =
        taskd::serve::Server::start(config, Clock::system()).await.err().expect("refused");
    assert!(
        refused.to_string().contains("ca.pem does not contain the certificate of the key"),
        "{refused}"
    );
}

/// A server with the operator's own certificate in `directory`, looked at often.
async fn with_own_files(directory: TempDir) -> TestServer {
    let (certificate, key) = own_files(directory.path());
    TestServer::start_in(directory, |config| {
        (config.tls.certificate, config.tls.key) = (Some(certificate), Some(key));
        config.tls.check_interval = Duration::from_millis(2);
    })
    .await
}

fn own_files(directory: &Path) -> (std::path::PathBuf, std::path::PathBuf) {
    (directory.join("own.pem"), directory.join("own.key"))
}

fn put_in_place(directory: &Path, (certificate, key): &(String, String)) {
    let (certificate_path, key_path) = own_files(directory);
    std::fs::write(certificate_path, certificate).expect("written");
    std::fs::write(key_path, key).expect("written");
}

#[tokio::test(flavor = "multi_thread")]
async fn own_certificate_is_served_except_to_pinned_clients() {
    let (authority, directory) = (Authority::new(), TempDir::new().expect("a directory"));
    let own = authority.issue();
    put_in_place(directory.path(), &own);
    let server = with_own_files(directory).await;
    let token: EnrollmentToken = server.post("/api/v1/enrollment-tokens", &json!({})).await;
    assert_eq!(token.token.parse::<Token>().expect("a token").ca_pin(), None);
    let own = CertificateDer::from_pem_slice(own.0.as_bytes()).expect("PEM");
    for address in [http_of(&server), mqtt_of(&server)] {
        assert_eq!(shown(address, authority.client_config()).await, own);
        assert_ne!(shown(address, pinned(pin_of(&server))).await, own);
    }
    // A robot that knows the pin from before needs nothing new.
    let robot = server.enroll("atlas").await;
    session(&route(mqtt_of(&server), Some(pinned(pin_of(&server)))), &robot)
        .await
        .expect_nothing()
        .await;
}

/// Asks until a new connection is shown `certificate`.
async fn until_shown(server: &TestServer, authority: &Authority, certificate: &str) {
    let wanted = CertificateDer::from_pem_slice(certificate.as_bytes()).expect("PEM");
    let waiting =
        async { while shown(http_of(server), authority.client_config()).await != wanted {} };
    timeout(PATIENCE, waiting).await.expect("the new certificate is shown");
}

#[tokio::test(flavor = "multi_thread")]
async fn certificate_change_under_load_drops_no_connection() {
    let (authority, directory) = (Authority::new(), TempDir::new().expect("a directory"));
    put_in_place(directory.path(), &authority.issue());
    let path = directory.path().to_owned();
    let server = with_own_files(directory).await;
    let robot = server.enroll("atlas").await;
    let mut session =
        session(&route(mqtt_of(&server), Some(authority.client_config())), &robot).await;
    let mut kept =
        dial(&route(http_of(&server), Some(authority.client_config()))).await.expect("connected");
    let (stop, asked) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let load: Vec<_> = (0..4)
        .map(|_| {
            let (stop, asked, tls) = (stop.clone(), asked.clone(), authority.client_config());
            let address = http_of(&server);
            tokio::spawn(async move {
                while !stop.load(Ordering::SeqCst) {
                    let answer = asked_anew(address, &tls).await.expect("an answer");
                    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
                    asked.fetch_add(1, Ordering::SeqCst);
                }
            })
        })
        .collect();
    for _ in 0..10 {
        let next = authority.issue();
        let before = asked.load(Ordering::SeqCst);
        // First the one file, then the other, as a program that renews certificates does.
        put_in_place(&path, &next);
        until_shown(&server, &authority, &next.0).await;
        session.expect_nothing().await;
        kept.write_all(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n").await.expect("written");
        kept.flush().await.expect("flushed");
        let mut answer = [0; 12];
        kept.read_exact(&mut answer).await.expect("an answer");
        assert_eq!(&answer, b"HTTP/1.1 200");
        let mut rest = vec![0; 4096];
        let _ = kept.read(&mut rest).await.expect("its rest");
        let answered = async {
            while asked.load(Ordering::SeqCst) == before {
                tokio::task::yield_now().await;
            }
        };
        timeout(PATIENCE, answered).await.expect("others were answered meanwhile");
    }
    stop.store(true, Ordering::SeqCst);
    for asking in load {
        asking.await.expect("no client was dropped");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn certificate_without_its_key_is_not_served() {
    let (authority, directory) = (Authority::new(), TempDir::new().expect("a directory"));
    let (first, second) = (authority.issue(), authority.issue());
    put_in_place(directory.path(), &first);
    let path = directory.path().to_owned();
    let server = with_own_files(directory).await;
    let wrong = [
        (second.0.clone(), first.1.clone()),
        (second.0.clone(), "nothing".to_owned()),
        ("nothing".to_owned(), second.1.clone()),
    ];
    for wrong in wrong {
        put_in_place(&path, &wrong);
        // The first of the two to check reports the fault; the other finds nothing new.
        let _ = server.server.reload_certificate();
        until_shown(&server, &authority, &first.0).await;
    }
    put_in_place(&path, &second);
    until_shown(&server, &authority, &second.0).await;
    let directory = server.stop().await;
    put_in_place(&path, &(first.0, second.1));
    let (certificate, key) = own_files(&path);
    let mut config = Config::with_data(directory.path().join("data"));
    (config.tls.certificate, config.tls.key) = (Some(certificate), Some(key));
    let refused =
        taskd::serve::Server::start(config, Clock::system()).await.err().expect("refused");
    assert!(refused.to_string().contains("can't be used with the key in"), "{refused}");
}

/// Registers a robot that has a key.
async fn enroll_with_key(server: &TestServer, key: &ClientKey) -> TestRobot {
    let token: EnrollmentToken = server.post("/api/v1/enrollment-tokens", &json!({})).await;
    let request =
        json!({ "mac": "02:00:00:00:00:77", "name": "keyed", "client_key": key.public_key() });
    let enroll =
        server.bare(Method::POST, "/api/v1/enroll").bearer_auth(token.token).json(&request);
    let enrolled: EnrollResponse = crate::harness::answer(enroll).await;
    TestRobot::new(enrolled.robot_id, enrolled.token)
}

/// The HTTP and MQTT answers to the robot's token when presented with this key.
async fn answers_to(server: &TestServer, robot: &TestRobot, key: Option<&ClientKey>) -> (u16, u8) {
    let mut tls = ClientConfig::clone(&pinned(pin_of(server)));
    if let Some(key) = key {
        key.show_in(&mut tls).expect("a certificate");
    }
    let client = reqwest::Client::builder()
        .tls_backend_preconfigured(tls.clone())
        .build()
        .expect("a client");
    let desired = client
        .get(server.url(&format!("/api/v1/robots/{}/desired", robot.id)))
        .bearer_auth(&robot.token);
    let status = desired.send().await.expect("an answer").status().as_u16();
    let stream = dial(&route(mqtt_of(server), Some(Arc::new(tls)))).await.expect("connected");
    let mut raw = Raw { stream };
    let connect = Connect { password: Some(robot.token.clone()), ..Connect::robot(&robot.id) };
    raw.send(&connect.packet()).await;
    let mut answer = [0; 4];
    timeout(PATIENCE, raw.stream.read_exact(&mut answer))
        .await
        .expect("in time")
        .expect("an answer");
    assert_eq!(answer[..3], [0x20, 2, 0]);
    (status, answer[3])
}

#[tokio::test(flavor = "multi_thread")]
async fn token_is_refused_without_the_robots_client_certificate() {
    let configure = |config: &mut Config| {
        private(config);
        config.tls.client_certificates = true;
    };
    let server = TestServer::start_in(TempDir::new().expect("a directory"), configure).await;
    let (key, other) = (ClientKey::random(), ClientKey::random());
    let mut robot = enroll_with_key(&server, &key).await;
    let keyless = server.enroll("keyless").await;
    assert_eq!(answers_to(&server, &robot, None).await, (401, 4));
    assert_eq!(answers_to(&server, &robot, Some(&other)).await, (401, 4));
    assert_eq!(answers_to(&server, &robot, Some(&key)).await, (200, 0));
    // An earlier admission does not admit the next client.
    assert_eq!(answers_to(&server, &robot, None).await, (401, 4));
    assert_eq!(answers_to(&server, &keyless, None).await, (200, 0));
    assert_eq!(answers_to(&server, &keyless, Some(&other)).await, (200, 0));
    // The next token is bound to the key as well; another client that tries the token does not end
    // the one in use.
    let mut tls = ClientConfig::clone(&pinned(pin_of(&server)));
    key.show_in(&mut tls).expect("a certificate");
    let client =
        reqwest::Client::builder().tls_backend_preconfigured(tls).build().expect("a client");
    let next = client
        .post(server.url(&format!("/api/v1/robots/{}/token", robot.id)))
        .bearer_auth(&robot.token);
    let next: RobotToken = crate::harness::answer(next).await;
    let renewed = TestRobot::new(robot.id.clone(), next.token);
    assert_eq!(answers_to(&server, &renewed, None).await, (401, 4));
    assert_eq!(answers_to(&server, &robot, Some(&key)).await, (200, 0));
    assert_eq!(answers_to(&server, &renewed, Some(&key)).await, (200, 0));
    assert_eq!(answers_to(&server, &robot, Some(&key)).await, (401, 4));
    robot = renewed;
    let removed = server
        .request(Method::DELETE, &format!("/api/v1/robots/{}", robot.id))
        .send()
        .await
        .expect("an answer");
    assert!(removed.status().is_success());
    assert_eq!(answers_to(&server, &robot, Some(&key)).await, (401, 4));
}

/// Both ends of every connection are in this process.
pub fn allow_open_files() {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE).expect("a limit");
    setrlimit(Resource::RLIMIT_NOFILE, most, most).expect("raised");
}

#[tokio::test(flavor = "multi_thread")]
async fn half_open_connections_do_not_block_new_clients() {
    allow_open_files();
    let server = encrypted().await;
    let robot = server.enroll("atlas").await;
    let tls = pinned(pin_of(&server));
    let mut half_open = Vec::new();
    for number in 0..500 {
        for address in [http_of(&server), mqtt_of(&server)] {
            let mut stream = TcpStream::connect(address).await.expect("connected");
            if number % 2 == 0 {
                stream.write_all(&BEGUN).await.expect("written");
            }
            half_open.push(stream);
        }
    }
    // Some go on, a byte at a time.
    let dawdling = async {
        let mut ticks = tokio::time::interval(Duration::from_millis(20));
        loop {
            ticks.tick().await;
            for stream in half_open.iter_mut().rev().take(100) {
                // One that was closed meanwhile has had its time.
                let _ = stream.try_write(&[0]);
            }
        }
    };
    let arriving = async {
        for _ in 0..20 {
            let route = route(mqtt_of(&server), Some(tls.clone()));
            timeout(IN_TIME, session(&route, &robot))
                .await
                .expect("in time")
                .expect_nothing()
                .await;
            let answer =
                timeout(IN_TIME, asked_anew(http_of(&server), &tls)).await.expect("in time");
            assert!(answer.expect("an answer").starts_with("HTTP/1.1 200"));
        }
    };
    tokio::select! {
        () = dawdling => {}
        () = arriving => {}
    }
}

/// An HTTP listener that speaks TLS.
async fn listener(limits: Limits) -> (SocketAddr, tokio_util::sync::DropGuard, TempDir) {
    let directory = TempDir::new().expect("a directory");
    let data = taskd::system::data_directory::DataDirectory::open(directory.path()).expect("opens");
    let tls = taskd::net::tls::Tls::open(Default::default(), &data, Clock::system()).expect("made");
    let listener = taskd::net::backlog::listen(([127, 0, 0, 1], 0).into()).expect("listens");
    let address = listener.local_addr().expect("bound");
    let stop = tokio_util::sync::CancellationToken::new();
    let (router, traffic) = (axum::Router::new(), Arc::default());
    let service = Service { router, tls: Some(tls), connections: Arc::default(), traffic };
    tokio::spawn(serve(listener, service, limits, stop.clone(), Duration::from_secs(1)));
    (address, stop.drop_guard(), directory)
}

#[tokio::test(flavor = "multi_thread")]
async fn oldest_silent_connection_is_evicted_during_its_handshake() {
    const HOUR: Duration = Duration::from_secs(3600);
    let limits = Limits {
        max_connections: 1000,
        max_silent_per_address: 1,
        proxies: [].into(),
        proxy_protocol: ProxyProtocol::new(&[]),
        handshake_timeout: HOUR,
    };
    let (http, _stop, _directory) = listener(limits).await;
    let broker = crate::mqtt_harness::TestBroker::encrypted(|limits| {
        (limits.max_silent_per_address, limits.connect_timeout) = (1, HOUR);
    })
    .await;
    for address in [http, broker.address()] {
        let mut oldest = TcpStream::connect(address).await.expect("connected");
        oldest.write_all(&BEGUN).await.expect("written");
        let newcomers = async {
            let (mut ticks, mut all) =
                (tokio::time::interval(Duration::from_millis(200)), Vec::new());
            loop {
                ticks.tick().await;
                all.push(TcpStream::connect(address).await.expect("connected"));
            }
        };
        let mut rest = Vec::new();
        let ended = timeout(PATIENCE, async {
            tokio::select! {
                ended = oldest.read_to_end(&mut rest) => ended,
                () = newcomers => unreachable!("they go on coming"),
            }
        });
        // A reset is an end as well.
        let _ = ended.await.expect("the connection ends");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_socket_and_slow_handshake_time_out() {
    let hasty = Duration::from_millis(200);
    let (http, _stop, _directory) = listener(Limits {
        max_connections: 1,
        max_silent_per_address: 10,
        proxies: [].into(),
        proxy_protocol: ProxyProtocol::new(&[]),
        handshake_timeout: hasty,
    })
    .await;
    let broker = crate::mqtt_harness::TestBroker::encrypted(|limits| {
        (limits.connect_timeout, limits.max_connections) = (hasty, 1);
    })
    .await;
    for address in [http, broker.address()] {
        for slow in [false, true] {
            // There is one place: a connection that held the place beyond its time would keep the
            // next from being accepted.
            let stream = TcpStream::connect(address).await.expect("connected");
            let (mut reading, mut writing) = stream.into_split();
            let dribbling = async {
                let mut ticks = tokio::time::interval(Duration::from_millis(20));
                loop {
                    ticks.tick().await;
                    if slow && writing.write_all(&[0x16]).await.is_err() {
                        std::future::pending::<()>().await;
                    }
                }
            };
            let mut rest = Vec::new();
            let ended = timeout(PATIENCE, async {
                tokio::select! {
                    ended = reading.read_to_end(&mut rest) => ended,
                    () = dribbling => unreachable!("the trickle never ends"),
                }
            });
            // A reset is an end as well.
            let _ = ended.await.expect("the connection ends");
        }
    }
}
