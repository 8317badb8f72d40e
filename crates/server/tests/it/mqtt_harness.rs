//! A broker with an in-memory gatekeeper and inbox, and a client that sends arbitrary bytes.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use task_proto::RobotId;
use task_proto::messages::topic::{RobotTopic, Topic, TopicPrefix};
use taskd::broker::{
    Broker, BrokerConfig, Gatekeeper, Inbox, Limits, Login, NotStored, Principal, Refusal,
    RobotMessage,
};
use taskd::config::TlsSettings;
use taskd::domain::limits::robot_limiter::{RobotLimiter, RobotLimits};
use taskd::net::proxy_protocol::ProxyProtocol;
use taskd::net::tls::Tls;
use taskd::system::clock::Clock;
use taskd::system::data_directory::DataDirectory;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{Mutex, Notify, mpsc};
use tokio::time::timeout;

/// Time limit that only a hanging test exceeds.
pub const PATIENCE: Duration = Duration::from_secs(10);

/// Admits robots with `pw-<robot id>`, and operators with `operator` or `operator-<name>`; some
/// passwords have other effects.
#[derive(Default)]
pub struct TestGatekeeper {
    /// Announces that a client with `once-<robot id>` is being admitted for the first time;
    /// [`TestGatekeeper::go_on`] completes the admission. The second time the client is refused. A
    /// client with `new-<robot id>` waits for `go_on` as well, and is a new token's first use.
    pub asked: Notify,
    pub go_on: Notify,
    was_asked: AtomicBool,
}

impl Gatekeeper for TestGatekeeper {
    fn admit(&self, login: Login) -> BoxFuture<'_, Result<Principal, Refusal>> {
        Box::pin(async move {
            let user = login.user_name.unwrap_or_default();
            match login.password.as_deref().ok_or(Refusal::NotAuthorised)? {
                "operator" => Ok(Principal::Operator("alice".parse().expect("a name"))),
                password if password.starts_with("operator-") => {
                    Ok(Principal::Operator(password["operator-".len()..].parse().expect("a name")))
                }
                "revoked" => Err(Refusal::NotAuthorised),
                "outage" => Err(Refusal::Unavailable),
                "slow" => std::future::pending().await,
                password if password.starts_with("once-") => {
                    if self.was_asked.swap(true, Ordering::SeqCst) {
                        return Err(Refusal::NotAuthorised);
                    }
                    self.asked.notify_one();
                    self.go_on.notified().await;
                    let robot = user.parse().expect("a robot's id");
                    Ok(Principal::Robot { robot, token_number: 0, is_first_use: false })
                }
                password if password.starts_with("new-") => {
                    self.go_on.notified().await;
                    let robot = user.parse().expect("a robot's id");
                    Ok(Principal::Robot { robot, token_number: 1, is_first_use: true })
                }
                password => match password.strip_prefix("pw-").map(str::parse) {
                    Some(Ok(robot)) if !user.is_empty() => {
                        Ok(Principal::Robot { robot, token_number: 0, is_first_use: false })
                    }
                    _ => Err(Refusal::BadCredentials),
                },
            }
        })
    }
}

/// Events received by the inbox.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Seen {
    Connected(RobotId, u64),
    Disconnected(RobotId, u64),
    Received(RobotId, RobotTopic, Bytes),
}

struct TestInbox {
    seen: mpsc::UnboundedSender<Seen>,
    refuse_messages: Arc<AtomicBool>,
}

impl Inbox for TestInbox {
    fn receive(&self, message: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>> {
        Box::pin(async move {
            if self.refuse_messages.load(Ordering::SeqCst) {
                return Err(NotStored);
            }
            if &message.payload[..] == b"stall" {
                return std::future::pending().await;
            }
            let _ = self.seen.send(Seen::Received(message.robot, message.topic, message.payload));
            Ok(())
        })
    }
    fn connected(&self, robot: &RobotId, _: Option<SocketAddr>, connection: u64, _: Option<u64>) {
        let _ = self.seen.send(Seen::Connected(robot.clone(), connection));
    }
    fn disconnected(&self, robot: &RobotId, connection: u64) {
        let _ = self.seen.send(Seen::Disconnected(robot.clone(), connection));
    }
    fn external_broker_connected(&self) {}
}

/// Limits under which no client is slowed or banned.
fn lenient() -> RobotLimits {
    RobotLimits {
        messages_per_s: 1 << 40,
        bytes_per_s: 1 << 40,
        backoff: Duration::ZERO,
        ..RobotLimits::default()
    }
}

/// A running broker.
pub struct TestBroker {
    pub broker: Broker,
    pub refuse_messages: Arc<AtomicBool>,
    pub gatekeeper: Arc<TestGatekeeper>,
    pub robot_limiter: Arc<RobotLimiter>,
    seen: Mutex<mpsc::UnboundedReceiver<Seen>>,
}

impl TestBroker {
    pub async fn start() -> Self {
        Self::with(|_| {}).await
    }

    /// No client is slowed or banned.
    pub async fn with(change: impl FnOnce(&mut Limits)) -> Self {
        Self::start_with(None, change, lenient()).await
    }

    pub async fn with_robot_limits(
        change: impl FnOnce(&mut Limits),
        robot_limits: RobotLimits,
    ) -> Self {
        Self::start_with(None, change, robot_limits).await
    }

    /// One that speaks TLS, by an authority of its own.
    pub async fn encrypted(change: impl FnOnce(&mut Limits)) -> Self {
        let directory = tempfile::TempDir::new().unwrap();
        let data = DataDirectory::open(directory.path()).unwrap();
        let tls = Tls::open(TlsSettings::default(), &data, Clock::system()).unwrap();
        Self::start_with(Some(tls), change, lenient()).await
    }

    async fn start_with(
        tls: Option<Tls>,
        change: impl FnOnce(&mut Limits),
        robot_limits: RobotLimits,
    ) -> Self {
        let robot_limiter = RobotLimiter::new(robot_limits);
        let mut limits = Limits { canary_interval: Duration::from_secs(3600), ..Limits::default() };
        change(&mut limits);
        let config = BrokerConfig {
            listen: "127.0.0.1:0".parse().unwrap(),
            tls,
            proxy_protocol: ProxyProtocol::new(&[]),
            prefix: TopicPrefix::default(),
            limits,
            robot_limiter: robot_limiter.clone(),
        };
        let (sender, receiver) = mpsc::unbounded_channel();
        let refuse_messages = Arc::new(AtomicBool::new(false));
        let inbox = TestInbox { seen: sender, refuse_messages: refuse_messages.clone() };
        let gatekeeper = Arc::new(TestGatekeeper::default());
        let broker = Broker::start(config, gatekeeper.clone(), Arc::new(inbox)).await.unwrap();
        Self { broker, refuse_messages, gatekeeper, robot_limiter, seen: Mutex::new(receiver) }
    }

    pub fn address(&self) -> SocketAddr {
        self.broker.local_addr().unwrap()
    }

    /// The next thing the inbox sees about `robot`.
    pub async fn next_of(&self, robot: &RobotId) -> Seen {
        let mut seen = self.seen.lock().await;
        timeout(PATIENCE, async {
            loop {
                let next = seen.recv().await.unwrap();
                let (Seen::Connected(seen_robot, _)
                | Seen::Disconnected(seen_robot, _)
                | Seen::Received(seen_robot, ..)) = &next;
                if seen_robot == robot {
                    return next;
                }
            }
        })
        .await
        .expect("the inbox should see something")
    }

    pub async fn raw(&self) -> Raw {
        Raw {
            stream: timeout(PATIENCE, TcpStream::connect(self.address())).await.unwrap().unwrap(),
        }
    }

    /// A client that has sent `packet` first.
    pub async fn raw_with(&self, packet: &[u8]) -> Raw {
        let mut raw = self.raw().await;
        raw.send(packet).await;
        raw
    }

    /// A connected robot.
    pub async fn robot(&self, robot: &RobotId) -> Raw {
        let mut raw = self.raw_with(&Connect::robot(robot).packet()).await;
        raw.expect(&[0x20, 2, 0, 0]).await;
        raw
    }

    /// A connected operator subscribed to `filter`.
    pub async fn operator(&self, filter: &str, qos: u8) -> Raw {
        let mut raw = self.raw_with(&Connect::operator("").packet()).await;
        raw.expect(&[0x20, 2, 0, 0]).await;
        raw.send(&subscribe(1, &[(filter, qos)])).await;
        raw.expect(&[0x90, 3, 0, 1, qos]).await;
        raw
    }

    /// Healthy clients still get through, all the way.
    pub async fn assert_serves(&self) {
        let robot = RobotId::random();
        let report = topic(&robot, RobotTopic::Report);
        let mut operator = self.operator(&report, 0).await;
        let mut client = self.robot(&robot).await;
        client.send(&subscribe(7, &[(&topic(&robot, RobotTopic::Desired), 1)])).await;
        client.expect(&[0x90, 3, 0, 7, 1]).await;
        self.broker.send_desired(&robot, Bytes::from_static(b"ding")).unwrap();
        client.expect(&publish(&topic(&robot, RobotTopic::Desired), 1, 1, b"ding")).await;
        client.send(&[0x40, 2, 0, 1]).await;
        client.send(&publish(&report, 1, 9, b"fine")).await;
        client.expect(&[0x40, 2, 0, 9]).await;
        operator.expect(&publish(&report, 0, 0, b"fine")).await;
    }
}

/// The fields of a CONNECT.
pub struct Connect {
    pub client_id: String,
    pub user_name: Option<String>,
    pub password: Option<String>,
    pub clean: bool,
    pub keep_alive_s: u16,
    pub will: Option<(String, Vec<u8>)>,
}

impl Connect {
    pub fn robot(robot: &RobotId) -> Self {
        Self {
            client_id: robot.to_string(),
            user_name: Some(robot.to_string()),
            password: Some(format!("pw-{robot}")),
            clean: true,
            keep_alive_s: 0,
            will: None,
        }
    }

    pub fn operator(client_id: &str) -> Self {
        Self {
            client_id: client_id.to_owned(),
            user_name: Some("anyone".to_owned()),
            password: Some("operator".to_owned()),
            clean: true,
            keep_alive_s: 0,
            will: None,
        }
    }

    pub fn packet(&self) -> Vec<u8> {
        let mut flags = u8::from(self.clean) << 1;
        let mut fields = text(&self.client_id);
        if let Some((topic, payload)) = &self.will {
            flags |= 0x04 | 0x08;
            fields.extend(text(topic));
            fields.extend(binary(payload));
        }
        for (flag, field) in [(0x80, &self.user_name), (0x40, &self.password)] {
            if let Some(field) = field {
                flags |= flag;
                fields.extend(text(field));
            }
        }
        let mut body = text("MQTT");
        body.extend([4, flags]);
        body.extend(self.keep_alive_s.to_be_bytes());
        body.extend(fields);
        framed(0x10, &body)
    }
}

pub fn topic(robot: &RobotId, last: RobotTopic) -> String {
    TopicPrefix::default().format(&Topic::Robot(robot.clone(), last))
}

pub fn publish(topic: &str, qos: u8, id: u16, payload: &[u8]) -> Vec<u8> {
    let mut body = text(topic);
    if qos > 0 {
        body.extend(id.to_be_bytes());
    }
    body.extend(payload);
    framed(0x30 | qos << 1, &body)
}

pub fn subscribe(id: u16, filters: &[(&str, u8)]) -> Vec<u8> {
    let mut body = id.to_be_bytes().to_vec();
    for (filter, qos) in filters {
        body.extend(text(filter));
        body.push(*qos);
    }
    framed(0x82, &body)
}

pub fn unsubscribe(id: u16, filters: &[&str]) -> Vec<u8> {
    let mut body = id.to_be_bytes().to_vec();
    for filter in filters {
        body.extend(text(filter));
    }
    framed(0xa2, &body)
}

pub fn framed(first: u8, body: &[u8]) -> Vec<u8> {
    let mut packet = vec![first];
    let mut length = body.len();
    loop {
        let byte = (length % 128) as u8;
        length /= 128;
        packet.push(if length > 0 { byte | 0x80 } else { byte });
        if length == 0 {
            break;
        }
    }
    packet.extend(body);
    packet
}

pub fn text(text: &str) -> Vec<u8> {
    binary(text.as_bytes())
}

pub fn binary(bytes: &[u8]) -> Vec<u8> {
    let mut field = u16::try_from(bytes.len()).unwrap().to_be_bytes().to_vec();
    field.extend(bytes);
    field
}

/// A client that knows no MQTT.
pub struct Raw<S = TcpStream> {
    pub stream: S,
}

impl<S: AsyncRead + AsyncWrite + Unpin> Raw<S> {
    /// Sends; that the other side has closed already is not this end's business.
    pub async fn send(&mut self, bytes: &[u8]) {
        let sending = async {
            self.stream.write_all(bytes).await?;
            self.stream.flush().await
        };
        let _ = timeout(PATIENCE, sending).await.expect("the broker should read");
    }

    /// The next packet must be this.
    pub async fn expect(&mut self, packet: &[u8]) {
        let mut got = vec![0; packet.len()];
        timeout(PATIENCE, self.stream.read_exact(&mut got))
            .await
            .unwrap_or_else(|_| panic!("{packet:02x?} should come"))
            .unwrap_or_else(|error| panic!("{packet:02x?} should come: {error}"));
        assert_eq!(got, packet, "{got:02x?} came, not {packet:02x?}");
    }

    /// The same for a packet that is too long to be shown.
    pub async fn expect_large(&mut self, packet: &[u8]) {
        let mut got = vec![0; packet.len()];
        let read = timeout(PATIENCE, self.stream.read_exact(&mut got))
            .await
            .expect("the packet should come");
        read.expect("the packet should come whole");
        assert!(got == packet, "another packet came");
    }

    /// The other side must close, and say nothing before.
    pub async fn expect_close(&mut self) {
        let mut rest = Vec::new();
        // A reset is a close as well.
        let _ = timeout(PATIENCE, self.stream.read_to_end(&mut rest))
            .await
            .expect("the broker should close");
        assert_eq!(rest, b"", "nothing should come before the end");
    }

    /// Nothing may have come before the answer to a ping.
    pub async fn expect_nothing(&mut self) {
        self.send(&[0xc0, 0]).await;
        self.expect(&[0xd0, 0]).await;
    }
}
