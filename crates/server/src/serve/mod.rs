//! Owns the command line of `taskd`, and the start and stop of the server's parts in an order that
//! loses nothing; it never decides what a part could decide.

mod blobs;
mod cluster;
pub mod command_line;
pub mod database;
mod jobs;
pub mod log_limits;
mod part_settings;
mod peers;
mod standby;

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::time::Duration;

use axum::extract::FromRef;
use task_proto::CaPin;
use task_proto::api::ListenerView;
use task_proto::data_directory::Addresses;
use task_proto::time::millis;
use task_proto::trust::envelope::{PublicKey, SigningKey};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::blobs::open_blobs;
use self::cluster::{new_changes, new_presence, start_cluster};
use self::database::{Database, FirstOperator, check_periodically};
use self::jobs::{
    advance_rollouts, announce_silent_robots, announce_violations, continue_orders,
    expire_assignments, sample_load,
};
use self::part_settings::{action_settings, tls_settings};
use crate::auth::oidc::{OidcSetupError, Provider};
use crate::blobs::collector;
use crate::blobs::{BlobError, CommonStoreError};
use crate::broker::{
    Broker, BrokerConfig, BrokerError, ExternalConfig, Gatekeeper, Health, Inbox, Limits,
};
use crate::cluster::leave;
use crate::config::Config;
use crate::domain::limits::robot_limiter::RobotLimiter;
use crate::fleet::presence::Presence;
use crate::fleet::requests::Requests;
use crate::fleet::robot_logs::RobotLogs;
use crate::fleet::robot_vitals::RobotVitals;
use crate::http::accounts::session::PageCookies;
use crate::http::auth::person_limits::PersonLimits;
use crate::http::connection::listener;
use crate::http::events::EventFeed;
use crate::http::registry::archives::ArchiveReaders;
use crate::http::registry::upload::UploadSpace;
use crate::http::server::node_drain::NodeDrain;
use crate::http::server::readiness::{DiskProbe, ReadinessCheck};
use crate::http::server::server_facts::ServerFacts;
use crate::http::{App, AppParts};
use crate::link::downlink::Downlink;
use crate::link::fan_out::FanOutWorker;
use crate::link::gatekeeper::StoreGatekeeper;
use crate::link::mqtt_access::{MqttAccess, server_client_id};
use crate::link::transfers::Transfers;
use crate::link::uplink::Uplink;
use crate::net::backlog::listen;
use crate::net::http_connections::HttpConnections;
use crate::net::proxy_protocol::ProxyProtocol;
use crate::net::tls::{Tls, TlsError};
use crate::orders::actions::Actions;
use crate::orders::changes::Changes;
use crate::orders::delivery_planner::{DeliveryPlanner, ServerLoad};
use crate::orders::desired_states::DesiredStates;
use crate::orders::feed::{self, FeedSource};
use crate::orders::report_writer::ReportWriter;
use crate::store::{ServerIdentity, Sharing, Store, StoreError, sqlite_url};
use crate::system::clock::Clock;
use crate::system::data_directory::{DataDirectory, DataError};
use crate::system::host::host_name;

/// Time limit for running requests at a stop; the whole stop must take less than ten seconds.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for MQTT sessions, at the same time.
const SESSION_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for storing the received reports, afterwards.
const WRITER_TIMEOUT: Duration = Duration::from_secs(3);
/// Time limit for closing the database's connections, last.
const DATABASE_TIMEOUT: Duration = Duration::from_secs(1);
/// Time limit of a proxy's header and of the TLS handshake before an HTTP request, each.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);

/// The reason why the server did not start.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The data directory can't be used.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The database can't be used.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// There is no usable certificate.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The blob store can't be used.
    #[error("the blob store can't be opened")]
    Blobs(#[from] BlobError),
    /// The servers' common store of blobs can't be used.
    #[error(transparent)]
    CommonStore(#[from] CommonStoreError),
    /// Without the setting, all packages would be missing.
    #[error(
        "blobs.store is not set, but the blobs of this database lie in a common store: set blobs.store as before"
    )]
    NoCommonStore,
    /// MQTT can't be served.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// The OpenID provider can't be used.
    #[error(transparent)]
    Oidc(#[from] OidcSetupError),
    /// The client of the other servers can't be made.
    #[error("cluster: the HTTP client can't be created")]
    Peers(#[from] reqwest::Error),
    /// HTTP can't be served.
    #[error("cannot listen for HTTP on {address}")]
    Listen {
        address: SocketAddr,
        /// The operating system's error.
        source: std::io::Error,
    },
}

/// The reason why a server ends by itself.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    /// The broker or the database has failed for good.
    #[error("{0}; the server stops: start it again")]
    Broken(String),
    /// The database belongs to another server now.
    #[error("{successor} has taken over the database; this server stops")]
    TakenOver { successor: String },
}

/// A server that runs until it is stopped. Dropped without [`Server::stop`], its tasks end with the
/// runtime.
pub struct Server {
    data: DataDirectory,
    addresses: Addresses,
    store: Store,
    unusable: watch::Receiver<Option<String>>,
    broker: Broker,
    drain: NodeDrain,
    tls: Option<Tls>,
    stop: CancellationToken,
    tasks: TaskTracker,
    http: JoinHandle<()>,
    reports: JoinHandle<()>,
}

impl Server {
    /// Starts all parts. On return, both listeners accept and their addresses are published.
    pub async fn start(config: Config, clock: Clock) -> Result<Self, ServeError> {
        let data = DataDirectory::open(&config.data)?.with_secrets(config.secrets());
        let key = Arc::new(data.signing_key()?);
        let public_key = key.public_key();
        let tls = open_tls(&config, &data, &clock)?;
        let (stop, tasks) = (CancellationToken::new(), TaskTracker::new());
        if let Some(tls) = tls.clone() {
            tasks.spawn(tls.keep_current(stop.clone()));
        }
        let (nodes, presence) = new_presence(&config, clock.now_ms());
        let store = open_store(&config, &data, &public_key).await?;
        let listening = standby::wait(&config, &data, &store, tls.as_ref()).await?;
        let database = open_database(store, &data, presence.clone(), clock.clone()).await?;
        let (store, unusable) = (database.store().clone(), database.unusable());
        let blobs = open_blobs(&config, &data, &store).await?;
        let (http, http_address) = listening.map_or_else(|| listen_for_http(config.http), Ok)?;

        let (changes, outbox) = new_changes(&config);
        let (load, http_connections) =
            (Arc::<ServerLoad>::default(), Arc::<HttpConnections>::default());
        let planner = DeliveryPlanner::new(&config.delivery, presence.clone(), load.clone());
        let base = Base { clock, store, presence, changes, tls, http_connections };
        let peers = peers::join(&config, &base, &nodes, &key, &stop)?;
        let (desired_states, actions) = orders(&config, &base, key, &planner);
        let robots = start_robot_traffic(&config, &data, &base, planner).await?;
        let RobotTraffic { writer, reports, requests, logs, vitals, robot_limiter, broker, mqtt } =
            robots;
        let Base { clock, store, presence, changes, tls, http_connections } = base;
        let provider = provider(&config)?;
        let drain = NodeDrain::new(broker.clone(), config.drain);
        let transfers = Transfers::new(&config.transfers, config.delivery.site_label.clone());
        let facts = Arc::new(ServerFacts::new(
            &config,
            &blobs,
            listeners(http_address, &broker, tls.is_some()),
            public_key,
            tls.as_ref().map(Tls::pin),
        ));
        let app = App::new(AppParts {
            clock,
            store: store.clone(),
            actions,
            desired_states,
            changes,
            reports: writer,
            presence,
            broker: broker.clone(),
            requests,
            logs,
            vitals,
            blobs,
            transfers,
            uploads: UploadSpace::new(data.fresh_directory("incoming")?, config.max_upload_bytes),
            readers: ArchiveReaders::default(),
            cookies: cookies(tls.as_ref(), provider.as_deref()),
            http_connections,
            robot_limiter,
            provider,
            attempts: Arc::default(),
            facts,
            slow_figures: Arc::default(),
            lists: Arc::default(),
            events: EventFeed::new(),
            mqtt: Arc::new(mqtt),
            trusted_proxies: config.trusted_proxies.clone().into(),
            http_traffic: Arc::default(),
            people: Arc::new(PersonLimits::new(config.people)),
            data: data.path().to_owned(),
            nodes,
            readiness: drain.readiness(),
            drain: drain.clone(),
            peers,
            stop: stop.clone(),
        });
        start_readiness(&tasks, &app).await;
        start_cluster(&tasks, &app, &config, outbox, load.clone()).await;
        start_tasks(&tasks, &app, &config, load);
        tasks.spawn(database.supervise(stop.clone()));
        let http = serve_http(http, app, tls.clone(), &config);
        let addresses = addresses(http_address, &broker, tls.as_ref().map(Tls::pin));
        publish(&data, &addresses)?;
        Ok(Self {
            data,
            addresses,
            store,
            unusable,
            broker,
            drain,
            tls,
            stop,
            tasks,
            http,
            reports,
        })
    }

    /// The addresses of the listeners.
    pub fn addresses(&self) -> &Addresses {
        &self.addresses
    }

    pub fn data(&self) -> &DataDirectory {
        &self.data
    }

    /// Loads a certificate that has replaced the one in use, if the new one is valid.
    pub fn reload_certificate(&self) -> Result<(), TlsError> {
        self.tls.as_ref().map_or(Ok(()), Tls::reload)
    }

    /// Waits until the broker or the database has failed for good, or another server has taken
    /// over.
    pub async fn failure(&self) -> Failure {
        let (mut health, mut unusable) = (self.broker.health(), self.unusable.clone());
        let broker = async {
            match health.wait_for(|health| matches!(health, Health::Failed(_))).await.as_deref() {
                Ok(Health::Failed(seen)) => format!("MQTT has failed: {seen}"),
                _ => "the broker's watchdog has stopped".to_owned(),
            }
        };
        let database = async {
            match unusable.wait_for(Option::is_some).await.as_deref() {
                Ok(Some(why)) => why.clone(),
                // The database is no longer watched.
                _ => std::future::pending().await,
            }
        };
        tokio::select! {
            seen = broker => Failure::Broken(seen),
            why = database => Failure::Broken(why),
            successor = self.store.state().taken_over() => Failure::TakenOver { successor },
        }
    }

    /// Prepares the stop for the setting's time: `/readyz` answers 503 from now on, and after half
    /// of the time, in which a balancer notices, the robots' sessions end one after the other.
    pub async fn drain(&self) {
        self.drain.before_stop().await;
    }

    /// Stops within ten seconds: listeners close, requests and sessions end, received reports are
    /// stored.
    pub async fn stop(self) {
        self.data.unpublish();
        self.stop.cancel();
        let ((), http) = tokio::join!(self.broker.shutdown(SESSION_TIMEOUT), self.http);
        if http.is_err() {
            tracing::error!("the HTTP listener had failed");
        }
        // The writer ends when no sender of reports is left: the broker's inbox and the routes were
        // the last. The drain holds the broker too.
        drop((self.broker, self.drain));
        self.tasks.close();
        let drained = async {
            self.tasks.wait().await;
            self.reports.await
        };
        if tokio::time::timeout(WRITER_TIMEOUT, drained).await.is_err() {
            tracing::warn!("some reports were not stored in time; robots send them again");
        }
        if let Some(run) = self.store.cluster_run() {
            // Without an answer, the others notice by themselves.
            let _ = tokio::time::timeout(DATABASE_TIMEOUT, leave(&self.store, run)).await;
        }
        if tokio::time::timeout(DATABASE_TIMEOUT, self.store.close()).await.is_err() {
            tracing::warn!("the database did not close in time");
        }
    }
}

/// The certificate of the listeners, if they encrypt.
fn open_tls(config: &Config, data: &DataDirectory, clock: &Clock) -> Result<Option<Tls>, TlsError> {
    config.encrypts().then(|| Tls::open(tls_settings(config), data, clock.clone())).transpose()
}

/// The parts that the traffic with robots and the HTTP API share.
struct Base {
    clock: Clock,
    store: Store,
    presence: Arc<Presence>,
    changes: Changes,
    tls: Option<Tls>,
    http_connections: Arc<HttpConnections>,
}

/// The signed desired states, and the orders that change them.
fn orders(
    config: &Config,
    base: &Base,
    key: Arc<SigningKey>,
    planner: &DeliveryPlanner,
) -> (DesiredStates, Actions) {
    let Base { clock, store, changes, tls, .. } = base;
    let lifetime_ms = millis(config.desired_lifetime);
    let states = DesiredStates::new(store.clone(), clock.clone(), key.clone(), lifetime_ms);
    let settings = action_settings(config, tls.as_ref());
    let actions =
        Actions::new(store.clone(), clock.clone(), changes.clone(), key, settings, planner.clone());
    (states, actions)
}

/// The MQTT broker and the parts that take messages from robots.
struct RobotTraffic {
    writer: ReportWriter,
    /// Ends when all received reports are stored.
    reports: JoinHandle<()>,
    requests: Requests,
    logs: RobotLogs,
    vitals: RobotVitals,
    robot_limiter: Arc<RobotLimiter>,
    broker: Broker,
    mqtt: MqttAccess,
}

/// Starts MQTT and the storing of reports.
async fn start_robot_traffic(
    config: &Config,
    data: &DataDirectory,
    base: &Base,
    planner: DeliveryPlanner,
) -> Result<RobotTraffic, ServeError> {
    let Base { clock, store, presence, changes, tls, http_connections } = base;
    let (writer, reports) =
        ReportWriter::start(store.clone(), clock.clone(), changes.clone(), planner);
    let (requests, logs, vitals) = (Requests::default(), RobotLogs::new(), RobotVitals::default());
    let uplink = Uplink::new(
        writer.clone(),
        requests.clone(),
        logs.clone(),
        vitals.clone(),
        presence.clone(),
        changes.clone(),
        clock.clone(),
    );
    let gatekeeper = StoreGatekeeper::new(
        store.clone(),
        clock.clone(),
        presence.clone(),
        http_connections.clone(),
        changes.clone(),
    );
    let robot_limiter = RobotLimiter::new(config.robots);
    let embedded = broker_config(config, tls.clone(), robot_limiter.clone());
    let (broker, mqtt) =
        start_broker(config, embedded, data, Arc::new(gatekeeper), Arc::new(uplink)).await?;
    Ok(RobotTraffic { writer, reports, requests, logs, vitals, robot_limiter, broker, mqtt })
}

/// Opens the HTTP listener; returns its bound address.
fn listen_for_http(address: SocketAddr) -> Result<(TcpListener, SocketAddr), ServeError> {
    let failed = |source| ServeError::Listen { address, source };
    let listener = listen(address).map_err(failed)?;
    let bound = listener.local_addr().map_err(failed)?;
    Ok((listener, bound))
}

/// The OpenID provider, if the configuration names one.
fn provider(config: &Config) -> Result<Option<Arc<Provider>>, ServeError> {
    let has_provider = !config.oidc.issuer.is_empty();
    Ok(has_provider.then(|| Provider::new(config.oidc.clone())).transpose()?.map(Arc::new))
}

/// The form of the cookies of the page, which browsers reach over TLS if the server or the proxy at
/// the provider's public address encrypts.
fn cookies(tls: Option<&Tls>, provider: Option<&Provider>) -> PageCookies {
    let is_behind_tls =
        provider.is_some_and(|provider| provider.settings().public_url.starts_with("https:"));
    PageCookies { is_secure: tls.is_some() || is_behind_tls }
}

/// Serves the HTTP API until the server stops.
fn serve_http(
    listener: TcpListener,
    app: App,
    tls: Option<Tls>,
    config: &Config,
) -> JoinHandle<()> {
    let (connections, traffic) = (app.http_connections.clone(), app.http_traffic.clone());
    let stop = app.stop.clone();
    let service = listener::Service { router: crate::http::router(app), tls, connections, traffic };
    let limits = http_limits(config);
    tokio::spawn(listener::serve(listener, service, limits, stop, REQUEST_TIMEOUT))
}

/// Starts the tasks beside the listeners.
fn start_tasks(tasks: &TaskTracker, app: &App, config: &Config, load: Arc<ServerLoad>) {
    tasks.spawn(sample_load(app.clone(), load));
    let downlink = Downlink {
        desired_states: app.desired_states.clone(),
        blobs: app.blobs.clone(),
        broker: app.broker.clone(),
        presence: app.presence.clone(),
        clock: app.clock.clone(),
    };
    tasks.spawn(downlink.run(app.changes.clone(), app.stop.clone()));
    let views = FromRef::from_ref(app);
    tasks.spawn(app.events.clone().run(views, app.changes.clone(), app.stop.clone()));
    let (store, blobs, clock, stop) =
        (app.store.clone(), app.blobs.clone(), app.clock.clone(), app.stop.clone());
    tasks.spawn(check_periodically(
        store.clone(),
        clock.clone(),
        config.database_check_interval,
        stop.clone(),
    ));
    let nodes = app.nodes.clone();
    let pace = move || u32::try_from(nodes.count()).unwrap_or(1);
    tasks.spawn(collector::run(store, blobs, clock, config.blob_grace, pace, stop));
    tasks.spawn(expire_assignments(app.clone()));
    let worker = FanOutWorker {
        store: app.store.clone(),
        deployments: app.actions.deployments.clone(),
        blobs: app.blobs.clone(),
        broker: app.broker.clone(),
        presence: app.presence.clone(),
        clock: app.clock.clone(),
        changes: app.changes.clone(),
        settings: config.delivery.clone(),
    };
    tasks.spawn(worker.run(app.stop.clone()));
    let source = FeedSource {
        store: app.store.clone(),
        broker: app.broker.clone(),
        clock: app.clock.clone(),
        data: app.data.clone(),
    };
    tasks.spawn(feed::run(source, app.changes.clone(), app.stop.clone()));
    tasks.spawn(announce_silent_robots(app.clone()));
    tasks.spawn(advance_rollouts(app.clone()));
    tasks.spawn(continue_orders(app.clone()));
    tasks.spawn(announce_violations(app.clone()));
}

/// Checks once, so that the first answer of `/readyz` is true, and continues in the background.
async fn start_readiness(tasks: &TaskTracker, app: &App) {
    let mut check = ReadinessCheck {
        readiness: app.readiness.clone(),
        store: app.store.clone(),
        broker: app.broker.clone(),
        disk: DiskProbe::new(app.data.clone()),
        blobs: app.blobs.common_store().cloned(),
    };
    check.check().await;
    tasks.spawn(check.run(app.stop.clone()));
}

/// The database of the configuration. A Postgres is not opened yet, because another server may use
/// it.
async fn open_store(
    config: &Config,
    data: &DataDirectory,
    key: &PublicKey,
) -> Result<Store, ServeError> {
    let in_directory = || sqlite_url(&data.path().join("taskd.sqlite"));
    let url = config.database.clone().unwrap_or_else(in_directory);
    if config.postgres().is_none() {
        return Ok(Store::open(&url).await?);
    }
    let host = host_name().unwrap_or_else(|| "taskd".to_owned());
    let identity = ServerIdentity {
        run: format!("{host}-{:016x}", rand::random::<u64>()),
        key_id: key.id(),
        topic_prefix: config.topic_prefix.as_str().to_owned(),
        sharing: if config.cluster.is_some() { Sharing::Cluster } else { Sharing::Alone },
    };
    Ok(Store::guarded(&url, identity))
}

async fn open_database(
    store: Store,
    data: &DataDirectory,
    presence: Arc<Presence>,
    clock: Clock,
) -> Result<Database, ServeError> {
    let operator = data
        .operator_token()?
        .map(|token| FirstOperator { token, path: data.operator_token_path() });
    Ok(Database::open(store, operator, presence, clock).await?)
}

/// The server's addresses for programs on this machine.
fn addresses(http: SocketAddr, broker: &Broker, ca_pin: Option<CaPin>) -> Addresses {
    let mqtt = broker.local_addr().map(|bound| reachable(bound).to_string());
    let mqtt = mqtt.unwrap_or_else(|| broker.address());
    Addresses { http: reachable(http).to_string(), mqtt, ca_pin }
}

/// Publishes the server's addresses, if there is disk space.
fn publish(data: &DataDirectory, addresses: &Addresses) -> Result<(), DataError> {
    match data.publish(addresses) {
        Err(error @ DataError::Full { .. }) => {
            let error = &error as &dyn std::error::Error;
            tracing::warn!(error, "commands on this machine can't find the server; use --server");
            Ok(())
        }
        published => published,
    }
}

fn http_limits(config: &Config) -> listener::Limits {
    listener::Limits {
        max_connections: config.max_http_connections,
        max_silent_per_address: config.max_silent_per_address,
        proxies: config.trusted_proxies.clone().into(),
        proxy_protocol: ProxyProtocol::new(&config.proxies),
        handshake_timeout: HANDSHAKE_TIMEOUT,
    }
}

/// Starts the broker, with the data that robots and an external broker are told about each other.
async fn start_broker(
    config: &Config,
    embedded: BrokerConfig,
    data: &DataDirectory,
    gatekeeper: Arc<dyn Gatekeeper>,
    inbox: Arc<dyn Inbox>,
) -> Result<(Broker, MqttAccess), ServeError> {
    let (host, prefix) = (config.public_mqtt_host.clone(), config.topic_prefix.clone());
    let Some(brokers) = &config.broker else {
        let encrypts = embedded.tls.is_some();
        let broker = Broker::start(embedded, gatekeeper, inbox).await?;
        let bound = broker.local_addr().map_or(0, |bound| bound.port());
        let port = config.public_mqtt_port.unwrap_or(bound);
        return Ok((broker, MqttAccess::embedded(host, port, prefix, encrypts)));
    };
    let (secret, pin, current) =
        (data.broker_secret()?, config.broker_pin, Arc::<AtomicUsize>::default());
    let access = MqttAccess::external(
        brokers.clone(),
        current.clone(),
        pin,
        host,
        config.public_mqtt_port,
        prefix.clone(),
        secret,
    );
    let client_id = server_client_id(&secret);
    let external = ExternalConfig { brokers: brokers.clone(), current, pin, client_id, prefix };
    Ok((Broker::connect(external, inbox), access))
}

/// The bound addresses of the listeners.
fn listeners(http: SocketAddr, broker: &Broker, tls: bool) -> Vec<ListenerView> {
    let view = |kind: &str, address: SocketAddr| ListenerView {
        kind: kind.to_owned(),
        address: address.to_string(),
        tls,
    };
    [("http", Some(http)), ("mqtt", broker.local_addr())]
        .into_iter()
        .filter_map(|(kind, address)| Some(view(kind, address?)))
        .collect()
}

fn broker_config(
    config: &Config,
    tls: Option<Tls>,
    robot_limiter: Arc<RobotLimiter>,
) -> BrokerConfig {
    let limits = Limits {
        max_connections: config.max_mqtt_connections,
        max_silent_per_address: config.max_silent_per_address,
        ..Limits::default()
    };
    BrokerConfig {
        listen: config.mqtt,
        tls,
        proxy_protocol: ProxyProtocol::new(&config.proxies),
        prefix: config.topic_prefix.clone(),
        limits,
        robot_limiter,
    }
}

/// An address that works from this machine: clients can't connect to "all interfaces".
fn reachable(mut bound: SocketAddr) -> SocketAddr {
    if bound.ip().is_unspecified() {
        bound.set_ip(if bound.is_ipv4() {
            [127, 0, 0, 1].into()
        } else {
            std::net::Ipv6Addr::LOCALHOST.into()
        });
    }
    bound
}
