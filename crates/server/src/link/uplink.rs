//! Robots' messages over MQTT: reports go to the writer, replies to their requesters, log lines and
//! vitals to memory, connections to presence. The broker has authenticated the sender; the content
//! is checked here. This module never answers by itself: a robot with an outdated state is put on
//! the list of robots to ring.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use serde::de::DeserializeOwned;
use task_proto::RobotId;
use task_proto::log::{LogBatch, MAX_BATCH_BYTES};
use task_proto::report::{MAX_REPORT_BYTES, Report, Status};
use task_proto::request::{MAX_REPLY_BYTES, Reply};
use task_proto::topic::RobotTopic;
use task_proto::vitals::{MAX_TELEMETRY_BYTES, Telemetry};

use crate::broker::{Inbox, NotStored, RobotMessage};
use crate::domain::happening::Happening;
use crate::fleet::presence::{Claim, Presence};
use crate::fleet::requests::Requests;
use crate::fleet::robot_logs::RobotLogs;
use crate::fleet::robot_vitals::RobotVitals;
use crate::orders::changes::{Change, Changes};
use crate::orders::report_writer::{ReportError, ReportWriter};
use crate::system::clock::Clock;

/// Maximum size of a status.
const MAX_STATUS_BYTES: usize = 4 * 1024;
/// Minimum interval between rings of a robot with an outdated state. Without it a robot that
/// refuses its state would be rung for each report.
const RING_AGAIN_MS: u64 = 5_000;

/// Receives the broker's messages.
pub struct Uplink {
    reports: ReportWriter,
    requests: Requests,
    logs: RobotLogs,
    vitals: RobotVitals,
    presence: Arc<Presence>,
    changes: Changes,
    clock: Clock,
    /// When connected robots were last rung for an outdated state; an entry ends with the
    /// connection.
    reminded_ms: Mutex<HashMap<RobotId, u64>>,
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
            reminded_ms: Mutex::default(),
        }
    }

    async fn take_report(&self, message: &RobotMessage) -> Result<(), NotStored> {
        let Some(report) = parsed::<Report>(message, MAX_REPORT_BYTES) else { return Ok(()) };
        if report.robot_id != message.robot {
            tracing::warn!(robot = %message.robot, claimed = %report.robot_id, "a report in another robot's name is dropped");
            return Ok(());
        }
        let Some(token_number) = message.token_number else {
            tracing::warn!(robot = %message.robot, "a report that no token vouches for is dropped");
            return Ok(());
        };
        if !self
            .hear_claim(message, Claim { instance: report.instance.clone(), place: report.place })
        {
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
                    self.remind(&message.robot);
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
            self.hear_claim(message, Claim { instance: status.instance, place: status.place });
        }
    }

    fn take_lines(&self, message: &RobotMessage) {
        let now_ms = self.clock.now_ms();
        if !self.logs.admits(&message.robot, message.payload.len(), now_ms) {
            tracing::debug!(robot = %message.robot, "it publishes more lines than a robot may; they are dropped");
            return;
        }
        match parsed::<LogBatch>(message, MAX_BATCH_BYTES) {
            Some(batch) if batch.robot_id == message.robot => self.logs.take(batch, now_ms),
            Some(batch) => {
                tracing::warn!(robot = %message.robot, claimed = %batch.robot_id, "lines in another robot's name are dropped");
            }
            None => {}
        }
    }

    fn take_telemetry(&self, message: &RobotMessage) {
        match parsed::<Telemetry>(message, MAX_TELEMETRY_BYTES) {
            Some(said) if said.robot_id == message.robot => {
                self.vitals.take(&message.robot, said.vitals, self.clock.now_ms());
                self.changes.announce(Change::Robot(said.robot_id));
            }
            Some(said) => {
                tracing::warn!(robot = %message.robot, claimed = %said.robot_id, "vitals in another robot's name are dropped");
            }
            None => {}
        }
    }

    /// Records the agent of the session. Returns whether it serves the robot's work.
    fn hear_claim(&self, message: &RobotMessage, claim: Claim) -> bool {
        let (robot, connection) = (&message.robot, Some(message.connection));
        claimed(
            &self.presence,
            &self.changes,
            robot,
            (message.peer, connection),
            claim,
            self.clock.now_ms(),
        )
    }

    fn remind(&self, robot: &RobotId) {
        let now_ms = self.clock.now_ms();
        let mut reminded_ms = self.reminded_ms.lock().unwrap_or_else(PoisonError::into_inner);
        if reminded_ms.get(robot).is_some_and(|at_ms| now_ms.saturating_sub(*at_ms) < RING_AGAIN_MS)
        {
            return;
        }
        reminded_ms.insert(robot.clone(), now_ms);
        self.changes.ring([robot.clone()]);
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
                        self.requests.replied(&message.robot, reply);
                    }
                }
                RobotTopic::Log => self.take_lines(&message),
                RobotTopic::Telemetry => self.take_telemetry(&message),
                RobotTopic::Desired | RobotTopic::Request => {}
            }
            Ok(())
        }
        .boxed()
    }

    fn connected(&self, robot: &RobotId, peer: Option<SocketAddr>, connection: u64) {
        let was_online = self.presence.is_online(robot, self.clock.now_ms());
        self.presence.connected(robot, peer, connection, self.clock.now_ms());
        self.changes.announce(Change::Robot(robot.clone()));
        if !was_online {
            self.changes.happened(Happening::Presence(robot.clone(), true));
        }
        self.changes.ring([robot.clone()]);
        self.logs.connected(robot);
    }

    fn disconnected(&self, robot: &RobotId, connection: u64) {
        self.presence.disconnected(robot, connection, self.clock.now_ms());
        self.reminded_ms.lock().unwrap_or_else(PoisonError::into_inner).remove(robot);
        self.changes.announce(Change::Robot(robot.clone()));
        self.changes.happened(Happening::Presence(
            robot.clone(),
            self.presence.is_online(robot, self.clock.now_ms()),
        ));
    }

    fn everyone_may_be_there(&self) {
        self.changes.ring_everyone();
    }
}

/// Records an agent's claim, in a session if any. Returns whether the agent serves the robot's
/// work, and tells the agent so.
pub fn claimed(
    presence: &Presence,
    changes: &Changes,
    robot: &RobotId,
    (peer, connection): (Option<SocketAddr>, Option<u64>),
    claim: Claim,
    now_ms: u64,
) -> bool {
    let shown = || {
        presence
            .get(robot, now_ms)
            .map(|sighting| (sighting.duplicate, sighting.waits))
            .unwrap_or_default()
    };
    let before = shown();
    let standing = presence.claimed(robot, peer, connection, claim, now_ms);
    if shown() != before {
        changes.announce(Change::Robot(robot.clone()));
    }
    if standing.is_news {
        changes.ring([robot.clone()]);
    }
    standing.is_served
}

/// Records a robot's HTTP request; if the robot was offline, that is news.
pub fn heard(
    presence: &Presence,
    changes: &Changes,
    robot: &RobotId,
    peer: SocketAddr,
    now_ms: u64,
) {
    let was_online = presence.is_online(robot, now_ms);
    presence.seen(robot, peer, now_ms);
    if !was_online {
        changes.announce(Change::Robot(robot.clone()));
        changes.happened(Happening::Presence(robot.clone(), true));
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
