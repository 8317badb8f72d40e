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
use task_transport::{DialError, Duplex, Route, dial};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::sync::watch;
use tokio::time::timeout;

use super::front::{CANARY_ID, CanaryPass, Front};
use super::router::{CANARY_TOPIC, Router};
use super::{Health, Limits};
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
    route: Route,
    pass: Arc<CanaryPass>,
    router: Arc<Router>,
    limits: Limits,
    health: watch::Sender<Health>,
    flights: u64,
}

/// The reason why a canary did not come back, by its remedy.
#[derive(Debug, thiserror::Error)]
enum Lost {
    /// No remedy helps, if the failure lasts.
    #[error("the MQTT listener does not accept connections")]
    Listener(#[source] DialError),
    /// Time helps: the watchdog has no connection of its own, as when too many files are open. That
    /// is no evidence about the listener.
    #[error("the watchdog can't open a connection to the MQTT listener")]
    Dial(#[source] DialError),
    /// Time helps: too many connections, or overload. A new router would only increase the load.
    #[error("the MQTT front did not let the watchdog in: {0}")]
    Front(&'static str),
    /// A new router helps.
    #[error("the message router does not work: {0}")]
    Router(&'static str),
}

impl Lost {
    /// Classifies a failed attempt to connect.
    fn by(error: DialError) -> Self {
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
    fn is_grave(&self) -> bool {
        matches!(self, Self::Listener(_) | Self::Router(_))
    }
}

impl Watchdog {
    async fn run(mut self) {
        let mut failures = 0;
        loop {
            tokio::select! {
                () = tokio::time::sleep(self.limits.canary_interval) => {}
                () = self.router.trouble() => {}
            }
            let Err(lost) = self.fly().await else {
                failures = 0;
                self.say(Health::Serving);
                continue;
            };
            let seen = lost.to_string();
            if lost.is_grave() {
                failures += 1;
            }
            if failures > MAX_REMEDIES {
                tracing::error!(
                    "the MQTT broker is beyond repair: {:#}",
                    anyhow::Error::from(lost)
                );
                self.say(Health::Failed(seen));
                return;
            }
            if let Lost::Router(_) = lost {
                tracing::warn!("{lost}; it is started anew");
                if let Err(error) = self.router.restart().await {
                    tracing::error!("the message router did not start anew: {error}");
                }
            } else {
                tracing::warn!("{:#}", anyhow::Error::from(lost));
            }
            self.say(Health::Recovering(seen));
        }
    }

    fn say(&self, finding: Health) {
        self.health
            .send_if_modified(|health| std::mem::replace(health, finding.clone()) != finding);
    }

    /// Sends one canary and waits for its message.
    async fn fly(&mut self) -> Result<(), Lost> {
        self.flights += 1;
        let patience = self.limits.canary_timeout;
        let entering = timeout(patience, Bird::enter(&self.route, self.pass.renew())).await;
        let mut bird = entering.unwrap_or(Err(Lost::Front("no answer in time")))?;
        let singing = timeout(patience, bird.sing(self.flights.to_string())).await;
        singing.unwrap_or(Err(Lost::Router("the watchdog did not hear itself in time")))
    }
}

/// A minimal MQTT client for the canary.
struct Bird {
    stream: Box<dyn Duplex>,
    input: BytesMut,
}

impl Bird {
    async fn enter(route: &Route, password: String) -> Result<Self, Lost> {
        let stream = dial(route).await.map_err(Lost::by)?;
        let mut bird = Self { stream, input: BytesMut::new() };
        let connect =
            Connect { keep_alive: 30, client_id: CANARY_ID.to_owned(), clean_session: true };
        let login = Login { username: CANARY_ID.to_owned(), password };
        match bird.ask(Packet::Connect(connect, None, None, None, Some(login))).await {
            Some(Packet::ConnAck(ack, _)) => match ack.code {
                ConnectReturnCode::Success => Ok(bird),
                // The only resource that the front needs for a canary is a link to the router.
                ConnectReturnCode::ServiceUnavailable => {
                    Err(Lost::Router("it answers no new link"))
                }
                _ => Err(Lost::Front("it refused the password")),
            },
            _ => Err(Lost::Front("the connection broke")),
        }
    }

    async fn sing(&mut self, song: String) -> Result<(), Lost> {
        let filter = Filter {
            path: CANARY_TOPIC.to_owned(),
            qos: QoS::AtMostOnce,
            nolocal: false,
            preserve_retain: false,
            retain_forward_rule: RetainForwardRule::Never,
        };
        let broke = Lost::Router("the watchdog's connection broke");
        let Some(_) =
            self.ask(Packet::Subscribe(Subscribe { pkid: 1, filters: vec![filter] }, None)).await
        else {
            return Err(broke);
        };
        let publish = Publish::new(CANARY_TOPIC.to_owned(), song.clone(), false);
        match self.ask(Packet::Publish(publish, None)).await {
            Some(Packet::Publish(heard, _)) if heard.payload == song.as_bytes() => Ok(()),
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
    use task_proto::topic::TopicPrefix;
    use tokio::net::TcpStream;

    use super::super::{
        BrokerConfig, Gatekeeper, Inbox, NotStored, Principal, Refusal, RobotMessage,
    };
    use super::*;
    use crate::limits::conduct::{Conduct, ConductLimits};

    const PATIENCE: Duration = Duration::from_secs(10);

    struct Nobody;

    impl Gatekeeper for Nobody {
        fn admit(&self, _: super::super::Login) -> BoxFuture<'_, Result<Principal, Refusal>> {
            Box::pin(async { Err(Refusal::BadCredentials) })
        }
    }

    impl Inbox for Nobody {
        fn receive(&self, _: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>> {
            Box::pin(async { Err(NotStored) })
        }
        fn connected(&self, _: &RobotId, _: Option<SocketAddr>, _: u64) {}
        fn disconnected(&self, _: &RobotId, _: u64) {}
        fn everyone_may_be_there(&self) {}
    }

    async fn watched(
        change: impl FnOnce(&mut Limits),
    ) -> (Arc<Front>, Arc<Router>, watch::Receiver<Health>) {
        let mut limits = Limits { canary_interval: Duration::from_millis(20), ..Limits::default() };
        change(&mut limits);
        let listen = "127.0.0.1:0".parse().expect("an address");
        let conduct = Conduct::new(ConductLimits::default());
        let config = BrokerConfig {
            listen,
            tls: None,
            prefix: TopicPrefix::default(),
            limits: limits.clone(),
            conduct,
        };
        let router = Router::start(&config.prefix, 4).await.expect("a router");
        let front = Front::start(config, Arc::new(Nobody), Arc::new(Nobody), router.clone())
            .await
            .expect("a free port");
        let health = start(&front, router.clone(), &limits);
        (front, router, health)
    }

    async fn until(health: &mut watch::Receiver<Health>, wanted: impl FnMut(&Health) -> bool) {
        timeout(PATIENCE, health.wait_for(wanted))
            .await
            .expect("in time")
            .expect("the watchdog lives");
    }

    #[tokio::test]
    async fn a_killed_router_is_started_anew() {
        let (front, router, mut health) = watched(|_| {}).await;
        for _ in 0..3 {
            let mut listener =
                router.listen(super::super::router::Listening::Everything).await.expect("a link");
            router.kill();
            until(&mut health, |health| matches!(health, Health::Recovering(_))).await;
            until(&mut health, |health| *health == Health::Serving).await;
            assert!(
                timeout(PATIENCE, listener.next()).await.expect("in time").is_err(),
                "old listeners learn of it"
            );
        }
        front.shutdown(PATIENCE).await;
    }

    #[tokio::test]
    async fn a_dead_router_is_noticed_by_whoever_publishes() {
        let (_front, router, mut health) =
            watched(|limits| limits.canary_interval = Duration::from_secs(3600)).await;
        router.kill();
        let noticed = async {
            while !health.has_changed().expect("the watchdog lives") {
                router.publish(CANARY_TOPIC, QoS::AtMostOnce, "x".into());
                tokio::task::yield_now().await;
            }
        };
        timeout(PATIENCE, noticed).await.expect("in time");
        until(&mut health, |health| matches!(health, Health::Recovering(_))).await;
        router
            .listen(super::super::router::Listening::Everything)
            .await
            .expect("it was started anew");
    }

    #[tokio::test]
    async fn a_crowded_front_is_not_taken_for_a_dead_router() {
        let (front, _router, mut health) = watched(|limits| limits.max_connections = 1).await;
        let crowd = TcpStream::connect(front.local_addr()).await.expect("a connection");
        until(&mut health, |health| matches!(health, Health::Recovering(seen) if seen.contains("let the watchdog in")))
            .await;
        drop(crowd);
        until(&mut health, |health| *health == Health::Serving).await;
    }

    #[test]
    fn only_a_listener_that_refuses_is_gone() {
        let lost = |errno| {
            let source = io::Error::from_raw_os_error(errno);
            Lost::by(DialError::Connect { host: "127.0.0.1".to_owned(), port: 1883, source })
        };
        assert!(matches!(lost(libc::ECONNREFUSED), Lost::Listener(_)));
        for errno in [libc::EMFILE, libc::ENFILE, libc::EADDRNOTAVAIL, libc::ENOBUFS] {
            assert!(!lost(errno).is_grave(), "{errno}");
        }
    }

    #[tokio::test]
    async fn a_listener_that_is_gone_is_beyond_repair() {
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
            pass: front.canary_pass(),
            router,
            limits,
            health: sender,
            flights: 0,
        };
        watchdog.run().await;
        until(&mut health, |health| matches!(health, Health::Failed(_))).await;
    }
}
