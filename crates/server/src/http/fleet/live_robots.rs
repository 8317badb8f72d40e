//! The robots as they are now: presence, connections, questions, log lines, vitals and signed
//! states, all in memory. Closes the sessions of a revoked or removed robot. Changes are announced;
//! nothing is stored.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use http::HeaderMap;
use task_proto::RobotId;
use task_proto::api::{FeedKind, MqttConnection};
use task_proto::messages::request::{Action, Answer, Ask};
use task_proto::telemetry::vitals::Vitals;
use task_proto::trust::envelope::Envelope;

use crate::broker::Broker;
use crate::domain::fleet_event::FleetEvent;
use crate::fleet::presence::{AgentIdentity, Presence};
use crate::fleet::requests::{RequestError, Requests};
use crate::fleet::robot_logs::RobotLogs;
use crate::fleet::robot_vitals::RobotVitals;
use crate::http::peers::Peers;
use crate::link::uplink;
use crate::net::http_connections::HttpConnections;
use crate::orders::changes::{Change, Changes};
use crate::orders::desired_states::DesiredStates;
use crate::system::clock::Clock;

/// The sources of the robots' present state.
#[derive(Clone)]
pub struct LiveRobots {
    pub(in crate::http) presence: Arc<Presence>,
    pub(in crate::http) broker: Broker,
    pub(in crate::http) http_connections: Arc<HttpConnections>,
    pub(in crate::http) requests: Requests,
    pub(in crate::http) logs: RobotLogs,
    pub(in crate::http) vitals: RobotVitals,
    /// The source of signed states, which caches them.
    pub(in crate::http) desired_states: DesiredStates,
    pub(in crate::http) changes: Changes,
    pub(in crate::http) peers: Peers,
    pub(in crate::http) clock: Clock,
}

impl LiveRobots {
    /// Records a robot's HTTP request: the robot is present.
    pub(super) fn record_request(&self, robot: &RobotId, peer: SocketAddr) {
        let now_ms = self.clock.now_ms();
        uplink::record_http_request(&self.presence, &self.changes, robot, peer, now_ms);
    }

    /// True if the requesting agent is the one that has the robot's work.
    pub(super) fn is_serving(
        &self,
        robot: &RobotId,
        peer: SocketAddr,
        agent: Option<AgentIdentity>,
    ) -> bool {
        let Some(agent) = agent else { return !self.presence.requires_identity(robot) };
        let (session, now_ms) = ((Some(peer), None), self.clock.now_ms());
        uplink::record_agent(&self.presence, &self.changes, robot, session, agent, now_ms)
    }

    /// True if two agents use the robot's identity.
    pub(super) fn is_duplicate(&self, robot: &RobotId) -> bool {
        self.presence.is_duplicate(robot, self.clock.now_ms())
    }

    /// The robot's MQTT session, if the robot has one.
    pub(super) fn mqtt_connection(&self, robot: &RobotId) -> Option<MqttConnection> {
        let presence = self.presence.get(robot, self.clock.now_ms())?;
        let since_ms = presence.connected_since_ms.filter(|_| presence.connection.is_some())?;
        let traffic = self.broker.traffic_of(robot)?;
        Some(MqttConnection { since_ms, traffic })
    }

    /// True if another server of the cluster has the robot's session.
    pub(super) async fn is_elsewhere(&self, robot: &RobotId) -> bool {
        self.broker.traffic_of(robot).is_none()
            && matches!(self.peers.with_session(robot, &HeaderMap::new()).await, Ok(Some(_)))
    }

    /// Sends a question to the robot, and waits for the answer.
    pub(super) async fn ask(
        &self,
        robot: &RobotId,
        ask: Ask,
        timeout: Duration,
    ) -> Result<Answer, RequestError> {
        self.requests.send(&self.broker, robot, ask, timeout).await
    }

    /// Sends a signed action to its robot, and waits for the answer.
    pub(super) async fn ask_signed(
        &self,
        action: Action,
        signed: Envelope,
        timeout: Duration,
    ) -> Result<Answer, RequestError> {
        self.requests.send_signed(&self.broker, action, signed, timeout).await
    }

    /// Records the vitals of the robot's machine. A robot's clock and figures are untrusted: the
    /// result is what was recorded.
    pub(super) fn record_vitals(&self, robot: RobotId, reported: Vitals) -> Vitals {
        let recorded = self.vitals.record(&robot, reported, self.clock.now_ms());
        self.changes.announce_here(Change::Robot(robot));
        recorded
    }

    /// Adds an event about the robot to the feed.
    pub(super) fn announce_event(&self, robot: RobotId, kind: FeedKind, text: String) {
        self.changes.announce_event(FleetEvent::Robot(robot, kind, text));
    }

    /// Cleans up after a revoked robot: clients connected with its token are disconnected.
    pub(super) fn revoked(&self, robot: RobotId) {
        self.disconnect(&robot);
        // A robot that polled would otherwise count as online for a while.
        self.presence.forget(&robot);
        self.announce_event(robot.clone(), FeedKind::RobotRevoked, "was revoked".to_owned());
        self.changes.announce(Change::Robot(robot));
    }

    /// Cleans up after a removed robot: clients connected with its token are disconnected.
    pub(super) fn removed(&self, robot: &RobotId) {
        self.disconnect(robot);
        self.logs.forget(robot);
        self.vitals.forget(robot);
        self.presence.forget(robot);
        self.desired_states.forget(robot);
    }

    /// Closes a robot's MQTT session and its HTTP connections. Its tokens have ended before.
    fn disconnect(&self, robot: &RobotId) {
        self.broker.disconnect(robot);
        self.http_connections.end(robot);
        self.changes.end_robot_elsewhere(robot, None);
    }
}
