//! Owns the start and stop of the server's parts, in an order that loses nothing; it never decides
//! what a part could decide.

pub mod database;
mod jobs;

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::time::Duration;

use task_proto::CaPin;
use task_proto::api::ListenerView;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::database::{Database, FirstOperator, keep_checked};
use self::jobs::{advance_rollouts, expire_assignments, notice_silence, show_conduct, watch_load};
use crate::auth::oidc::{OidcSetUpError, Provider};
use crate::blobs::collector;
use crate::blobs::{BlobError, BlobSettings, Blobs};
use crate::broker::{
    Broker, BrokerConfig, BrokerError, ExternalConfig, Gatekeeper, Health, Inbox, Limits,
};
use crate::config::{Config, TlsSettings};
use crate::fleet::presence::Presence;
use crate::fleet::requests::Requests;
use crate::fleet::robot_logs::RobotLogs;
use crate::fleet::robot_vitals::RobotVitals;
use crate::http::auth::person_limits::PersonLimits;
use crate::http::connection::listener;
use crate::http::connection::traffic::HttpTotals;
use crate::http::events::{EventFeed, EventSource};
use crate::http::registry::upload::UploadSpace;
use crate::http::server::readiness::{DiskProbe, Readiness, ReadinessCheck};
use crate::http::server::server_facts::ServerFacts;
use crate::http::{App, AppParts};
use crate::limits::conduct::Conduct;
use crate::link::downlink::Downlink;
use crate::link::fan_out::FanOutWorker;
use crate::link::gatekeeper::StoreGatekeeper;
use crate::link::mqtt_access::{MqttAccess, server_client_id};
use crate::link::transfers::Transfers;
use crate::link::uplink::Uplink;
use crate::net::backlog::listen;
use crate::net::http_connections::HttpConnections;
use crate::net::tls::{Tls, TlsError};
use crate::orders::actions::{ActionSettings, Actions};
use crate::orders::changes::Changes;
use crate::orders::chooser::{Chooser, ServerLoad};
use crate::orders::feed::{Feed, FeedSource};
use crate::orders::report_writer::ReportWriter;
use crate::store::{Store, StoreError, sqlite_url};
use crate::system::clock::Clock;
use crate::system::data_directory::{Addresses, DataDirectory, DataError, room};

/// Time limit for running requests at a stop; the whole stop must take less than ten seconds.
const REQUEST_PATIENCE: Duration = Duration::from_secs(5);
/// Time limit for MQTT sessions, at the same time.
const SESSION_PATIENCE: Duration = Duration::from_secs(5);
/// Time limit for storing the received reports, afterwards.
const WRITER_PATIENCE: Duration = Duration::from_secs(3);
/// Time limit for closing the database's connections, last.
const DATABASE_PATIENCE: Duration = Duration::from_secs(1);
/// Time limit of the TLS handshake before an HTTP request.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);
/// Default disk reserve that people must leave free: this share of the disk, up to an absolute
/// maximum in bytes.
const RESERVE_SHARE: u64 = 40;
const MAX_RESERVE_BYTES: u64 = 1 << 30;
/// Default upper bound of one robot's stored outputs, as a share of the disk.
const ROBOT_SHARE: u64 = 8;

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
    /// MQTT can't be served.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// The OpenID provider can't be used.
    #[error(transparent)]
    Oidc(#[from] OidcSetUpError),
    /// HTTP can't be served.
    #[error("cannot listen for HTTP on {address}")]
    Listen {
        address: SocketAddr,
        /// The operating system's error.
        source: std::io::Error,
    },
}

/// A server that runs until it is stopped. Dropped without [`Server::stop`], its tasks end with the
/// runtime.
pub struct Server {
    data: DataDirectory,
    addresses: Addresses,
    store: Store,
    unusable: watch::Receiver<Option<String>>,
    broker: Broker,
    tls: Option<Tls>,
    stop: CancellationToken,
    tasks: TaskTracker,
    http: JoinHandle<()>,
    reports: JoinHandle<()>,
}

impl Server {
    /// Starts all parts. On return, both listeners accept and their addresses are published.
    pub async fn start(config: Config, clock: Clock) -> Result<Self, ServeError> {
        let data = DataDirectory::open(&config.data)?;
        let key = data.signing_key()?;
        let public_key = key.public_key();
        let tls = config
            .encrypts()
            .then(|| Tls::open(tls_settings(&config), &data, clock.clone()))
            .transpose()?;
        let presence =
            Arc::new(Presence::new(milliseconds(config.presence_timeout), clock.now_ms()));
        let database = open_database(&config, &data, presence.clone(), clock.clone()).await?;
        let (store, unusable) = (database.store().clone(), database.unusable());
        let blobs = Blobs::open(data.path(), blob_settings(&config))?;
        let http = listen(config.http)
            .map_err(|source| ServeError::Listen { address: config.http, source })?;
        let http_address = http
            .local_addr()
            .map_err(|source| ServeError::Listen { address: config.http, source })?;

        let changes = Changes::new();
        let (load, http_connections) =
            (Arc::<ServerLoad>::default(), Arc::<HttpConnections>::default());
        let chooser = Chooser::new(&config.delivery, presence.clone(), load.clone());
        let settings = action_settings(&config, tls.as_ref());
        let actions = Actions::new(
            store.clone(),
            clock.clone(),
            changes.clone(),
            key,
            settings,
            chooser.clone(),
        );
        let (writer, reports) =
            ReportWriter::start(store.clone(), clock.clone(), changes.clone(), chooser);
        let (requests, logs, vitals) =
            (Requests::default(), RobotLogs::new(), RobotVitals::default());
        let (heard, said, done, told) =
            (requests.clone(), logs.clone(), vitals.clone(), changes.clone());
        let uplink = Uplink::new(
            writer.clone(),
            heard,
            said,
            done,
            presence.clone(),
            changes.clone(),
            clock.clone(),
        );
        let gatekeeper = StoreGatekeeper::new(
            store.clone(),
            clock.clone(),
            presence.clone(),
            http_connections.clone(),
            told,
        );
        let conduct = Conduct::new(config.robots);
        let broker = broker_config(&config, tls.clone(), conduct.clone());
        let (broker, mqtt) =
            start_broker(&config, broker, &data, Arc::new(gatekeeper), Arc::new(uplink)).await?;

        let has_provider = !config.oidc.issuer.is_empty();
        let provider =
            has_provider.then(|| Provider::new(config.oidc.clone())).transpose()?.map(Arc::new);
        let transfers = Transfers::new(&config.transfers, config.delivery.site_label.clone());
        let (stop, tasks, http_traffic) =
            (CancellationToken::new(), TaskTracker::new(), Arc::<HttpTotals>::default());
        let facts = Arc::new(ServerFacts::new(
            &config,
            &blobs,
            listeners(http_address, &broker, tls.is_some()),
        ));
        let app = App::new(AppParts {
            feed: Feed::new(clock.now_ms()),
            clock,
            store: store.clone(),
            actions,
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
            sessions: Arc::default(),
            http_connections: http_connections.clone(),
            conduct,
            provider,
            attempts: Arc::default(),
            facts,
            slow_figures: Arc::default(),
            lists: Arc::default(),
            events: EventFeed::new(),
            key: public_key,
            ca_pin: tls.as_ref().map(Tls::pin),
            mqtt: Arc::new(mqtt),
            trusted_proxies: config.trusted_proxies.clone().into(),
            http_traffic: http_traffic.clone(),
            people: Arc::new(PersonLimits::new(config.people)),
            data: data.path().to_owned(),
            readiness: Readiness::default(),
            stop: stop.clone(),
        });
        start_readiness(&tasks, &app).await;
        start_tasks(&tasks, &app, &config);
        if let Some(tls) = tls.clone() {
            tasks.spawn(tls.keep_current(stop.clone()));
        }
        tasks.spawn(watch_load(app.clone(), load));
        tasks.spawn(database.attend(stop.clone()));
        let (router, connections, traffic) =
            (crate::http::router(app), http_connections, http_traffic);
        let service = listener::Service { router, tls: tls.clone(), connections, traffic };
        let http =
            listener::serve(http, service, http_limits(&config), stop.clone(), REQUEST_PATIENCE);
        let addresses = publish(&data, http_address, &broker, tls.as_ref().map(Tls::pin))?;
        Ok(Self {
            data,
            addresses,
            store,
            unusable,
            broker,
            tls,
            stop,
            tasks,
            http: tokio::spawn(http),
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

    /// Waits until the broker or the database has failed for good; returns the observation.
    pub async fn broken(&self) -> String {
        let (mut health, mut unusable) = (self.broker.health(), self.unusable.clone());
        let broker = async {
            match health.wait_for(|health| matches!(health, Health::Failed(_))).await.as_deref() {
                Ok(Health::Failed(seen)) => format!("MQTT can't be served any more: {seen}"),
                _ => "the broker's watchdog has ended".to_owned(),
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
            seen = broker => seen,
            why = database => why,
        }
    }

    /// Stops within ten seconds: listeners close, requests and sessions end, received reports are
    /// stored.
    pub async fn stop(self) {
        self.data.unpublish();
        self.stop.cancel();
        let ((), http) = tokio::join!(self.broker.shutdown(SESSION_PATIENCE), self.http);
        if http.is_err() {
            tracing::error!("the HTTP listener had failed");
        }
        // The writer ends when no sender of reports is left: the broker's inbox and the routes were
        // the last.
        drop(self.broker);
        self.tasks.close();
        let drained = async {
            self.tasks.wait().await;
            self.reports.await
        };
        if tokio::time::timeout(WRITER_PATIENCE, drained).await.is_err() {
            tracing::warn!("not every report was stored in time; robots send them again");
        }
        if tokio::time::timeout(DATABASE_PATIENCE, self.store.close()).await.is_err() {
            tracing::warn!("the database did not close in time");
        }
    }
}

/// Starts the tasks beside the listeners.
fn start_tasks(tasks: &TaskTracker, app: &App, config: &Config) {
    let downlink = Downlink {
        actions: app.actions.clone(),
        blobs: app.blobs.clone(),
        broker: app.broker.clone(),
        presence: app.presence.clone(),
        clock: app.clock.clone(),
    };
    tasks.spawn(downlink.run(app.changes.clone(), app.stop.clone()));
    let source = EventSource {
        store: app.store.clone(),
        presence: app.presence.clone(),
        conduct: app.conduct.clone(),
        vitals: app.vitals.clone(),
        feed: app.feed.clone(),
        clock: app.clock.clone(),
    };
    tasks.spawn(app.events.clone().run(source, app.changes.clone(), app.stop.clone()));
    let (store, blobs, clock, stop) =
        (app.store.clone(), app.blobs.clone(), app.clock.clone(), app.stop.clone());
    tasks.spawn(keep_checked(
        store.clone(),
        clock.clone(),
        config.database_check_interval,
        stop.clone(),
    ));
    tasks.spawn(collector::run(store, blobs, clock, config.blob_grace, stop));
    tasks.spawn(expire_assignments(app.clone()));
    let worker = FanOutWorker {
        store: app.store.clone(),
        actions: app.actions.clone(),
        blobs: app.blobs.clone(),
        broker: app.broker.clone(),
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
    tasks.spawn(app.feed.clone().run(source, app.changes.clone(), app.stop.clone()));
    tasks.spawn(notice_silence(app.clone()));
    tasks.spawn(advance_rollouts(app.clone()));
    tasks.spawn(show_conduct(app.clone()));
}

/// Checks once, so that the first answer of `/readyz` is true, and continues in the background.
async fn start_readiness(tasks: &TaskTracker, app: &App) {
    let mut check = ReadinessCheck {
        readiness: app.readiness.clone(),
        store: app.store.clone(),
        broker: app.broker.clone(),
        disk: DiskProbe::new(app.data.clone()),
    };
    check.check().await;
    tasks.spawn(check.run(app.stop.clone()));
}

async fn open_database(
    config: &Config,
    data: &DataDirectory,
    presence: Arc<Presence>,
    clock: Clock,
) -> Result<Database, ServeError> {
    let url =
        config.database.clone().unwrap_or_else(|| sqlite_url(&data.path().join("taskd.sqlite")));
    let operator =
        FirstOperator { token: data.operator_token()?, path: data.operator_token_path() };
    Ok(Database::open(&url, operator, presence, clock).await?)
}

/// Publishes the server's addresses for programs on this machine, if there is disk space.
fn publish(
    data: &DataDirectory,
    http: SocketAddr,
    broker: &Broker,
    ca_pin: Option<CaPin>,
) -> Result<Addresses, DataError> {
    let mqtt = broker.local_addr().map(|bound| reachable(bound).to_string());
    let mqtt = mqtt.unwrap_or_else(|| broker.address());
    let addresses = Addresses { http: reachable(http).to_string(), mqtt, ca_pin };
    match data.publish(&addresses) {
        Err(error @ DataError::Full { .. }) => {
            let error = &error as &dyn std::error::Error;
            tracing::warn!(
                error,
                "commands on this machine do not find the server; name it with --server"
            );
        }
        published => published?,
    }
    Ok(addresses)
}

fn milliseconds(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

fn action_settings(config: &Config, tls: Option<&Tls>) -> ActionSettings {
    ActionSettings {
        ca_pin: tls.and_then(Tls::told_pin),
        assignment_lifetime_ms: milliseconds(config.assignment_expiry),
        desired_lifetime_ms: milliseconds(config.desired_lifetime),
        enrolment_approval: config.enrolment_approval,
        enrolment_token_uses: config.enrolment_uses,
        enrolments_per_minute: config.enrolment_per_minute,
        ..ActionSettings::default()
    }
}

/// Adds the public host of robots to the certificate's names.
fn tls_settings(config: &Config) -> TlsSettings {
    let mut settings = config.tls.clone();
    settings.names.extend(config.public_mqtt_host.clone());
    settings
}

fn blob_settings(config: &Config) -> BlobSettings {
    let defaults = BlobSettings::default();
    let disk_bytes = room(&config.data).map_or(u64::MAX, |(_, total)| total);
    BlobSettings {
        reading: config.blob_read,
        max_blob_bytes: config.max_blob_bytes,
        max_robot_bytes: config
            .max_robot_bytes
            .unwrap_or(defaults.max_robot_bytes.min(disk_bytes / ROBOT_SHARE)),
        reserve_bytes: config
            .disk_reserve
            .unwrap_or(MAX_RESERVE_BYTES.min(disk_bytes / RESERVE_SHARE)),
        ..defaults
    }
}

fn http_limits(config: &Config) -> listener::Limits {
    listener::Limits {
        max_connections: config.max_http_connections,
        max_silent_per_address: config.max_silent_per_address,
        proxies: config.trusted_proxies.clone().into(),
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

fn broker_config(config: &Config, tls: Option<Tls>, conduct: Arc<Conduct>) -> BrokerConfig {
    let limits = Limits {
        max_connections: config.max_mqtt_connections,
        max_silent_per_address: config.max_silent_per_address,
        ..Limits::default()
    };
    BrokerConfig { listen: config.mqtt, tls, prefix: config.topic_prefix.clone(), limits, conduct }
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
