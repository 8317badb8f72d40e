//! Robots' messages over MQTT: reports go to the writer, replies to their requesters, log lines and
//! vitals to memory, connections to presence. The broker has authenticated the sender; the content
//! is checked here. This module never answers by itself: a robot with an outdated state is put on
//! the list of robots to notify.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use serde::de::DeserializeOwned;
use task_proto::RobotId;
use task_proto::messages::report::{MAX_REPORT_BYTES, Report, Status};
use task_proto::messages::request::{MAX_REPLY_BYTES, Reply};
use task_proto::messages::topic::RobotTopic;
use task_proto::telemetry::log::{LogBatch, MAX_BATCH_BYTES};
use task_proto::telemetry::vitals::{MAX_TELEMETRY_BYTES, Telemetry};

use crate::broker::{Inbox, NotStored, RobotMessage};
use crate::domain::fleet_event::FleetEvent;
use crate::fleet::presence::{AgentIdentity, Presence};
use crate::fleet::requests::Requests;
use crate::fleet::robot_logs::RobotLogs;
use crate::fleet::robot_vitals::RobotVitals;
use crate::orders::changes::{Change, Changes};
use crate::orders::report_writer::{ReportError, ReportWriter};
use crate::system::clock::Clock;

/// Maximum size of a status.
const MAX_STATUS_BYTES: usize = 4 * 1024;
/// Minimum interval between notifications of a robot with an outdated state. Without it a robot
/// that refuses its state would be notified for each report.
const RENOTIFY_INTERVAL_MS: u64 = 5_000;

/// Receives the broker's messages.
pub struct Uplink {
    reports: ReportWriter,
    requests: Requests,
    logs: RobotLogs,
    vitals: RobotVitals,
    presence: Arc<Presence>,
    changes: Changes,
    clock: Clock,
    /// When connected robots were last notified about an outdated state; an entry ends with the
    /// connection.
    notified_ms: Mutex<HashMap<RobotId, u64>>,
}

impl Uplink {
    /// An uplink that feeds these parts.
    pub fn new(
        reports: ReportWriter,
        requests: Requests,
        logs: RobotLogs,
        vitals: RobotVitals,
        presence: Arc<Presence>,
        changes: Changes,
        clock: Clock,
    ) -> Self {
        Self {
            reports,
            requests,
            logs,
            vitals,
            presence,
            changes,
            clock,
            notified_ms: Mutex::default(),
        }
    }

    async fn take_report(&self, message: &RobotMessage) -> Result<(), NotStored> {
        let Some(report) = parsed::<Report>(message, MAX_REPORT_BYTES) else { return Ok(()) };
        if report.robot_id != message.robot {
            tracing::warn!(robot = %message.robot, claimed = %report.robot_id, "a report with another robot's id is dropped");
            return Ok(());
        }
        let Some(token_number) = message.token_number else {
            tracing::warn!(robot = %message.robot, "a report from a session without a token is dropped");
            return Ok(());
        };
        if !self.record_session_agent(
            message,
            AgentIdentity { instance: report.instance.clone(), place: report.place },
        ) {
            // This agent waits for the serving agent, and its reports are not the robot's.
            return Err(NotStored);
        }
        let observed = report.observed_generation;
        // While the database is away the robot's sessions stay, for as long as the broker permits
        // this call to take.
        self.reports.database_there().await;
        match self.reports.submit(report, token_number).await {
            Ok(reply) => {
                if reply.generation > observed {
                    self.notify_again(&message.robot);
                }
                Ok(())
            }
            // The robot was removed a moment ago; sending again would not help.
            Err(ReportError::RobotNotFound(_)) => Ok(()),
            // The database's state was logged when it changed.
            Err(ReportError::NotStored(Some(_))) => Err(NotStored),
            Err(error) => {
                tracing::warn!(robot = %message.robot, %error, "a report was not stored; the robot sends it again");
                Err(NotStored)
            }
        }
    }

    fn take_status(&self, message: &RobotMessage) {
        let Some(status) = parsed::<Status>(message, MAX_STATUS_BYTES) else { return };
        // A robot goes offline by the end of its connection, which can't be forged or late.
        if status.online {
            self.record_session_agent(
                message,
                AgentIdentity { instance: status.instance, place: status.place },
            );
        }
    }

    fn take_log(&self, message: &RobotMessage) {
        let now_ms = self.clock.now_ms();
        if !self.logs.admits(&message.robot, message.payload.len(), now_ms) {
            tracing::debug!(robot = %message.robot, "the robot exceeds its limit of log lines; lines are dropped");
            return;
        }
        match parsed::<LogBatch>(message, MAX_BATCH_BYTES) {
            Some(batch) if batch.robot_id == message.robot => self.logs.record(batch, now_ms),
            Some(batch) => {
                tracing::warn!(robot = %message.robot, claimed = %batch.robot_id, "log lines with another robot's id are dropped");
            }
            None => {}
        }
    }

    fn take_telemetry(&self, message: &RobotMessage) {
        match parsed::<Telemetry>(message, MAX_TELEMETRY_BYTES) {
            Some(said) if said.robot_id == message.robot => {
                self.vitals.record(&message.robot, said.vitals, self.clock.now_ms());
                self.changes.announce_here(Change::Robot(said.robot_id));
            }
            Some(said) => {
                tracing::warn!(robot = %message.robot, claimed = %said.robot_id, "vitals with another robot's id are dropped");
            }
            None => {}
        }
    }

    /// Records the agent of the session. Returns whether it serves the robot's work.
    fn record_session_agent(&self, message: &RobotMessage, agent: AgentIdentity) -> bool {
        let (robot, connection) = (&message.robot, Some(message.connection));
        record_agent(
            &self.presence,
            &self.changes,
            robot,
            (message.peer, connection),
            agent,
            self.clock.now_ms(),
        )
    }

    fn notify_again(&self, robot: &RobotId) {
        let now_ms = self.clock.now_ms();
        let mut notified_ms = self.notified_ms.lock().unwrap_or_else(PoisonError::into_inner);
        if notified_ms
            .get(robot)
            .is_some_and(|at_ms| now_ms.saturating_sub(*at_ms) < RENOTIFY_INTERVAL_MS)
        {
            return;
        }
        notified_ms.insert(robot.clone(), now_ms);
        self.changes.notify_robots_here([robot.clone()]);
    }
}

impl Inbox for Uplink {
    fn receive(&self, message: RobotMessage) -> BoxFuture<'_, Result<(), NotStored>> {
        async move {
            match message.topic {
                RobotTopic::Report => return self.take_report(&message).await,
                RobotTopic::Status => self.take_status(&message),
                RobotTopic::Reply => {
                    if let Some(reply) = parsed::<Reply>(&message, MAX_REPLY_BYTES) {
                        self.requests.handle_reply(&message.robot, reply);
                    }
                }
                RobotTopic::Log => self.take_log(&message),
                RobotTopic::Telemetry => self.take_telemetry(&message),
                RobotTopic::Desired | RobotTopic::Request => {}
            }
            Ok(())
        }
        .boxed()
    }

    fn connected(
        &self,
        robot: &RobotId,
        peer: Option<SocketAddr>,
        connection: u64,
        token_number: Option<u64>,
    ) {
        let now_ms = self.clock.now_ms();
        let was_online = self.presence.is_online(robot, now_ms);
        self.presence.admitted_by(robot, token_number.unwrap_or(0));
        self.presence.connected(robot, peer, connection, now_ms);
        self.changes.announce_here(Change::Robot(robot.clone()));
        announce_arrival(&self.presence, &self.changes, robot, was_online);
        self.changes.notify_robots_here([robot.clone()]);
        self.logs.connected(robot);
    }

    fn disconnected(&self, robot: &RobotId, connection: u64) {
        self.presence.disconnected(robot, connection, self.clock.now_ms());
        self.notified_ms.lock().unwrap_or_else(PoisonError::into_inner).remove(robot);
        self.changes.announce_here(Change::Robot(robot.clone()));
        let is_online = self.presence.is_online(robot, self.clock.now_ms());
        match self.presence.shared() {
            Some(shared) => shared.departed(robot, Instant::now()),
            None => {
                self.changes.announce_event(FleetEvent::Presence(robot.clone(), is_online));
            }
        }
    }

    fn external_broker_connected(&self) {
        self.changes.notify_all_robots();
    }
}

/// Records an agent's claim, in a session if any. Returns whether the agent serves the robot's
/// work, and tells the agent so.
pub fn record_agent(
    presence: &Presence,
    changes: &Changes,
    robot: &RobotId,
    (peer, connection): (Option<SocketAddr>, Option<u64>),
    agent: AgentIdentity,
    now_ms: u64,
) -> bool {
    let shown = || {
        presence
            .get(robot, now_ms)
            .map(|sighting| (sighting.duplicate, sighting.has_waiting_instance))
            .unwrap_or_default()
    };
    let before = shown();
    let admission = presence.identify(robot, peer, connection, agent, now_ms);
    if shown() != before {
        changes.announce(Change::Robot(robot.clone()));
    }
    if admission.needs_state {
        changes.notify_robots_here([robot.clone()]);
    }
    admission.is_serving
}

/// Records a robot's HTTP request; if the robot was offline, that is news.
pub fn record_http_request(
    presence: &Presence,
    changes: &Changes,
    robot: &RobotId,
    peer: SocketAddr,
    now_ms: u64,
) {
    let was_online = presence.is_online(robot, now_ms);
    presence.seen(robot, peer, now_ms);
    if !was_online {
        changes.announce_here(Change::Robot(robot.clone()));
        announce_arrival(presence, changes, robot, was_online);
    }
}

/// Announces a robot that was offline. In a cluster, one that was at a server a moment ago, this or
/// another, has not been away.
fn announce_arrival(presence: &Presence, changes: &Changes, robot: &RobotId, was_online: bool) {
    let has_returned =
        presence.shared().is_some_and(|shared| shared.returned(robot, Instant::now()));
    if !was_online && !has_returned {
        changes.announce_event(FleetEvent::Presence(robot.clone(), true));
    }
}

fn parsed<T: DeserializeOwned>(message: &RobotMessage, most_bytes: usize) -> Option<T> {
    let (robot, topic) = (&message.robot, message.topic.as_str());
    if message.payload.len() > most_bytes {
        tracing::warn!(%robot, topic, bytes = message.payload.len(), "a message is too large and is dropped");
        return None;
    }
    match serde_json::from_slice(&message.payload) {
        Ok(value) => Some(value),
        Err(error) => {
            tracing::warn!(%robot, topic, %error, "a message can't be read and is dropped");
            None
        }
    }
}
