//! The MQTT front: all code between the network and the inbox or the router. rumqttd's own
//! listeners must not face clients, so the front does the parts that they get wrong: admission,
//! access, takeover, wills, timeouts, bounds on memory. The front never retains a message, so a
//! message with the retain flag ends the session. It never keeps a session beyond its connection: a
//! request for a persistent session is ignored.

mod access;
mod admission;
pub mod codec;
mod listener;
mod parts;
mod session;
mod slots;
mod traffic;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use task_proto::api::{MqttTraffic, Subscription, Traffic};
use task_proto::messages::topic::TopicPrefix;
use task_proto::{RobotId, UserName};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::router::Router;
use super::{BrokerConfig, BrokerError, Gatekeeper, Inbox, Limits, NotConnected, NotSent};
use crate::domain::limits::robot_limiter::RobotLimiter;
use crate::net::backlog::listen;
use crate::net::proxy_protocol::ProxyProtocol;
use crate::net::tls::{ClientProof, Tls};
use crate::net::unauthenticated::UnauthenticatedConnections;
pub(super) use admission::{CANARY_ID, CanaryPass};
use admission::{ConnectionLimit, OtherProtocols, PendingConnection, PendingPermit, Rejection};
use parts::Grants;
pub(super) use parts::{Grant, NotGranted};
use slots::SessionSlots;
use traffic::Totals;

/// Interval between the ends of sessions before a stop.
const DRAIN_INTERVAL: Duration = Duration::from_millis(50);

pub(super) struct Front {
    local_addr: SocketAddr,
    context: Arc<Context>,
    sessions: TaskTracker,
}

/// The state shared by all sessions.
struct Context {
    prefix: TopicPrefix,
    limits: Limits,
    robot_limiter: Arc<RobotLimiter>,
    gatekeeper: Arc<dyn Gatekeeper>,
    inbox: Arc<dyn Inbox>,
    router: Arc<Router>,
    slots: Arc<SessionSlots>,
    totals: Totals,
    grants: Grants,
    canary_pass: Arc<CanaryPass>,
    /// Connections that have not sent CONNECT yet.
    unauthenticated: Arc<UnauthenticatedConnections>,
    /// The limit on connections.
    connection_limit: ConnectionLimit,
    /// The TLS configuration, if the listener encrypts.
    tls: Option<Tls>,
    proxy_protocol: ProxyProtocol,
    /// Clients of other MQTT versions.
    other_protocols: OtherProtocols,
    stop: CancellationToken,
}

impl Front {
    /// Binds the listener and begins to accept.
    pub(super) async fn start(
        config: BrokerConfig,
        gatekeeper: Arc<dyn Gatekeeper>,
        inbox: Arc<dyn Inbox>,
        router: Arc<Router>,
    ) -> Result<Arc<Self>, BrokerError> {
        let failed = |source| BrokerError::Listen { address: config.listen, source };
        let listener = listen(config.listen).map_err(failed)?;
        let local_addr = listener.local_addr().map_err(failed)?;
        let limits = &config.limits;
        let unauthenticated = UnauthenticatedConnections::new(
            limits.max_silent_per_address.min(limits.max_connections / 4),
        );
        let context = Arc::new(Context {
            prefix: config.prefix,
            connection_limit: ConnectionLimit::new(config.limits.max_connections),
            slots: SessionSlots::new(config.limits.max_sessions_per_person),
            limits: config.limits,
            tls: config.tls,
            proxy_protocol: config.proxy_protocol,
            robot_limiter: config.robot_limiter,
            gatekeeper,
            inbox,
            router,
            totals: Totals::default(),
            grants: Grants::default(),
            canary_pass: Arc::default(),
            unauthenticated,
            other_protocols: OtherProtocols::default(),
            stop: CancellationToken::new(),
        });
        let front = Arc::new(Self { local_addr, context, sessions: TaskTracker::new() });
        tokio::spawn(listener::run(front.clone(), listener));
        Ok(front)
    }

    pub(super) fn send_desired(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotConnected> {
        self.context.slots.mailbox(robot).ok_or(NotConnected)?.set_desired(payload);
        Ok(())
    }

    pub(super) fn has_session(&self, robot: &RobotId) -> bool {
        self.context.slots.mailbox(robot).is_some()
    }

    pub(super) fn send_request(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotSent> {
        let mailbox = self.context.slots.mailbox(robot).ok_or(NotSent::NotConnected)?;
        if mailbox.add_request(payload) { Ok(()) } else { Err(NotSent::Busy) }
    }

    pub(super) fn grants(&self) -> &Grants {
        &self.context.grants
    }

    pub(super) fn disconnect(&self, robot: &RobotId) {
        self.context.slots.evict(robot);
    }

    pub(super) fn disconnect_other_tokens(&self, robot: &RobotId, kept: u64) {
        self.context.slots.evict_other_tokens(robot, kept);
    }

    pub(super) fn disconnect_session(&self, robot: &RobotId, connection: u64) {
        self.context.slots.evict_session(robot, connection);
    }

    pub(super) fn disconnect_people(&self) {
        self.context.slots.evict_people();
    }

    pub(super) fn disconnect_person(&self, user: &UserName) {
        self.context.slots.evict_person(user);
    }

    pub(super) fn traffic(&self) -> MqttTraffic {
        MqttTraffic {
            robots_connected: self.connected_count() as u64,
            messages_dropped: self.context.router.dropped(),
            ..self.context.totals.read()
        }
    }

    pub(super) fn traffic_of(&self, robot: &RobotId) -> Option<Traffic> {
        self.context.slots.meter(robot).map(|meter| meter.read())
    }

    pub(super) fn subscriptions_of(&self, robot: &RobotId) -> Vec<Subscription> {
        self.context.slots.subscriptions(robot)
    }

    pub(super) fn connected_count(&self) -> usize {
        self.context.slots.robot_count()
    }

    pub(super) fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    pub(super) fn canary_pass(&self) -> Arc<CanaryPass> {
        self.context.canary_pass.clone()
    }

    /// Serves the connection that `handshake` returns, if it completes in time. False: there are
    /// too many connections.
    pub(super) fn serve_connection<S>(
        &self,
        peer: SocketAddr,
        handshake: impl Future<Output = io::Result<(S, ClientProof)>> + Send + 'static,
    ) -> bool
    where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let Some(permit) = self.acquire() else { return false };
        self.spawn_session(peer, permit, handshake);
        true
    }

    /// A permit for one more connection, if there is one.
    fn acquire(&self) -> Option<PendingPermit> {
        let permit = self.context.connection_limit.acquire(&self.context.unauthenticated);
        if permit.is_none() {
            self.context.totals.refuse(None);
        }
        permit
    }

    fn spawn_session<S>(
        &self,
        peer: SocketAddr,
        permit: PendingPermit,
        handshake: impl Future<Output = io::Result<(S, ClientProof)>> + Send + 'static,
    ) where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let context = self.context.clone();
        let mut pending = PendingConnection::new(&context, peer);
        self.sessions.spawn(async move {
            let opening = async {
                let permit = pending.acquire_permit(permit).await?;
                let (stream, proof) = pending.handshake(handshake).await?;
                Ok::<_, Rejection>((permit, stream, proof))
            };
            let opened = tokio::select! {
                opened = opening => opened,
                () = context.stop.cancelled() => return,
            };
            match opened {
                Ok((permit, stream, proof)) => {
                    pending.proof = proof;
                    session::serve(context, stream, pending).await;
                    drop(permit);
                }
                Err(rejection) => {
                    tracing::debug!(%peer, "MQTT client rejected: {rejection}");
                    context.totals.refuse(None);
                }
            }
        });
    }

    pub(super) fn tls(&self) -> Option<&Tls> {
        self.context.tls.as_ref()
    }

    pub(super) fn proxy_protocol(&self) -> &ProxyProtocol {
        &self.context.proxy_protocol
    }

    pub(super) fn stop(&self) -> CancellationToken {
        self.context.stop.clone()
    }

    /// Ends the sessions of the robots that are connected now, evenly over `time`.
    pub(super) async fn drain(&self, time: Duration) {
        let robots = self.context.slots.robots();
        let steps = (time.as_millis() / DRAIN_INTERVAL.as_millis()).max(1) as usize;
        let mut ticks = tokio::time::interval(DRAIN_INTERVAL);
        for some in robots.chunks(robots.len().div_ceil(steps).max(1)) {
            ticks.tick().await;
            some.iter().for_each(|robot| self.context.slots.evict(robot));
        }
    }

    pub(super) async fn shutdown(&self, patience: Duration) {
        self.context.stop.cancel();
        self.sessions.close();
        if tokio::time::timeout(patience, self.sessions.wait()).await.is_err() {
            tracing::warn!(left = self.sessions.len(), "MQTT sessions did not end in time");
        }
    }
}
