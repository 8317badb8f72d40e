//! Watches the router: every few seconds a canary logs in through the real listener, publishes and
//! must receive its own message. A dead or stuck router is restarted. If that does not help, the
//! watchdog gives up and tells the server.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;

use bytes::BytesMut;
use rumqttd::protocol::{
    Connect, ConnectReturnCode, Error, Filter, Login, Packet, Protocol, Publish, QoS,
    RetainForwardRule, Subscribe, v4::V4,
};
use task_transport::{DialError, Duplex, Route, connect, secure};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::sync::watch;
use tokio::time::timeout;

use super::front::{CANARY_ID, CanaryPass, Front};
use super::router::{CANARY_TOPIC, Router};
use super::{Health, Limits};
use crate::net::proxy_protocol::{LOCAL_HEADER, ProxyProtocol};
use crate::net::tls::Tls;

/// Consecutive remedies before the watchdog gives up.
const MAX_REMEDIES: u32 = 3;
/// Larger than any packet that the canary receives.
const MAX_PACKET_BYTES: usize = 1024;

/// Starts watching; the receiver always has the latest finding.
pub(super) fn start(
    front: &Front,
    router: Arc<Router>,
    limits: &Limits,
) -> watch::Receiver<Health> {
    let (sender, receiver) = watch::channel(Health::Serving);
    let watchdog = Watchdog {
        route: route(front),
        proxy_protocol: front.proxy_protocol().clone(),
        pass: front.canary_pass(),
        router,
        limits: limits.clone(),
        health: sender,
        probes: 0,
    };
    let stop = front.stop();
    tokio::spawn(async move { stop.run_until_cancelled(watchdog.run()).await });
    receiver
}

struct Watchdog {
    route: Route,
    proxy_protocol: ProxyProtocol,
    pass: Arc<CanaryPass>,
    router: Arc<Router>,
    limits: Limits,
    health: watch::Sender<Health>,
    probes: u64,
}

/// The reason why a canary did not come back, by its remedy.
#[derive(Debug, thiserror::Error)]
enum ProbeError {
    /// No remedy helps, if the failure lasts.
    #[error("the MQTT listener does not accept connections")]
    Listener(#[source] DialError),
    /// Time helps: the watchdog has no connection of its own, as when too many files are open. That
    /// is no evidence about the listener.
    #[error("the watchdog can't open a connection to the MQTT listener")]
    Dial(#[source] DialError),
    /// Time helps: too many connections, or overload. A new router would only increase the load.
    #[error("the MQTT listener did not admit the watchdog: {0}")]
    Front(&'static str),
    /// A new router helps.
    #[error("the message router does not work: {0}")]
    Router(&'static str),
}

impl ProbeError {
    /// Classifies a failed attempt to connect.
    fn from_dial(error: DialError) -> Self {
        let refused = io::ErrorKind::ConnectionRefused;
        let is_refused =
            matches!(&error, DialError::Connect { source, .. } if source.kind() == refused);
        match error {
            error if is_refused => Self::Listener(error),
            // For example, the front closes a connection for which it has no room.
            DialError::Tls { .. } => Self::Front("the connection broke"),
            error => Self::Dial(error),
        }
    }

    /// Whether the failure may end the server, if it lasts.
    fn is_failure(&self) -> bool {
        matches!(self, Self::Listener(_) | Self::Router(_))
    }
}

impl Watchdog {
    async fn run(mut self) {
        let mut failures = 0;
        loop {
            tokio::select! {
                () = tokio::time::sleep(self.limits.canary_interval) => {}
                () = self.router.failure_observed() => {}
            }
            let Err(error) = self.run_probe().await else {
                failures = 0;
                self.set_health(Health::Serving);
                continue;
            };
            let reason = error.to_string();
            if error.is_failure() {
                failures += 1;
            }
            if failures > MAX_REMEDIES {
                tracing::error!(
                    "the MQTT broker could not be recovered: {:#}",
                    anyhow::Error::from(error)
                );
                self.set_health(Health::Failed(reason));
                return;
            }
            if let ProbeError::Router(_) = error {
                tracing::warn!("{error}; restarting it");
                if let Err(error) = self.router.restart().await {
                    tracing::error!("failed to restart the message router: {error}");
                }
            } else {
                tracing::warn!("{:#}", anyhow::Error::from(error));
            }
            self.set_health(Health::Recovering(reason));
        }
    }

    fn set_health(&self, new: Health) {
        self.health.send_if_modified(|health| std::mem::replace(health, new.clone()) != new);
    }

    async fn connect(&self) -> Result<Probe, ProbeError> {
        let mut stream = connect(&self.route).await.map_err(ProbeError::from_dial)?;
        // A balancer may be at this machine's own address.
        let is_proxy = |own: SocketAddr| self.proxy_protocol.applies_to(own.ip());
        if stream.local_addr().is_ok_and(is_proxy) && stream.write_all(&LOCAL_HEADER).await.is_err()
        {
            return Err(ProbeError::Front("the connection broke"));
        }
        let stream = secure(stream, &self.route).await.map_err(ProbeError::from_dial)?;
        Probe::log_in(stream, self.pass.renew()).await
    }

    /// Sends one canary and waits for its message.
    async fn run_probe(&mut self) -> Result<(), ProbeError> {
        self.probes += 1;
        let patience = self.limits.canary_timeout;
        let connecting = timeout(patience, self.connect()).await;
        let mut probe = connecting.unwrap_or(Err(ProbeError::Front("no answer in time")))?;
        let echoing = timeout(patience, probe.echo(self.probes.to_string())).await;
        echoing.unwrap_or(Err(ProbeError::Router(
            "the watchdog did not receive its own message in time",
        )))
    }
}

/// A minimal MQTT client for the canary.
struct Probe {
    stream: Box<dyn Duplex>,
    input: BytesMut,
}

impl Probe {
    async fn log_in(stream: Box<dyn Duplex>, password: String) -> Result<Self, ProbeError> {
        let mut probe = Self { stream, input: BytesMut::new() };
        let connect =
            Connect { keep_alive: 30, client_id: CANARY_ID.to_owned(), clean_session: true };
        let login = Login { username: CANARY_ID.to_owned(), password };
        match probe.ask(Packet::Connect(connect, None, None, None, Some(login))).await {
            Some(Packet::ConnAck(ack, _)) => match ack.code {
                ConnectReturnCode::Success => Ok(probe),
                // The only resource that the front needs for a canary is a link to the router.
                ConnectReturnCode::ServiceUnavailable => {
                    Err(ProbeError::Router("it does not accept new links"))
                }
                _ => Err(ProbeError::Front("it refused the password")),
            },
            _ => Err(ProbeError::Front("the connection broke")),
        }
    }

    async fn echo(&mut self, text: String) -> Result<(), ProbeError> {
        let filter = Filter {
            path: CANARY_TOPIC.to_owned(),
            qos: QoS::AtMostOnce,
            nolocal: false,
            preserve_retain: false,
            retain_forward_rule: RetainForwardRule::Never,
        };
        let broke = ProbeError::Router("the watchdog's connection broke");
        let Some(_) =
            self.ask(Packet::Subscribe(Subscribe { pkid: 1, filters: vec![filter] }, None)).await
        else {
            return Err(broke);
        };
        let publish = Publish::new(CANARY_TOPIC.to_owned(), text.clone(), false);
        match self.ask(Packet::Publish(publish, None)).await {
            Some(Packet::Publish(received, _)) if received.payload == text.as_bytes() => Ok(()),
            _ => Err(broke),
        }
    }

    /// Sends a packet and returns the next one that arrives; `None` if the connection breaks.
    async fn ask(&mut self, packet: Packet) -> Option<Packet> {
        let mut output = BytesMut::new();
        V4.write(packet, &mut output).ok()?;
        self.stream.write_all(&output).await.ok()?;
        self.stream.flush().await.ok()?;
        loop {
            match V4.read_mut(&mut self.input, MAX_PACKET_BYTES) {
                Ok(packet) => return Some(packet),
                Err(Error::InsufficientBytes(_)) => {}
                Err(_) => return None,
            }
            if self.stream.read_buf(&mut self.input).await.ok()? == 0 {
                return None;
            }
        }
    }
}

fn route(front: &Front) -> Route {
    let address = reachable(front.local_addr());
    let tls = front.tls().map(Tls::client_config);
    Route { host: address.ip().to_string(), port: address.port(), tls, websocket: None }
}

/// The address at which this machine reaches a listener bound to `bound`.
fn reachable(bound: SocketAddr) -> SocketAddr {
    let ip = match bound.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    };
    SocketAddr::new(ip, bound.port())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use futures_util::future::BoxFuture;
    use task_proto::RobotId;
    use task_proto::messages::topic::TopicPrefix;
    use tokio::net::TcpStream;

    use super::super::{
        BrokerConfig, Gatekeeper, Inbox, NotStored, Principal, Refusal, RobotMessage,
    };
    use super::*;
    use crate::domain::limits::robot_limiter::{RobotLimiter, RobotLimits};

    const PATIENCE: Duration = Duration::from_secs(10);

    struct NoClients;

    impl Gatekeeper for NoClients {
        fn admit(&self, _: super::super::Login) -> BoxFuture<'_, Result<Principal, Refusal>> {
            Box::pin(async { Err(Refusal::BadCredentials) })
        }
    }

    impl Inbox for NoClients {
        fn receive(&self, _: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>> {
            Box::pin(async { Err(NotStored) })
        }
        fn connected(&self, _: &RobotId, _: Option<SocketAddr>, _: u64, _: Option<u64>) {}
        fn disconnected(&self, _: &RobotId, _: u64) {}
        fn external_broker_connected(&self) {}
    }

    async fn watched(
        change: impl FnOnce(&mut BrokerConfig),
    ) -> (Arc<Front>, Arc<Router>, watch::Receiver<Health>) {
        let limits = Limits { canary_interval: Duration::from_millis(20), ..Limits::default() };
        let listen = "127.0.0.1:0".parse().expect("an address");
        let robot_limiter = RobotLimiter::new(RobotLimits::default());
        let mut config = BrokerConfig {
            listen,
            tls: None,
            proxy_protocol: ProxyProtocol::new(&[]),
            prefix: TopicPrefix::default(),
            limits,
            robot_limiter,
        };
        change(&mut config);
        let limits = config.limits.clone();
        let router = Router::start(&config.prefix, 4).await.expect("a router");
        let front = Front::start(config, Arc::new(NoClients), Arc::new(NoClients), router.clone())
            .await
            .expect("a free port");
        let health = start(&front, router.clone(), &limits);
        (front, router, health)
    }

    async fn until(health: &mut watch::Receiver<Health>, expected: impl FnMut(&Health) -> bool) {
        timeout(PATIENCE, health.wait_for(expected))
            .await
            .expect("in time")
            .expect("the watchdog lives");
    }

    #[tokio::test]
    async fn killed_router_is_restarted() {
        let (front, router, mut health) = watched(|_| {}).await;
        for _ in 0..3 {
            let mut subscriber =
                router.subscribe(super::super::router::Topics::Everything).await.expect("a link");
            router.kill();
            until(&mut health, |health| matches!(health, Health::Recovering(_))).await;
            until(&mut health, |health| *health == Health::Serving).await;
            assert!(
                timeout(PATIENCE, subscriber.next()).await.expect("in time").is_err(),
                "old subscribers learn of it"
            );
        }
        front.shutdown(PATIENCE).await;
    }

    #[tokio::test]
    async fn watchdog_at_the_address_of_a_proxy_is_admitted() {
        let proxies = ProxyProtocol::new(&[Ipv4Addr::LOCALHOST.into()]);
        let (front, router, mut health) = watched(|config| config.proxy_protocol = proxies).await;
        router.kill();
        until(&mut health, |health| matches!(health, Health::Recovering(_))).await;
        until(&mut health, |health| *health == Health::Serving).await;
        front.shutdown(PATIENCE).await;
    }

    #[tokio::test]
    async fn publishing_to_a_dead_router_wakes_the_watchdog() {
        let (_front, router, mut health) =
            watched(|config| config.limits.canary_interval = Duration::from_secs(3600)).await;
        router.kill();
        let noticed = async {
            while !health.has_changed().expect("the watchdog lives") {
                router.publish(CANARY_TOPIC, QoS::AtMostOnce, "x".into());
                tokio::task::yield_now().await;
            }
        };
        timeout(PATIENCE, noticed).await.expect("in time");
        until(&mut health, |health| matches!(health, Health::Recovering(_))).await;
        router.subscribe(super::super::router::Topics::Everything).await.expect("it was restarted");
    }

    #[tokio::test]
    async fn full_listener_does_not_restart_the_router() {
        let (front, _router, mut health) =
            watched(|config| config.limits.max_connections = 1).await;
        let other = TcpStream::connect(front.local_addr()).await.expect("a connection");
        until(&mut health, |health| matches!(health, Health::Recovering(reason) if reason.contains("did not admit the watchdog")))
            .await;
        drop(other);
        until(&mut health, |health| *health == Health::Serving).await;
    }

    #[test]
    fn only_a_refused_connection_counts_as_a_dead_listener() {
        let error = |errno| {
            let source = io::Error::from_raw_os_error(errno);
            ProbeError::from_dial(DialError::Connect {
                host: "127.0.0.1".to_owned(),
                port: 1883,
                source,
            })
        };
        assert!(matches!(error(libc::ECONNREFUSED), ProbeError::Listener(_)));
        for errno in [libc::EMFILE, libc::ENFILE, libc::EADDRNOTAVAIL, libc::ENOBUFS] {
            assert!(!error(errno).is_failure(), "{errno}");
        }
    }

    #[tokio::test]
    async fn dead_listener_ends_in_failed_health() {
        let (front, _router, _) = watched(|_| {}).await;
        let dead = {
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
            listener.local_addr().expect("an address")
        };
        let (sender, mut health) = watch::channel(Health::Serving);
        let limits = Limits { canary_interval: Duration::from_millis(1), ..Limits::default() };
        let router = Router::start(&TopicPrefix::default(), 1).await.expect("a router");
        let route =
            Route { host: dead.ip().to_string(), port: dead.port(), tls: None, websocket: None };
        let watchdog = Watchdog {
            route,
            proxy_protocol: front.proxy_protocol().clone(),
            pass: front.canary_pass(),
            router,
            limits,
            health: sender,
            probes: 0,
        };
        watchdog.run().await;
        until(&mut health, |health| matches!(health, Health::Failed(_))).await;
    }
}
