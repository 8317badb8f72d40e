//! A process of a run's robots: `taskbench robots`, started by the run and connected to the run by
//! pipes. Each robot is the agent's own driver, plan, link, MQTT session, fetch and verification
//! around a [`SimulatedEffects`] that starts nothing. The process measures only points in time, and
//! ends when its input ends.

mod effects;
pub mod log;
pub mod messages;

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::io::{BufRead as _, Write as _};
use std::net::IpAddr;
use std::sync::Arc;

use anyhow::{Context as _, anyhow};
use rustls::ClientConfig;
use task_agent::config::{Config, MqttTransport, parse_server};
use task_agent::install::fetch::{FetchSettings, Fetcher};
use task_agent::link::mqtt::{self, MqttAccess, Routes};
use task_agent::link::state::{
    self, LinkState, Message, MqttChannels, PollIntervals, ServerMessage,
};
use task_agent::reconcile::driver::{AgentIdentity, Driver};
use task_agent::reconcile::robot::Robot;
use task_agent::system::layout::DataDir;
use task_agent::task::ledger::Ledger;
use task_agent::telemetry::outputs::Registry;
use task_agent::telemetry::vitals::{Sender, Source as _};
use task_agent::transfer::credential::Credential;
use task_agent::transfer::server;
use task_proto::messages::report::{HostFacts, Phase, Report, Status, TaskReport};
use task_proto::messages::request::{Answer, Ask, Outcome, Refusal, Reply, Request};
use task_proto::messages::topic::RobotTopic;
use task_proto::{DeploymentId, InstanceId, RobotId};
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use self::effects::SimulatedEffects;
use self::log::{RobotLog, log_link};
use self::messages::{GroupMember, RobotCommand, RobotEvent, RobotGroup, own_address};
use crate::programs::encryption::{client_config, without_shared_sessions};
use crate::simulated::vitals::{Machine, VITALS_INTERVAL};
use crate::system::clock::monotonic_ns;

/// Messages from a robot's link that its driver has not taken yet, as in the agent.
const QUEUED_MESSAGES: usize = 16;
/// Events that were not written yet.
const QUEUED_EVENTS: usize = 1024;
/// One boot id for all robots: they are distinguished by their ids.
const BOOT_ID: &str = "00000000-0000-0000-0000-000000000000";

/// A robot that is put together and not started.
struct Assembled {
    driver: Driver<SimulatedEffects>,
    link_state: LinkState,
    access: MqttAccess,
    server: server::Server,
    log: Option<RobotLog>,
}

/// Runs the robots that the first line of the input describes, until the input ends.
pub async fn run() -> anyhow::Result<()> {
    let mut lines = input();
    let first = lines.recv().await.context("no robot group on the input")?;
    let group: RobotGroup =
        serde_json::from_str(&first).context("the first line is not a robot group")?;
    let (events, queued) = mpsc::channel(QUEUED_EVENTS);
    std::thread::spawn(move || write_events(queued));
    let log = group.log.as_deref().map(RobotLog::open).transpose()?;
    let tls = client_config(group.pin);
    let mut robots = Vec::with_capacity(group.members.len());
    for (number, member) in (group.first..).zip(&group.members) {
        let log = log.clone().map(|lines| RobotLog::of(number, lines));
        let robot = assemble(&group, without_shared_sessions(&tls), number, member, log)
            .await
            .with_context(|| format!("robot {number}"))?;
        robots.push((number, robot));
    }
    events.send(RobotEvent::Ready).await.map_err(|_| anyhow!("the reader has closed the pipe"))?;
    while let Some(line) = lines.recv().await {
        match serde_json::from_str::<RobotCommand>(&line).context("a line is not a command")? {
            RobotCommand::Start => {
                for (number, robot) in robots.drain(..) {
                    start(number, robot, &group, events.clone());
                }
            }
        }
    }
    // The robots end with the process.
    Ok(())
}

/// The input's lines, read by a separate thread, which ends with the input or the process.
fn input() -> mpsc::Receiver<String> {
    let (lines, read) = mpsc::channel(1);
    std::thread::spawn(move || {
        let input = std::io::stdin().lock().lines();
        input.map_while(Result::ok).try_for_each(|line| lines.blocking_send(line))
    });
    read
}

/// Writes one event per line, in a separate thread: the measuring side must not wait for the
/// reader.
fn write_events(mut queued: mpsc::Receiver<RobotEvent>) -> std::io::Result<()> {
    let mut output = std::io::stdout().lock();
    while let Some(event) = queued.blocking_recv() {
        let mut line = serde_json::to_vec(&event).map_err(std::io::Error::other)?;
        line.push(b'\n');
        output.write_all(&line)?;
        output.flush()?;
    }
    Ok(())
}

/// Puts a robot together as `task-agent run` does, around another body.
async fn assemble(
    group: &RobotGroup,
    tls: ClientConfig,
    number: usize,
    member: &GroupMember,
    log: Option<RobotLog>,
) -> anyhow::Result<Assembled> {
    let entrance = group.entrances.get(number % group.entrances.len().max(1));
    let entrance = entrance.context("the robot group has no entrance")?;
    let data = DataDir::new(&group.data.join(number.to_string()))?;
    std::fs::create_dir_all(data.root()).with_context(|| data.root().display().to_string())?;
    let config = Config::load(data.root(), std::iter::empty::<(OsString, OsString)>())?;
    let base = parse_server(&entrance.url)?;
    let client = http_client(tls.clone(), group.own_addresses.then(|| own_address(number).into()))?;
    let enrolled = &member.enrolled;
    let credential = Credential::from(enrolled.token.clone());
    let link_state = LinkState::new(CancellationToken::new());
    let settings = FetchSettings { reserve_bytes: 0, ..FetchSettings::default() };
    let fetcher =
        Fetcher::new(client.clone(), base.clone(), credential.clone(), data.clone(), settings);
    let registry = Registry::new(client.clone(), base.clone(), credential.clone());
    let fetcher =
        (fetcher.with_meter(link_state.meter.clone()), link_state.part_subscriptions.clone());
    let robot = Robot::new(data, fetcher, registry, &config, &enrolled.robot_id, member.mac);
    let instance = InstanceId::random();
    let agent_identity = AgentIdentity {
        robot_id: enrolled.robot_id.clone(),
        server_key: group.key.clone(),
        instance: instance.clone(),
        place: None,
        boot_id: BOOT_ID.to_owned(),
        name: None,
        labels: None,
    };
    let facts = HostFacts {
        agent_version: concat!("taskbench ", env!("CARGO_PKG_VERSION")).to_owned(),
        hostname: enrolled.name.to_string(),
        arch: std::env::consts::ARCH.to_owned(),
        mac: Some(member.mac),
        ..HostFacts::default()
    };
    let ledger = Ledger::new(0);
    let status =
        Status { online: true, start: ledger.start + 1, instance, connection: 0, place: None };
    let driver = Driver::new(
        Arc::new(SimulatedEffects::new(robot, facts, log.clone())),
        agent_identity,
        link_state.clone(),
        ledger,
        None,
    )
    .await;
    let server =
        server::Server::new(client, base.clone(), enrolled.robot_id.clone(), credential.clone());
    link_state.endpoint.send_replace(Some(enrolled.mqtt.clone()));
    let access = MqttAccess {
        host: entrance.mqtt_host.clone(),
        port: enrolled.mqtt.port,
        prefix: enrolled.mqtt.prefix.clone(),
        robot: enrolled.robot_id.clone(),
        token: credential,
        status,
        message_bytes: mqtt::MESSAGE_BYTES,
        routes: Routes::new(&base, Arc::new(tls), MqttTransport::Tcp),
    };
    Ok(Assembled { driver, link_state, access, server, log })
}

/// As the agent's, from an address of its own.
fn http_client(tls: ClientConfig, from: Option<IpAddr>) -> anyhow::Result<reqwest::Client> {
    let client = reqwest::Client::builder()
        .connect_timeout(std::time::Duration::from_secs(10))
        .timeout(std::time::Duration::from_secs(30))
        .pool_idle_timeout(server::IDLE_CONNECTION_TIMEOUT)
        .redirect(reqwest::redirect::Policy::none())
        .tls_backend_preconfigured(tls)
        .local_address(from);
    client.build().context("no HTTP client")
}

fn start(number: usize, robot: Assembled, group: &RobotGroup, events: mpsc::Sender<RobotEvent>) {
    let Assembled { driver, link_state, access, server, log } = robot;
    let (server_messages, messages): (mpsc::Sender<ServerMessage>, _) =
        mpsc::channel(QUEUED_MESSAGES);
    let poll = std::time::Duration::from_millis(group.poll_ms);
    let intervals =
        PollIntervals { slow: poll, fast: poll.min(std::time::Duration::from_secs(10)) };
    let robot_id = access.robot.clone();
    let (requests, received) = mpsc::channel(QUEUED_MESSAGES);
    let (messages_out, outgoing) = mpsc::channel(QUEUED_MESSAGES);
    let interval = VITALS_INTERVAL;
    let source = Machine::new();
    let vitals = Sender {
        robot_id: robot_id.clone(),
        interval,
        source: source.clone(),
        server: server.clone(),
    };
    tokio::spawn(vitals.run(link_state.clone(), messages_out.clone()));
    tokio::spawn(answer(robot_id, source, received, messages_out));
    let until = if log.is_some() { Until::Reconciled } else { Until::End };
    tokio::spawn(report_events(number, link_state.clone(), events, until));
    if let Some(log) = log {
        tokio::spawn(log_link(log, link_state.clone()));
    }
    tokio::spawn(driver.run(messages));
    tokio::spawn(state::run_http(server, link_state.clone(), intervals, server_messages.clone()));
    tokio::spawn(async move {
        // These tasks log nothing.
        let (_batches, lines) = mpsc::channel(1);
        mqtt::run(
            access,
            link_state,
            server_messages,
            MqttChannels { requests, messages: outgoing, lines },
        )
        .await;
    });
}

/// Answers requests for the robot's health, and no others.
async fn answer(
    robot_id: RobotId,
    mut machine: Machine,
    mut requests: mpsc::Receiver<(Request, Instant)>,
    messages: mpsc::Sender<Message>,
) {
    while let Some((Request { id, ask, .. }, _)) = requests.recv().await {
        let text = "a simulated robot has no more than its vitals".to_owned();
        let outcome = match ask {
            Ask::Vitals => Outcome::Answer(Answer::Vitals(machine.read())),
            _ => Outcome::Refusal(Refusal { code: "unsupported".to_owned(), text }),
        };
        if let Ok(payload) = serde_json::to_vec(&Reply { robot_id: robot_id.clone(), id, outcome })
        {
            let _ = messages.try_send(Message { topic: RobotTopic::Reply, payload });
        }
    }
}

/// How long a robot sends events.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Until {
    /// Until it keeps to its desired state for the first time; the rest is in the log.
    Reconciled,
    End,
}

/// Sends an event for each event in the robot's reports, once the report is acknowledged.
async fn report_events(
    robot: usize,
    link_state: LinkState,
    events: mpsc::Sender<RobotEvent>,
    until: Until,
) {
    let mut reports = link_state.reports.subscribe();
    let mut confirmed = link_state.confirmed.subscribe();
    let mut mqtt = link_state.mqtt.subscribe();
    let mut settled = link_state.settled.subscribe();
    let mut reported: BTreeSet<DeploymentId> = BTreeSet::new();
    // Events to send, and the report whose acknowledgement allows each.
    let mut waiting: Vec<(u64, DeploymentId, Option<String>)> = Vec::new();
    let mut reconciled = false;
    loop {
        let report = reports.borrow_and_update().clone();
        if let Some(report) = &report {
            for (deployment, why) in ended_deployments(report) {
                if reported.insert(deployment.clone()) {
                    waiting.push((report.seq, deployment, why));
                }
            }
        }
        let stored = *confirmed.borrow_and_update();
        let at_ns = monotonic_ns();
        let keeps_state =
            *settled.borrow_and_update() && report.is_some_and(|report| report.seq <= stored);
        if !reconciled && mqtt.borrow_and_update().is_up() && keeps_state {
            reconciled = true;
            let _ = events.send(RobotEvent::Reconciled { robot, at_ns }).await;
            if until == Until::Reconciled {
                return;
            }
        }
        let due: Vec<_> = waiting.extract_if(.., |(seq, ..)| *seq <= stored).collect();
        for (_, deployment, why) in due {
            let event = match why {
                None => RobotEvent::Verified { robot, deployment, at_ns },
                Some(why) => RobotEvent::Failed { robot, deployment, why },
            };
            let _ = events.send(event).await;
        }
        let changed = tokio::select! {
            // All cancel-safe: a watch remembers that its value changed.
            changed = reports.changed() => changed,
            changed = confirmed.changed() => changed,
            changed = mqtt.changed() => changed,
            changed = settled.changed() => changed,
        };
        if changed.is_err() {
            return;
        }
    }
}

/// The orders that a report shows as verified, or as failed with a reason.
fn ended_deployments(report: &Report) -> impl Iterator<Item = (DeploymentId, Option<String>)> {
    let outcome = |task: &TaskReport| match task.phase {
        Phase::Building | Phase::Staged | Phase::Starting | Phase::Running | Phase::Succeeded => {
            Some(None)
        }
        Phase::Failed | Phase::Unmet | Phase::RolledBack => {
            let failure = task.failure.as_ref();
            Some(Some(failure.map_or("no reason given".to_owned(), |f| {
                format!("{}: {}", f.code.as_str(), f.text)
            })))
        }
        _ => None,
    };
    report.tasks.iter().filter_map(move |task| Some((task.deployment.clone(), outcome(task)?)))
}
