//! The MQTT front: all code between the network and the inbox or the router. rumqttd's own
//! listeners must not face clients, so the front does the parts that they get wrong: admission,
//! access, takeover, wills, timeouts, bounds on memory. The front never retains a message, so a
//! message with the retain flag ends the session. It never keeps a session beyond its connection: a
//! request for a persistent session is ignored.

mod access;
mod attendance;
pub mod codec;
mod doorbell;
mod entrance;
mod laggard;
mod listener;
mod other_protocol;
mod outgoing;
mod output;
mod parts;
mod places;
mod session;
mod takeover;
mod traffic;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use task_proto::api::{MqttTraffic, Subscription, Traffic};
use task_proto::topic::TopicPrefix;
use task_proto::{RobotId, UserName};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::router::Router;
use super::{BrokerConfig, BrokerError, Gatekeeper, Inbox, Limits, NotAsked, NotConnected};
use crate::limits::conduct::Conduct;
use crate::net::anteroom::Anteroom;
use crate::net::backlog::listen;
use crate::net::tls::{ClientProof, Tls};
use entrance::{Arrival, Rejection};
pub(super) use entrance::{CANARY_ID, CanaryPass};
use other_protocol::OtherProtocols;
use parts::Grants;
pub(super) use parts::{Grant, NotGranted};
use places::{Claim, Places};
use takeover::Seats;
use traffic::Totals;

pub(super) struct Front {
    local_addr: SocketAddr,
    context: Arc<Context>,
    sessions: TaskTracker,
}

/// The state shared by all sessions.
struct Context {
    prefix: TopicPrefix,
    limits: Limits,
    conduct: Arc<Conduct>,
    gatekeeper: Arc<dyn Gatekeeper>,
    inbox: Arc<dyn Inbox>,
    router: Arc<Router>,
    seats: Arc<Seats>,
    totals: Totals,
    grants: Grants,
    canary_pass: Arc<CanaryPass>,
    /// Connections that have not sent CONNECT yet.
    anteroom: Arc<Anteroom>,
    /// The limit on connections.
    places: Places,
    /// The TLS configuration, if the listener encrypts.
    tls: Option<Tls>,
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
        let anteroom = Anteroom::new(limits.max_silent_per_address.min(limits.max_connections / 4));
        let context = Arc::new(Context {
            prefix: config.prefix,
            places: Places::new(config.limits.max_connections),
            seats: Seats::new(config.limits.max_sessions_per_person),
            limits: config.limits,
            tls: config.tls,
            conduct: config.conduct,
            gatekeeper,
            inbox,
            router,
            totals: Totals::default(),
            grants: Grants::default(),
            canary_pass: Arc::default(),
            anteroom,
            other_protocols: OtherProtocols::default(),
            stop: CancellationToken::new(),
        });
        let front = Arc::new(Self { local_addr, context, sessions: TaskTracker::new() });
        tokio::spawn(listener::run(front.clone(), listener));
        Ok(front)
    }

    pub(super) fn ring(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotConnected> {
        self.context.seats.doorbell(robot).ok_or(NotConnected)?.ring(payload);
        Ok(())
    }

    pub(super) fn has_session(&self, robot: &RobotId) -> bool {
        self.context.seats.doorbell(robot).is_some()
    }

    pub(super) fn ask(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotAsked> {
        let doorbell = self.context.seats.doorbell(robot).ok_or(NotAsked::NotConnected)?;
        if doorbell.ask(payload) { Ok(()) } else { Err(NotAsked::Busy) }
    }

    pub(super) fn grants(&self) -> &Grants {
        &self.context.grants
    }

    pub(super) fn disconnect(&self, robot: &RobotId) {
        self.context.seats.ask_to_leave(robot);
    }

    pub(super) fn disconnect_person(&self, user: &UserName) {
        self.context.seats.ask_person_to_leave(user);
    }

    pub(super) fn traffic(&self) -> MqttTraffic {
        MqttTraffic {
            robots_connected: self.connected_count() as u64,
            messages_dropped: self.context.router.dropped(),
            ..self.context.totals.read()
        }
    }

    pub(super) fn traffic_of(&self, robot: &RobotId) -> Option<Traffic> {
        self.context.seats.meter(robot).map(|meter| meter.read())
    }

    pub(super) fn subscriptions_of(&self, robot: &RobotId) -> Vec<Subscription> {
        self.context.seats.subscriptions(robot)
    }

    pub(super) fn connected_count(&self) -> usize {
        self.context.seats.robots()
    }

    pub(super) fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    pub(super) fn canary_pass(&self) -> Arc<CanaryPass> {
        self.context.canary_pass.clone()
    }

    /// Serves the connection that `handshake` returns, if it completes in time. False: there are
    /// too many connections.
    pub(super) fn take_in<S>(
        &self,
        peer: SocketAddr,
        handshake: impl Future<Output = io::Result<(S, ClientProof)>> + Send + 'static,
    ) -> bool
    where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let Some(claim) = self.claim() else { return false };
        self.attend(peer, claim, handshake);
        true
    }

    /// A place for one more connection, if there is one.
    fn claim(&self) -> Option<Claim> {
        let claim = self.context.places.claim(&self.context.anteroom);
        if claim.is_none() {
            self.context.totals.refuse(None);
        }
        claim
    }

    fn attend<S>(
        &self,
        peer: SocketAddr,
        claim: Claim,
        handshake: impl Future<Output = io::Result<(S, ClientProof)>> + Send + 'static,
    ) where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let context = self.context.clone();
        let mut arrival = Arrival::new(&context, peer);
        self.sessions.spawn(async move {
            let entering = async {
                let place = arrival.find_place(claim).await?;
                let (stream, proof) = arrival.shake_hands(handshake).await?;
                Ok::<_, Rejection>((place, stream, proof))
            };
            let entered = tokio::select! {
                entered = entering => entered,
                () = context.stop.cancelled() => return,
            };
            match entered {
                Ok((place, stream, proof)) => {
                    arrival.proof = proof;
                    session::serve(context, stream, arrival).await;
                    drop(place);
                }
                Err(rejection) => {
                    tracing::debug!(%peer, "MQTT client turned away: {rejection}");
                    context.totals.refuse(None);
                }
            }
        });
    }

    pub(super) fn tls(&self) -> Option<&Tls> {
        self.context.tls.as_ref()
    }

    pub(super) fn stop(&self) -> CancellationToken {
        self.context.stop.clone()
    }

    pub(super) async fn shutdown(&self, patience: Duration) {
        self.context.stop.cancel();
        self.sessions.close();
        if tokio::time::timeout(patience, self.sessions.wait()).await.is_err() {
            tracing::warn!(left = self.sessions.len(), "MQTT sessions did not end in time");
        }
    }
}
