//! A process of a run's robots: `taskbench robots`, started by the run and connected to the run by
//! pipes. Each robot is the agent's own driver, plan, link, MQTT session, fetch and verification
//! around a [`Body`] that starts nothing. The process measures only points in time, and ends when
//! its input ends.

mod body;
pub mod words;

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::io::{BufRead as _, Write as _};
use std::net::IpAddr;
use std::sync::Arc;

use anyhow::{Context as _, anyhow};
use rustls::ClientConfig;
use task_agent::config::{Config, MqttTransport, parse_server};
use task_agent::install::fetch::{FetchSettings, Fetcher};
use task_agent::link::mqtt::{self, MqttAccess, Ways};
use task_agent::link::state::{self, Heard, Intervals, Message, Shared, Talk};
use task_agent::reconcile::driver::{Driver, Speaker};
use task_agent::reconcile::robot::Robot;
use task_agent::system::layout::DataDir;
use task_agent::task::ledger::Ledger;
use task_agent::telemetry::outputs::Registry;
use task_agent::telemetry::vitals::{Sender, Source as _};
use task_agent::transfer::credential::Credential;
use task_agent::transfer::server;
use task_proto::report::{HostFacts, Phase, Report, Status, TaskReport};
use task_proto::request::{Answer, Ask, Outcome, Refusal, Reply, Request};
use task_proto::topic::RobotTopic;
use task_proto::{DeploymentId, InstanceId, RobotId};
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use self::body::Body;
use self::words::{Crew, Member, Order, Word, own_address};
use crate::clock::monotonic_ns;
use crate::encryption::{another, client_config};
use crate::simulated::{Machine, VITALS_INTERVAL};

/// Messages from a robot's link that its driver has not taken yet, as in the agent.
const QUEUED_MESSAGES: usize = 16;
/// Words that were not written yet.
const QUEUED_WORDS: usize = 1024;
/// One boot id for all robots: they are distinguished by their ids.
const BOOT_ID: &str = "00000000-0000-0000-0000-000000000000";

/// A robot that is put together and not started.
struct Assembled {
    driver: Driver<Body>,
    shared: Shared,
    access: MqttAccess,
    server: server::Server,
}

/// Runs the robots that the first line of the input describes, until the input ends.
pub async fn run() -> anyhow::Result<()> {
    let mut lines = input();
    let first = lines.recv().await.context("no crew on the input")?;
    let crew: Crew = serde_json::from_str(&first).context("the first line is no crew")?;
    let (words, said) = mpsc::channel(QUEUED_WORDS);
    std::thread::spawn(move || write_words(said));
    let tls = client_config(crew.pin);
    let mut robots = Vec::with_capacity(crew.members.len());
    for (number, member) in (crew.first..).zip(&crew.members) {
        let robot = assemble(&crew, another(&tls), number, member)
            .await
            .with_context(|| format!("robot {number}"))?;
        robots.push((number, robot));
    }
    words.send(Word::Ready).await.map_err(|_| anyhow!("nobody listens"))?;
    while let Some(line) = lines.recv().await {
        match serde_json::from_str::<Order>(&line).context("a line is no order")? {
            Order::Start => {
                for (number, robot) in robots.drain(..) {
                    start(number, robot, &crew, words.clone());
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

/// Writes one word per line, in a separate thread: the measuring side must not wait for the reader.
fn write_words(mut said: mpsc::Receiver<Word>) -> std::io::Result<()> {
    let mut output = std::io::stdout().lock();
    while let Some(word) = said.blocking_recv() {
        let mut line = serde_json::to_vec(&word).map_err(std::io::Error::other)?;
        line.push(b'\n');
        output.write_all(&line)?;
        output.flush()?;
    }
    Ok(())
}

/// Puts a robot together as `task-agent run` does, around another body.
async fn assemble(
    crew: &Crew,
    tls: ClientConfig,
    number: usize,
    member: &Member,
) -> anyhow::Result<Assembled> {
    let data = DataDir::new(&crew.data.join(number.to_string()))?;
    std::fs::create_dir_all(data.root()).with_context(|| data.root().display().to_string())?;
    let config = Config::load(data.root(), std::iter::empty::<(OsString, OsString)>())?;
    let base = parse_server(&crew.server)?;
    let client = http_client(tls.clone(), crew.own_addresses.then(|| own_address(number).into()))?;
    let enrolled = &member.enrolled;
    let credential = Credential::from(enrolled.token.clone());
    let shared = Shared::new(CancellationToken::new());
    let settings = FetchSettings { reserve_bytes: 0, ..FetchSettings::default() };
    let fetcher =
        Fetcher::new(client.clone(), base.clone(), credential.clone(), data.clone(), settings);
    let registry = Registry::new(client.clone(), base.clone(), credential.clone());
    let fetcher = (fetcher.measured_by(shared.meter.clone()), shared.listening.clone());
    let robot = Robot::new(data, fetcher, registry, &config, &enrolled.robot_id, member.mac);
    let instance = InstanceId::random();
    let speaker = Speaker {
        robot_id: enrolled.robot_id.clone(),
        server_key: crew.key.clone(),
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
    let driver =
        Driver::new(Arc::new(Body::new(robot, facts)), speaker, shared.clone(), ledger, None).await;
    let server =
        server::Server::new(client, base.clone(), enrolled.robot_id.clone(), credential.clone());
    shared.endpoint.send_replace(Some(enrolled.mqtt.clone()));
    let access = MqttAccess {
        host: crew.mqtt_host.clone(),
        port: enrolled.mqtt.port,
        prefix: enrolled.mqtt.prefix.clone(),
        robot: enrolled.robot_id.clone(),
        token: credential,
        status,
        message_bytes: mqtt::MESSAGE_BYTES,
        ways: Ways::new(&base, Arc::new(tls), MqttTransport::Tcp),
    };
    Ok(Assembled { driver, shared, access, server })
}

/// As the agent's, from an address of its own.
fn http_client(tls: ClientConfig, from: Option<IpAddr>) -> anyhow::Result<reqwest::Client> {
    let client = reqwest::Client::builder()
        .connect_timeout(std::time::Duration::from_secs(10))
        .timeout(std::time::Duration::from_secs(30))
        .pool_idle_timeout(server::KEPT_CONNECTION)
        .redirect(reqwest::redirect::Policy::none())
        .tls_backend_preconfigured(tls)
        .local_address(from);
    client.build().context("no HTTP client")
}

fn start(number: usize, robot: Assembled, crew: &Crew, words: mpsc::Sender<Word>) {
    let Assembled { driver, shared, access, server } = robot;
    let (heard, messages): (mpsc::Sender<Heard>, _) = mpsc::channel(QUEUED_MESSAGES);
    let poll = std::time::Duration::from_millis(crew.poll_ms);
    let intervals = Intervals { slow: poll, fast: poll.min(std::time::Duration::from_secs(10)) };
    let robot_id = access.robot.clone();
    let (requests, asked) = mpsc::channel(QUEUED_MESSAGES);
    let (said, to_say) = mpsc::channel(QUEUED_MESSAGES);
    let (interval, source) = (VITALS_INTERVAL, Machine::new());
    let vitals = Sender {
        robot_id: robot_id.clone(),
        interval,
        source: source.clone(),
        server: server.clone(),
    };
    tokio::spawn(vitals.run(shared.clone(), said.clone()));
    tokio::spawn(answer(robot_id, source, asked, said));
    tokio::spawn(witness(number, shared.clone(), words));
    tokio::spawn(driver.run(messages));
    tokio::spawn(state::over_http(server, shared.clone(), intervals, heard.clone()));
    tokio::spawn(async move {
        // These tasks log nothing.
        let (_batches, lines) = mpsc::channel(1);
        mqtt::run(access, shared, heard, Talk { requests, messages: to_say, lines }).await;
    });
}

/// Answers requests for the robot's health, and no others.
async fn answer(
    robot_id: RobotId,
    mut machine: Machine,
    mut asked: mpsc::Receiver<(Request, Instant)>,
    said: mpsc::Sender<Message>,
) {
    while let Some((Request { id, ask, .. }, _)) = asked.recv().await {
        let text = "a simulated robot has no more than its vitals".to_owned();
        let outcome = match ask {
            Ask::Vitals => Outcome::Answer(Answer::Vitals(machine.look())),
            _ => Outcome::Refusal(Refusal { code: "unsupported".to_owned(), text }),
        };
        if let Ok(payload) = serde_json::to_vec(&Reply { robot_id: robot_id.clone(), id, outcome })
        {
            let _ = said.try_send(Message { topic: RobotTopic::Reply, payload });
        }
    }
}

/// Sends a word for each event in the robot's reports, once the report is acknowledged.
async fn witness(robot: usize, shared: Shared, words: mpsc::Sender<Word>) {
    let (mut reports, mut confirmed) = (shared.reports.subscribe(), shared.confirmed.subscribe());
    let (mut mqtt_up, mut settled) = (shared.mqtt_up.subscribe(), shared.settled.subscribe());
    let mut said: BTreeSet<DeploymentId> = BTreeSet::new();
    // Words to send, and the report whose acknowledgement allows each.
    let mut waiting: Vec<(u64, DeploymentId, Option<String>)> = Vec::new();
    let mut reconciled = false;
    loop {
        let report = reports.borrow_and_update().clone();
        if let Some(report) = &report {
            for (deployment, why) in news(report) {
                if said.insert(deployment.clone()) {
                    waiting.push((report.seq, deployment, why));
                }
            }
        }
        let stored = *confirmed.borrow_and_update();
        let at_ns = monotonic_ns();
        let keeps_state =
            *settled.borrow_and_update() && report.is_some_and(|report| report.seq <= stored);
        if !reconciled && *mqtt_up.borrow_and_update() && keeps_state {
            reconciled = true;
            let _ = words.send(Word::Reconciled { robot, at_ns }).await;
        }
        let due: Vec<_> = waiting.extract_if(.., |(seq, ..)| *seq <= stored).collect();
        for (_, deployment, why) in due {
            let word = match why {
                None => Word::Verified { robot, deployment, at_ns },
                Some(why) => Word::Failed { robot, deployment, why },
            };
            let _ = words.send(word).await;
        }
        let changed = tokio::select! {
            // All cancel-safe: a watch remembers that its value changed.
            changed = reports.changed() => changed,
            changed = confirmed.changed() => changed,
            changed = mqtt_up.changed() => changed,
            changed = settled.changed() => changed,
        };
        if changed.is_err() {
            return;
        }
    }
}

/// The orders that a report shows as verified, or as failed with a reason.
fn news(report: &Report) -> impl Iterator<Item = (DeploymentId, Option<String>)> {
    let told = |task: &TaskReport| match task.phase {
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
    report.tasks.iter().filter_map(move |task| Some((task.deployment.clone(), told(task)?)))
}
