//! Watches the router: every few seconds a canary logs in through the real listener, publishes and must hear itself.
//! A router that is dead or stuck is started anew; what that does not cure is given up on, and the server told.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;

use bytes::BytesMut;
use rumqttd::protocol::{
    Connect, ConnectReturnCode, Error, Filter, Login, Packet, Protocol, Publish, QoS, RetainForwardRule, Subscribe,
    v4::V4,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::timeout;

use super::front::{CANARY_ID, CanaryPass, Front};
use super::router::{CANARY_TOPIC, Router};
use super::{Health, Limits};

/// Remedies tried in a row before the watchdog gives up.
const MAX_REMEDIES: u32 = 3;
/// More than any packet the canary gets.
const MAX_PACKET_BYTES: usize = 1024;

/// Starts watching; the receiver always has the latest finding.
pub(super) fn start(front: &Front, router: Arc<Router>, limits: &Limits) -> watch::Receiver<Health> {
    let (sender, receiver) = watch::channel(Health::Serving);
    let watchdog = Watchdog {
        address: reachable(front.local_addr()),
        pass: front.canary_pass(),
        router,
        limits: limits.clone(),
        health: sender,
        flights: 0,
    };
    let stop = front.stop();
    tokio::spawn(async move { stop.run_until_cancelled(watchdog.run()).await });
    receiver
}

struct Watchdog {
    address: SocketAddr,
    pass: Arc<CanaryPass>,
    router: Arc<Router>,
    limits: Limits,
    health: watch::Sender<Health>,
    flights: u64,
}

/// Why a canary did not come back.
#[derive(Debug, thiserror::Error)]
enum Lost {
    #[error("the MQTT listener does not accept connections")]
    Listener(#[source] std::io::Error),
    #[error("the MQTT connection broke")]
    Connection(#[source] std::io::Error),
    #[error("the MQTT front does not let the watchdog in: {0:?}")]
    NotAdmitted(ConnectReturnCode),
    #[error("the MQTT front answers with something else than expected")]
    Confused,
    #[error("no answer within the time allowed")]
    Late,
}

impl Watchdog {
    async fn run(mut self) {
        let mut remedies = 0;
        loop {
            let pause = tokio::time::sleep(self.limits.canary_interval);
            tokio::select! {
                () = pause => {}
                () = self.router.trouble() => {}
            }
            let Err(lost) = self.fly().await else {
                remedies = 0;
                self.health.send_if_modified(|health| {
                    let changed = *health != Health::Serving;
                    *health = Health::Serving;
                    changed
                });
                continue;
            };
            let lost: anyhow::Error = lost.into();
            if remedies == MAX_REMEDIES {
                tracing::error!("the MQTT broker is beyond repair: {lost:#}");
                self.health.send_replace(Health::Failed(format!("{lost:#}")));
                return;
            }
            remedies += 1;
            tracing::warn!(remedies, "the MQTT broker's canary is lost, its router is started anew: {lost:#}");
            self.health.send_replace(Health::Recovering(format!("{lost:#}")));
            if let Err(error) = self.router.restart().await {
                tracing::error!(%error, "the router did not start");
            }
        }
    }

    /// One canary, there and back.
    async fn fly(&mut self) -> Result<(), Lost> {
        self.flights += 1;
        let song = self.flights.to_string();
        let flight = fly(self.address, self.pass.renew(), &song);
        timeout(self.limits.canary_timeout, flight).await.unwrap_or(Err(Lost::Late))
    }
}

async fn fly(address: SocketAddr, password: String, song: &str) -> Result<(), Lost> {
    let stream = TcpStream::connect(address).await.map_err(Lost::Listener)?;
    let mut bird = Bird { stream, input: BytesMut::new() };
    let connect = Connect { keep_alive: 30, client_id: CANARY_ID.to_owned(), clean_session: true };
    let login = Login { username: CANARY_ID.to_owned(), password };
    match bird.ask(Packet::Connect(connect, None, None, None, Some(login))).await? {
        Packet::ConnAck(ack, _) if ack.code == ConnectReturnCode::Success => {}
        Packet::ConnAck(ack, _) => return Err(Lost::NotAdmitted(ack.code)),
        _ => return Err(Lost::Confused),
    }
    let filter = Filter {
        path: CANARY_TOPIC.to_owned(),
        qos: QoS::AtMostOnce,
        nolocal: false,
        preserve_retain: false,
        retain_forward_rule: RetainForwardRule::Never,
    };
    bird.ask(Packet::Subscribe(Subscribe { pkid: 1, filters: vec![filter] }, None)).await?;
    let publish = Publish::new(CANARY_TOPIC.to_owned(), song.to_owned(), false);
    match bird.ask(Packet::Publish(publish, None)).await? {
        Packet::Publish(heard, _) if heard.payload == song.as_bytes() => Ok(()),
        _ => Err(Lost::Confused),
    }
}

/// The smallest MQTT client that can sing.
struct Bird {
    stream: TcpStream,
    input: BytesMut,
}

impl Bird {
    /// Sends a packet and gives back the next that arrives.
    async fn ask(&mut self, packet: Packet) -> Result<Packet, Lost> {
        let mut output = BytesMut::new();
        V4.write(packet, &mut output).map_err(|_| Lost::Confused)?;
        self.stream.write_all(&output).await.map_err(Lost::Connection)?;
        loop {
            match V4.read_mut(&mut self.input, MAX_PACKET_BYTES) {
                Ok(packet) => return Ok(packet),
                Err(Error::InsufficientBytes(_)) => {}
                Err(_) => return Err(Lost::Confused),
            }
            if self.stream.read_buf(&mut self.input).await.map_err(Lost::Connection)? == 0 {
                return Err(Lost::Connection(std::io::ErrorKind::UnexpectedEof.into()));
            }
        }
    }
}

/// Where a listener on `bound` is reached from this machine.
fn reachable(bound: SocketAddr) -> SocketAddr {
    let ip = match bound.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    };
    SocketAddr::new(ip, bound.port())
}
