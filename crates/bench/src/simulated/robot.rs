//! One simulated robot: an MQTT session in its own task, and the steps that a run requests. The
//! robot verifies orders with the pinned key and reports on them; nothing is fetched or run.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rumqttc::{
    AsyncClient, Event, EventLoop, Incoming, LastWill, MqttOptions, NetworkOptions, Outgoing, QoS,
    SubscribeReasonCode,
};
use task_agent::telemetry::vitals::Source as _;
use task_proto::api::EnrollResponse;
use task_proto::desired::{DesiredNotice, DesiredState, DesiredTask, MAX_DESIRED_NOTICE_BYTES};
use task_proto::messages::report::{ActiveVersion, HostFacts, Phase, Report, Status, TaskReport};
use task_proto::messages::topic::{RobotTopic, Topic};
use task_proto::telemetry::vitals::Telemetry;
use task_proto::time::millis;
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, PublicKey};
use task_proto::{DeploymentId, Generation, InstanceId};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::simulated::vitals::{Machine, VITALS_INTERVAL};

/// Time limit for any single answer of the server.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);
const KEEP_ALIVE: Duration = Duration::from_secs(20);
/// Requests between a robot and its session: a subscription, a status and a report.
const QUEUED_REQUESTS: usize = 8;

/// Why a robot's step failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RobotError {
    /// The session ended, according to the broker or the MQTT client.
    #[error("the MQTT session ended: {0}")]
    Ended(String),
    /// An earlier step failed.
    #[error("no MQTT session since an earlier failure")]
    NoSession,
    /// The server did not answer.
    #[error("no {0} within {ANSWER_TIMEOUT:?}")]
    Late(&'static str),
}

/// The server's address, the robot's credentials, and the key that signs its orders.
pub struct Identity {
    /// The server's answer to the enrollment.
    pub enrolled: EnrollResponse,
    /// The MQTT broker's host.
    pub host: String,
    pub port: u16,
    /// The key pinned by the enrollment token.
    pub key: PublicKey,
}

/// A robot of the fleet.
pub struct Robot {
    identity: Arc<Identity>,
    instance: InstanceId,
    began: Instant,
    connection: u64,
    seq: u64,
    order: Option<(Generation, DesiredTask)>,
    session: Option<Session>,
}

/// Messages received in a session, with their times.
#[derive(Default)]
struct Received {
    subscribed: Option<Instant>,
    reports: u64,
    last_report: Option<Instant>,
    desired: Option<(DesiredState, Instant)>,
    ended: Option<String>,
}

/// An MQTT session. Dropping the session closes the connection without DISCONNECT, as a power cut
/// does.
struct Session {
    client: AsyncClient,
    received: watch::Receiver<Received>,
    listener: JoinHandle<()>,
    vitals_task: JoinHandle<()>,
    published: u64,
}

impl Drop for Session {
    fn drop(&mut self) {
        self.listener.abort();
        self.vitals_task.abort();
    }
}

impl Robot {
    /// A robot without a connection.
    pub fn new(identity: Identity) -> Self {
        let instance = InstanceId::random();
        let began = Instant::now();
        Self {
            identity: Arc::new(identity),
            instance,
            began,
            connection: 0,
            seq: 0,
            order: None,
            session: None,
        }
    }

    /// Connects and subscribes; returns the time from now to SUBACK. The status is published
    /// afterwards.
    pub async fn connect(&mut self) -> Result<Duration, RobotError> {
        self.connection += 1;
        let begun = Instant::now();
        let (client, mut event_loop) =
            AsyncClient::new(self.identity.options(self.status(false)), QUEUED_REQUESTS);
        let mut network = NetworkOptions::new();
        network.set_connection_timeout(ANSWER_TIMEOUT.as_secs());
        network.set_tcp_nodelay(true);
        event_loop.set_network_options(network);
        let (sender, received) = watch::channel(Received::default());
        let listener =
            listen(event_loop, client.clone(), self.identity.clone(), self.status(true), sender);
        let vitals_task = tokio::spawn(publish_vitals(client.clone(), self.identity.clone()));
        self.session = Some(Session {
            client,
            received,
            listener: tokio::spawn(listener),
            vitals_task,
            published: 0,
        });
        Ok(self.wait_for("SUBACK", |received| received.subscribed).await? - begun)
    }

    pub fn disconnect(&mut self) {
        self.session = None;
    }

    /// Waits for the signed order of `deployment`; returns the time of its arrival.
    pub async fn receive(&mut self, deployment: &DeploymentId) -> Result<Instant, RobotError> {
        let find = |received: &Received| {
            let (state, at) = received.desired.as_ref()?;
            let task = state.tasks.iter().find(|task| task.deployment == *deployment)?;
            Some((state.generation, task.clone(), *at))
        };
        let (generation, task, at) = self.wait_for("order", find).await?;
        self.order = Some((generation, task));
        Ok(at)
    }

    /// Reports that the ordered deployment, if any, is in `phase`; returns the time from now to
    /// PUBACK.
    pub async fn report(&mut self, phase: Phase) -> Result<Duration, RobotError> {
        self.seq += 1;
        let begun = Instant::now();
        let payload = json_bytes(&self.snapshot(phase));
        let topic = self.identity.topic(RobotTopic::Report);
        let session = self.session.as_mut().ok_or(RobotError::NoSession)?;
        session.published += 1;
        let published = session.published;
        // The queue has room, as only one report is in flight at a time; the event loop below
        // reports an ended session.
        let _ = session.client.try_publish(topic, QoS::AtLeastOnce, false, payload);
        let stored =
            |received: &Received| received.last_report.filter(|_| received.reports >= published);
        Ok(self.wait_for("PUBACK of a report", stored).await? - begun)
    }

    /// Waits until `find` finds. After a failure the session is over: a late answer must not count
    /// for the next step.
    async fn wait_for<T>(
        &mut self,
        what: &'static str,
        find: impl Fn(&Received) -> Option<T>,
    ) -> Result<T, RobotError> {
        let session = self.session.as_mut().ok_or(RobotError::NoSession)?;
        let change = session
            .received
            .wait_for(|received| received.ended.is_some() || find(received).is_some());
        let outcome = match tokio::time::timeout(ANSWER_TIMEOUT, change).await {
            Ok(Ok(received)) => find(&received)
                .ok_or_else(|| RobotError::Ended(received.ended.clone().unwrap_or_default())),
            Ok(Err(_)) => Err(RobotError::NoSession),
            Err(_) => Err(RobotError::Late(what)),
        };
        if outcome.is_err() {
            self.disconnect();
        }
        outcome
    }

    fn status(&self, online: bool) -> Vec<u8> {
        json_bytes(&Status {
            online,
            start: 1,
            instance: self.instance.clone(),
            connection: self.connection,
            place: None,
        })
    }

    fn snapshot(&self, phase: Phase) -> Report {
        let task = |task: &DesiredTask| TaskReport {
            active: (phase == Phase::Running).then(|| ActiveVersion {
                deployment: task.deployment.clone(),
                version: task.package.version.clone(),
                manifest: Some(task.package.manifest.digest),
                pid: 1,
            }),
            ..TaskReport::of(task, phase)
        };
        Report {
            robot_id: self.identity.enrolled.robot_id.clone(),
            start: 1,
            instance: self.instance.clone(),
            place: None,
            boot_id: "00000000-0000-0000-0000-000000000000".to_owned(),
            seq: self.seq,
            observed_generation: self
                .order
                .as_ref()
                .map_or(Generation(0), |(generation, _)| *generation),
            uptime_ms: millis(self.began.elapsed()),
            host: HostFacts {
                agent_version: concat!("taskbench ", env!("CARGO_PKG_VERSION")).to_owned(),
                hostname: self.identity.enrolled.name.to_string(),
                arch: std::env::consts::ARCH.to_owned(),
                ..HostFacts::default()
            },
            conditions: Vec::new(),
            link: None,
            tasks: self.order.iter().map(|(_, ordered)| task(ordered)).collect(),
        }
    }
}

impl Identity {
    fn topic(&self, topic: RobotTopic) -> String {
        self.enrolled.mqtt.prefix.format(&Topic::Robot(self.enrolled.robot_id.clone(), topic))
    }

    fn options(&self, will: Vec<u8>) -> MqttOptions {
        let mut options = MqttOptions::new(self.enrolled.robot_id.as_str(), &self.host, self.port);
        options.set_credentials(self.enrolled.robot_id.as_str(), &self.enrolled.token);
        options.set_keep_alive(KEEP_ALIVE);
        options.set_max_packet_size(MAX_DESIRED_NOTICE_BYTES + 4096, MAX_DESIRED_NOTICE_BYTES);
        options.set_last_will(LastWill::new(
            self.topic(RobotTopic::Status),
            will,
            QoS::AtLeastOnce,
            false,
        ));
        options
    }

    /// The state in a message on the `desired` topic, verified.
    fn open(&self, payload: &[u8]) -> Result<DesiredState, String> {
        let notice = serde_json::from_slice(payload)
            .map_err(|error| format!("not a desired state: {error}"))?;
        let DesiredNotice::State { envelope, .. } = notice else {
            return Err("a desired state was too large for a message".to_owned());
        };
        let payload =
            envelope.open(DESIRED_STATE_TYPE, &self.key).map_err(|error| error.to_string())?;
        let state: DesiredState =
            serde_json::from_slice(&payload).map_err(|error| error.to_string())?;
        let is_ours = state.robot_id == self.enrolled.robot_id;
        if is_ours { Ok(state) } else { Err("a desired state for another robot".to_owned()) }
    }
}

/// Drives a session to its end. Its poll is never dropped half way, unless the whole session is.
async fn listen(
    mut event_loop: EventLoop,
    client: AsyncClient,
    identity: Arc<Identity>,
    status: Vec<u8>,
    received: watch::Sender<Received>,
) {
    // The first publish of a session is the status. Its packet id is free for reports once the
    // status is acknowledged.
    let mut first_publish = None;
    let mut status_acknowledged = false;
    let ended = loop {
        let event = match event_loop.poll().await {
            Ok(event) => event,
            Err(error) => break error.to_string(),
        };
        // The queue is empty at the start of a session, so no attempt here is refused.
        match event {
            Event::Incoming(Incoming::ConnAck(_)) => {
                let _ = client.try_subscribe(identity.topic(RobotTopic::Desired), QoS::AtLeastOnce);
            }
            Event::Incoming(Incoming::SubAck(ack))
                if ack.return_codes.contains(&SubscribeReasonCode::Failure) =>
            {
                break "the subscription was refused".to_owned();
            }
            Event::Incoming(Incoming::SubAck(_)) => {
                let topic = identity.topic(RobotTopic::Status);
                let _ = client.try_publish(topic, QoS::AtLeastOnce, false, status.clone());
                received.send_modify(|received| received.subscribed = Some(Instant::now()));
            }
            // Vitals have no packet id.
            Event::Outgoing(Outgoing::Publish(id)) => {
                first_publish = first_publish.or(Some(id).filter(|id| *id != 0))
            }
            Event::Incoming(Incoming::PubAck(ack))
                if Some(ack.pkid) == first_publish && !status_acknowledged =>
            {
                status_acknowledged = true;
            }
            Event::Incoming(Incoming::PubAck(_)) => received.send_modify(|received| {
                received.reports += 1;
                received.last_report = Some(Instant::now());
            }),
            Event::Incoming(Incoming::Publish(message)) => match identity.open(&message.payload) {
                Ok(state) => received
                    .send_modify(|received| received.desired = Some((state, Instant::now()))),
                Err(text) => break text,
            },
            _ => {}
        }
    };
    received.send_modify(|received| received.ended = Some(ended));
}

/// Publishes the robot's vitals periodically, starting at a random moment.
async fn publish_vitals(client: AsyncClient, identity: Arc<Identity>) {
    let mut machine = Machine::new();
    let first = tokio::time::Instant::now() + VITALS_INTERVAL.mul_f64(rand::random());
    let mut ticks = tokio::time::interval_at(first, VITALS_INTERVAL);
    loop {
        ticks.tick().await;
        let telemetry =
            Telemetry { robot_id: identity.enrolled.robot_id.clone(), vitals: machine.read() };
        // Without room in the queue the next vitals follow.
        let payload = json_bytes(&telemetry);
        let _ = client.try_publish(
            identity.topic(RobotTopic::Telemetry),
            QoS::AtMostOnce,
            false,
            payload,
        );
    }
}

fn json_bytes(value: &impl serde::Serialize) -> Vec<u8> {
    // Plain numbers and texts can always be written.
    serde_json::to_vec(value).unwrap_or_default()
}
