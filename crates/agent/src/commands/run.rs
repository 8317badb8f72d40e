//! `task-agent run`: assembles the agent and runs it until a signal. Tasks go on running
//! afterwards; under systemd that needs `KillMode=process`.

use std::fs::{File, OpenOptions, Permissions, TryLockError};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use task_proto::messages::report::Status;
use task_proto::{Digest, InstanceId};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::{DataDir, refuse_plain_text, start_logging, tls};
use crate::config::{Config, parse_server};
use crate::install::fetch::{FetchSettings, Fetcher};
use crate::link::endpoint;
use crate::link::mqtt::{self, MqttAccess, Routes};
use crate::link::rotation::Rotation;
use crate::link::state::{
    self, LinkState, Message, MqttChannels, MqttState, PollIntervals, ServerMessage,
};
use crate::logs::Logs;
use crate::logs::forwarder::Forwarder;
use crate::process::confinement;
use crate::process::program;
use crate::reconcile::driver::{AgentIdentity, Driver};
use crate::reconcile::graph_requests::GraphRequests;
use crate::reconcile::request_verifier::RequestVerifier;
use crate::reconcile::requests::RequestHandler;
use crate::reconcile::robot::Robot;
use crate::system::clock;
use crate::system::identity::Identity;
use crate::system::layout::DataDir as Layout;
use crate::system::place;
use crate::task::ledger::{Ledger, LedgerFile};
use crate::telemetry::outputs::Registry;
use crate::telemetry::vitals::{self, VitalsPaths, VitalsReader};
use crate::transfer::credential::Credential;
use crate::transfer::server::{self, Server};

/// Maximum number of link messages that the driver has not taken yet.
const QUEUED_MESSAGES: usize = 16;
/// Maximum number of unanswered questions.
const QUEUED_REQUESTS: usize = 32;
/// Maximum time for the remaining work after a signal.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(3);

#[derive(Debug, clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    data: DataDir,
}

/// Runs the agent until SIGINT or SIGTERM.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    start_logging("info,rumqttc=warn,rustdds=error")?;
    if let Some(status) = program::collect_orphans_as_init().context("cannot start as process 1")? {
        return Ok(ExitCode::from(status.as_shell_code()));
    }
    confinement::protect_this_process();
    // Two threads, also on one core: writing the ledger to a slow card must not block the link.
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let outcome = runtime.block_on(drive(arguments));
    runtime.shutdown_timeout(SHUTDOWN_TIMEOUT);
    outcome.map(|()| ExitCode::SUCCESS)
}

async fn drive(arguments: Arguments) -> anyhow::Result<()> {
    let data = Layout::new(&arguments.data.data)?;
    let identity = Identity::read(&data.identity())?;
    let config = Config::load(data.root(), std::env::vars_os())?;
    let lock = lock(&data)?;
    let place = Some(place::of(&lock).context("cannot look at the lock file")?);
    let (ledger, lost) = open_ledger(&data)?;
    if let Err(error) = data.clean_leftovers() {
        tracing::warn!(%error, "cannot remove leftovers of an earlier agent");
    }
    let base = server_of(&config, &identity)?;
    let tls = tls(identity.ca_pin, identity.client_key.as_ref())?;
    let client = server::client(tls.clone()).context("cannot make an HTTP client")?;
    let credential = Credential::from(identity.token.clone());
    let shutdown = CancellationToken::new();
    let link_state = LinkState::new(shutdown.clone());
    let fetcher = Fetcher::new(
        client.clone(),
        base.clone(),
        credential.clone(),
        data.clone(),
        FetchSettings::default(),
    );
    fetcher.limit(&config.limits);
    let fetcher =
        (fetcher.with_meter(link_state.meter.clone()), link_state.part_subscriptions.clone());
    let registry = Registry::new(client.clone(), base.clone(), credential.clone());
    let robot = Arc::new(Robot::new(
        data.clone(),
        fetcher,
        registry,
        &config,
        &identity.robot_id,
        identity.mac,
    ));
    let instance = InstanceId::random();
    let verifier = RequestVerifier::new(
        identity.robot_id.clone(),
        instance.clone(),
        identity.server_key.clone(),
    );
    let agent_identity = agent_identity(&identity, &config, instance.clone(), place)?;
    let status = Status {
        online: true,
        start: ledger.start + 1,
        instance: instance.clone(),
        connection: 0,
        place,
    };
    let driver = Driver::new(robot.clone(), agent_identity, link_state.clone(), ledger, lost).await;
    tracing::info!(robot = %identity.robot_id, server = %base, "task-agent runs");

    let (server_messages, messages) = mpsc::channel(QUEUED_MESSAGES);
    let server = Server::new(client, base.clone(), identity.robot_id.clone(), credential.clone());
    let server = server.with_instance(&instance, place);
    let intervals =
        PollIntervals { slow: config.poll_interval, fast: config.poll_interval_without_mqtt };
    tokio::spawn(state::run_http(
        server.clone(),
        link_state.clone(),
        intervals,
        server_messages.clone(),
    ));
    let rotation = Rotation {
        server: server.clone(),
        credential: credential.clone(),
        identity: identity.clone(),
        path: data.identity(),
        lifetime: config.token_lifetime,
    };
    tokio::spawn(rotation.run(link_state.clone(), clock::wall_ms));
    let (said, messages_out) = mpsc::channel(QUEUED_MESSAGES);
    let vitals = vitals_sender(&identity, &config, &data, server.clone());
    tokio::spawn(vitals.run(link_state.clone(), said.clone()));
    if config.mqtt {
        let routes = Routes::new(&base, Arc::new(tls), config.mqtt_transport);
        let access = mqtt_access(&identity, &base, credential, status, routes);
        link_state.endpoint.send_replace(Some(identity.mqtt));
        tokio::spawn(endpoint::follow(server, link_state.clone(), config.poll_interval));
        let channels = (said, messages_out);
        start_mqtt(access, link_state, server_messages, data, robot, verifier, channels);
    } else {
        // Nothing may wait for a session, or for parts.
        link_state.mqtt.send_replace(MqttState::Down);
        link_state.part_subscriptions.set_session_up(false);
    }
    let stop = tokio::spawn(cancel_on_signal(shutdown));
    driver.run(messages).await;
    stop.abort();
    tracing::info!("task-agent ends; its tasks keep running");
    Ok(())
}

/// Sends the figures of this machine.
fn vitals_sender(
    identity: &Identity,
    config: &Config,
    data: &Layout,
    server: Server,
) -> vitals::Sender<VitalsReader> {
    vitals::Sender {
        robot_id: identity.robot_id.clone(),
        interval: config.vitals_interval,
        source: VitalsReader::new(VitalsPaths::of_this_machine(data.root())),
        server,
    }
}

/// The identity that reports carry.
fn agent_identity(
    identity: &Identity,
    config: &Config,
    instance: InstanceId,
    place: Option<Digest>,
) -> anyhow::Result<AgentIdentity> {
    Ok(AgentIdentity {
        robot_id: identity.robot_id.clone(),
        server_key: identity.server_key.clone(),
        instance,
        place,
        boot_id: clock::boot_id().context("cannot read the kernel's boot id")?,
        name: config.name.clone(),
        labels: config.labels.clone(),
    })
}

/// The MQTT access from the enrollment, until the server names another endpoint.
fn mqtt_access(
    identity: &Identity,
    base: &reqwest::Url,
    token: Credential,
    status: Status,
    routes: Routes,
) -> MqttAccess {
    MqttAccess {
        host: base.host_str().map(str::to_owned).unwrap_or_default(),
        port: identity.mqtt.port,
        prefix: identity.mqtt.prefix.clone(),
        robot: identity.robot_id.clone(),
        token,
        status,
        message_bytes: mqtt::MESSAGE_BYTES,
        routes,
    }
}

/// The server's URL: from the settings, else from the enrollment.
fn server_of(config: &Config, identity: &Identity) -> anyhow::Result<reqwest::Url> {
    let base = config.server.clone().map_or_else(|| parse_server(&identity.server), Ok)?;
    refuse_plain_text(identity.ca_pin, &base, "server")?;
    Ok(base)
}

/// Keeps a session up, answers its requests and publishes the messages of tasks.
fn start_mqtt(
    access: MqttAccess,
    link_state: LinkState,
    server_messages: mpsc::Sender<ServerMessage>,
    data: Layout,
    robot: Arc<Robot>,
    verifier: RequestVerifier,
    (messages, said): (mpsc::Sender<Message>, mpsc::Receiver<Message>),
) {
    let robot_id = access.robot.clone();
    let vitals = vitals::OnDemandVitals::new(VitalsPaths::of_this_machine(data.root()));
    let logs = Logs::new(data.clone());
    let forwarder = Forwarder::new(robot_id.clone(), data, robot.forward(), logs.following());
    let (requests, questions) = mpsc::channel(QUEUED_REQUESTS);
    let (batches, lines) = mpsc::channel(1);
    tokio::spawn(
        RequestHandler { robot_id, verifier, logs, graph: GraphRequests { robot }, vitals }
            .run(questions, messages),
    );
    tokio::spawn(forwarder.run(link_state.mqtt.subscribe(), MqttState::is_up, batches));
    tokio::spawn(mqtt::run(
        access,
        link_state,
        server_messages,
        MqttChannels { requests, messages: said, lines },
    ));
}

/// Prevents a second agent from using the data directory while this one lives. Only this user may
/// access the file: a user who could open it could lock it, and so prevent each agent from
/// starting.
fn lock(data: &Layout) -> anyhow::Result<File> {
    let path = data.root().join("lock");
    let open = || {
        let file =
            OpenOptions::new().write(true).create(true).truncate(false).mode(0o600).open(&path)?;
        file.set_permissions(Permissions::from_mode(0o600)).map(|()| file)
    };
    let file = open().with_context(|| format!("cannot make {}", path.display()))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            anyhow::bail!("another task-agent already runs in {}", data.root().display())
        }
        Err(TryLockError::Error(error)) => {
            Err(error).with_context(|| format!("cannot lock {}", path.display()))
        }
    }
}

/// The ledger, and a message if an earlier one could not be read.
fn open_ledger(data: &Layout) -> anyhow::Result<(Ledger, Option<String>)> {
    // The start counter must be above that of the lost ledger; seconds since 1970 are above any
    // count of starts.
    let rebuilt = || Ledger::new(clock::wall_ms().max(clock::PROGRAM_EXISTS_SINCE_MS) / 1000);
    Ok(match Ledger::read(&data.ledger())? {
        LedgerFile::Valid(ledger) => (*ledger, None),
        LedgerFile::Missing if data.task_names()?.is_empty() => (Ledger::new(0), None),
        LedgerFile::Missing => (
            rebuilt(),
            Some("the ledger was gone: it was rebuilt from the running processes".to_owned()),
        ),
        LedgerFile::Unreadable(aside) => {
            let text = format!(
                "the ledger could not be read and was moved to {}: \
                 it was rebuilt from the running processes",
                aside.display()
            );
            (rebuilt(), Some(text))
        }
    })
}

async fn cancel_on_signal(shutdown: CancellationToken) {
    use tokio::signal::unix::{SignalKind, signal};
    let interrupt = signal(SignalKind::interrupt());
    let terminate = signal(SignalKind::terminate());
    match (interrupt, terminate) {
        (Ok(mut interrupt), Ok(mut terminate)) => {
            tokio::select! {
                // Cancel-safe, and nothing follows: a signal stays noticed until it is received.
                _ = interrupt.recv() => {}
                // Cancel-safe, for the same reason.
                _ = terminate.recv() => {}
            }
            shutdown.cancel();
        }
        (interrupt, terminate) => {
            tracing::error!(
                ?interrupt,
                ?terminate,
                "signals can't be received: only SIGKILL ends this agent"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lock_file_is_private_even_if_an_earlier_agent_made_it() {
        let dir = tempfile::tempdir().expect("a directory");
        let data = Layout::new(dir.path()).expect("a data directory");
        let path = data.root().join("lock");
        let mode = || path.metadata().expect("it is there").permissions().mode() & 0o7777;
        drop(lock(&data).expect("locked"));
        assert_eq!(mode(), 0o600);
        std::fs::set_permissions(&path, Permissions::from_mode(0o644)).expect("set");
        let _held = lock(&data).expect("locked");
        assert_eq!(mode(), 0o600);
        let second = lock(&data).expect_err("one at a time").to_string();
        assert!(second.starts_with("another task-agent already runs"), "{second}");
    }
}
