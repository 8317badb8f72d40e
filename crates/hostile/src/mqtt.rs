//! Packets and sessions of MQTT clients.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use bytes::BytesMut;
use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use task_proto::RobotId;
use task_proto::messages::topic::TopicPrefix;
use taskd::broker::codec::{DecodeError, Received, decode, encode_publish};
use taskd::broker::{
    Broker, BrokerConfig, Gatekeeper, Inbox, Limits, Login, NotStored, Principal, Refusal,
    RobotMessage,
};
use taskd::domain::limits::robot_limiter::{RobotLimiter, RobotLimits};
use taskd::net::proxy_protocol::ProxyProtocol;
use tokio::runtime::Runtime;

/// The largest packet that we try.
const MAX_PACKET_BYTES: usize = 2048;
/// Timeout, longer than any step here takes unless it hangs.
const PATIENCE: Duration = Duration::from_secs(20);
/// Limits for tests: the same robot breaks the rules again and again.
const LENIENT: RobotLimits = RobotLimits {
    messages_per_s: 1_000_000,
    bytes_per_s: 1 << 40,
    requests_per_s: 1_000_000,
    patience: Duration::MAX,
    backoff: Duration::ZERO,
    penalty_lifetime: Duration::ZERO,
};
/// The only robot that may connect.
const ROBOT: &str = "r00000000000000a1";
/// CONNECT as that robot.
const CONNECT: &[u8] =
    b"\x10\x32\x00\x04MQTT\x04\xc2\x00\x3c\x00\x11r00000000000000a1\x00\x11r00000000000000a1\x00\x00";

/// Packets from a client: the result does not depend on how the bytes are split, and every
/// published message has a topic that can be published to and reads back the same.
pub fn mqtt_packets(bytes: &[u8]) {
    let whole = read(bytes, bytes.len());
    for piece_bytes in [1, 7] {
        assert_eq!(read(bytes, piece_bytes), whole, "it depends on the pieces");
    }
    for packet in whole.0 {
        if let Received::Publish(publish) = packet {
            assert!(
                !publish.topic.is_empty() && !publish.topic.contains(['+', '#', '\0']),
                "{:?}",
                publish.topic
            );
            let mut written = BytesMut::new();
            encode_publish(&publish, &mut written);
            assert_eq!(
                decode(&mut written, MAX_PACKET_BYTES),
                Ok(Some(Received::Publish(publish)))
            );
            assert!(written.is_empty());
        }
    }
}

/// Reads all packets in `bytes`, split into pieces of this length; returns them with the error of
/// the next packet.
fn read(bytes: &[u8], piece_bytes: usize) -> (Vec<Received>, Option<DecodeError>) {
    let (mut packets, mut input) = (Vec::new(), BytesMut::new());
    for piece in bytes.chunks(piece_bytes.max(1)) {
        input.extend_from_slice(piece);
        loop {
            match decode(&mut input, MAX_PACKET_BYTES) {
                Ok(None) => break,
                Ok(Some(packet)) => packets.push(packet),
                Err(error) => return (packets, Some(error)),
            }
        }
    }
    (packets, None)
}

/// A connection, from its first byte or, if that is odd, after a valid CONNECT. The connection ends
/// when the client has sent everything. A refused client receives one packet or none. The inbox
/// receives messages of this robot only, and the next client is served.
pub fn mqtt_session(bytes: &[u8]) {
    let Some((&first, rest)) = bytes.split_first() else { return };
    let front = Front::running();
    // Several threads would take over each other's sessions.
    let _exclusive = front.exclusive.lock().unwrap_or_else(PoisonError::into_inner);
    let answer = front.exchange(&[if first % 2 == 0 { &[] } else { CONNECT }, rest].concat());
    match answer.get(..4) {
        None => assert!(answer.is_empty(), "half an answer: {}", answer.escape_ascii()),
        Some([0x20, 2, 0, 0]) => {}
        Some([0x20, 2, 0, 1..=5]) => {
            assert_eq!(answer.len(), 4, "more after a refusal: {}", answer.escape_ascii())
        }
        Some(_) => panic!("no CONNACK: {}", answer.escape_ascii()),
    }
    if first % 2 == 1 {
        assert_eq!(&answer[..4], [0x20, 2, 0, 0], "a good CONNECT was refused");
    }
    assert_eq!(
        front.exchange(&[CONNECT, b"\xe0\x00"].concat()),
        [0x20, 2, 0, 0],
        "the next client is not served"
    );
}

/// A broker that serves until the process ends.
struct Front {
    address: SocketAddr,
    exclusive: Mutex<()>,
    _broker: (Runtime, Broker),
}

impl Front {
    fn running() -> &'static Self {
        static FRONT: OnceLock<Front> = OnceLock::new();
        FRONT.get_or_init(|| {
            let runtime = Runtime::new().expect("a runtime");
            let limits = Limits { max_packet_bytes: MAX_PACKET_BYTES, ..Limits::default() };
            let listen = ([127, 0, 0, 1], 0).into();
            let robot_limiter = RobotLimiter::new(LENIENT);
            let config = BrokerConfig {
                listen,
                tls: None,
                proxy_protocol: ProxyProtocol::new(&[]),
                prefix: TopicPrefix::default(),
                limits,
                robot_limiter,
            };
            let broker = runtime
                .block_on(Broker::start(
                    config,
                    Arc::new(OneRobotGatekeeper),
                    Arc::new(CheckingInbox),
                ))
                .expect("a broker");
            let address = broker.local_addr().expect("an address");
            Self { address, exclusive: Mutex::default(), _broker: (runtime, broker) }
        })
    }

    /// Sends `bytes` and nothing more; returns the answer received until the connection ended.
    fn exchange(&self, bytes: &[u8]) -> Vec<u8> {
        let mut stream = TcpStream::connect(self.address).expect("connected");
        stream.set_read_timeout(Some(PATIENCE)).expect("set");
        let mut answer = Vec::new();
        // The server may rightly have closed the connection already.
        let sent = stream.write_all(bytes).and_then(|()| stream.shutdown(Shutdown::Write));
        match stream.read_to_end(&mut answer) {
            Ok(_) => {}
            Err(error)
                if matches!(error.kind(), ErrorKind::ConnectionReset | ErrorKind::BrokenPipe) => {}
            Err(error) => panic!("the connection does not end: {error} (sent: {sent:?})"),
        }
        answer
    }
}

struct OneRobotGatekeeper;

impl Gatekeeper for OneRobotGatekeeper {
    fn admit(&self, login: Login) -> BoxFuture<'_, Result<Principal, Refusal>> {
        let robot = ROBOT.parse().expect("valid");
        let known = login.user_name.as_deref() == Some(ROBOT);
        let answer = if known {
            Ok(Principal::Robot { robot, token_number: 0, is_first_use: false })
        } else {
            Err(Refusal::BadCredentials)
        };
        async { answer }.boxed()
    }
}

struct CheckingInbox;

impl Inbox for CheckingInbox {
    fn receive(&self, message: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>> {
        assert!(message.robot.as_str() == ROBOT && message.topic.is_from_robot(), "{message:?}");
        async { Ok(()) }.boxed()
    }

    fn connected(&self, robot: &RobotId, _: Option<SocketAddr>, _: u64, _: Option<u64>) {
        assert_eq!(robot.as_str(), ROBOT);
    }

    fn disconnected(&self, robot: &RobotId, _connection: u64) {
        assert_eq!(robot.as_str(), ROBOT);
    }

    fn external_broker_connected(&self) {}
}
