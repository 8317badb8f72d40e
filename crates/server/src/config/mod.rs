//! Owns the server's settings and where they come from; it never creates anything.
//!
//! Settings come from flags, then `TASKD_*` variables, then a TOML file, then defaults. One table
//! names every setting, so the sources can't drift apart. This module also reads the file and
//! resolves host names.

mod check;
mod cluster;
mod oidc;
mod reference;
mod settings;
mod tables;
mod tls;

use std::ffi::OsString;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Arg, ArgAction, ArgMatches};
use task_proto::CaPin;
use task_proto::data_directory::default_data_directory;
use task_proto::ids::LabelKey;
use task_proto::log_format::LogFormat;
use task_proto::messages::part::DEFAULT_PART_BYTES;
use task_proto::messages::topic::TopicPrefix;
use task_proto::toml_keys::{closest_key, line_of};

use self::cluster::ClusterDraft;
pub use self::cluster::{Bus, ClusterSettings};
pub use self::oidc::{OidcSettings, RoleRule, private_url};
pub use self::reference::reference;
use self::settings::{SETTINGS, Setting};
pub use self::tables::{PersonRates, SiteLimits, TransferLimits};
pub use self::tls::TlsSettings;
use crate::domain::blob_store_url::BlobStoreUrl;
use crate::domain::broker_url::{BrokerUrl, BrokerUrls};
use crate::domain::database_url;
use crate::domain::delivery::{Rule, Rules};
use crate::domain::limits::robot_limiter::RobotLimits;

/// All settings of `taskd serve`.
#[derive(Debug, Clone)]
pub struct Config {
    /// The directory that holds all state.
    pub data: PathBuf,
    /// The form of the server's log.
    pub log_format: LogFormat,
    /// The HTTP listener's address; port 0 picks a free port.
    pub http: SocketAddr,
    /// The MQTT listener's address; port 0 picks a free port.
    pub mqtt: SocketAddr,
    /// The external MQTT brokers, used one at a time; absent: the embedded broker, which listens at
    /// `mqtt`.
    pub broker: Option<BrokerUrls>,
    /// The pinned authority of the external broker's certificate; absent: the system's roots.
    pub broker_pin: Option<CaPin>,
    /// The database's URL, or the URLs of several Postgres servers separated by commas; absent:
    /// SQLite in the data directory.
    pub database: Option<String>,
    /// Whether to wait while another server uses the database, and then to take over.
    pub standby: bool,
    /// Interval between full checks of a SQLite database.
    pub database_check_interval: Duration,
    /// The prefix of all MQTT topics.
    pub topic_prefix: TopicPrefix,
    /// Whether unencrypted listeners may be reached from other machines.
    pub allow_plaintext: bool,
    /// Whether and how the listeners encrypt.
    pub tls: TlsSettings,
    /// Time after which an assignment that is not done expires.
    pub assignment_expiry: Duration,
    /// How long a signed desired state permits a robot to begin new work.
    pub desired_lifetime: Duration,
    /// The MQTT host that is announced to robots; absent: the host of the URL that they already
    /// use.
    pub public_mqtt_host: Option<String>,
    /// The MQTT port that is announced to robots; absent: the bound port.
    pub public_mqtt_port: Option<u16>,
    /// Silence after which a polling robot counts as offline. Robots poll every 10 s by default.
    pub presence_timeout: Duration,
    /// How blobs are read.
    pub blob_read: BlobRead,
    /// `[blobs]`: the servers' common store of blobs; absent: the data directory.
    pub blob_store: Option<BlobStoreUrl>,
    /// Maximum bytes of the local copies of blobs that lie in the common store; absent: 50 GB, or
    /// less on a small disk.
    pub blob_cache_bytes: Option<u64>,
    /// Retention of an unfinished upload or an unreferenced blob.
    pub blob_grace: Duration,
    /// Maximum concurrent HTTP connections; more wait in the listener's backlog.
    pub max_http_connections: usize,
    /// Maximum concurrent MQTT connections; more are refused.
    pub max_mqtt_connections: usize,
    /// Maximum unauthenticated connections of one address: over HTTP without a valid token, over
    /// MQTT before CONNECT. At the limit, the oldest is closed to admit a new one.
    pub max_silent_per_address: usize,
    /// The addresses of reverse proxies whose forwarded client addresses are trusted.
    pub trusted_proxies: Vec<IpAddr>,
    /// The addresses of balancers that begin each connection with a PROXY protocol header.
    pub proxies: Vec<IpAddr>,
    /// Time from a stop signal to the stop, for a balancer and for robots to move to another
    /// server.
    pub drain: Duration,
    /// This server's place in a cluster; absent: it is the only server on its database.
    pub cluster: Option<ClusterSettings>,
    /// The settings of `cluster` as read so far.
    pub(crate) cluster_draft: Option<ClusterDraft>,
    /// The OpenID provider for sign-ins; without an issuer, such sign-ins are off.
    pub oidc: OidcSettings,
    /// Maximum size of one blob, in bytes.
    pub max_blob_bytes: u64,
    /// Maximum unpacked size of a package that is uploaded as a directory, in bytes.
    pub max_upload_bytes: u64,
    /// Maximum bytes stored of one robot's uploaded outputs; absent: 40 GB, or less on a small
    /// disk.
    pub max_robot_bytes: Option<u64>,
    /// How packages travel to robots.
    pub delivery: DeliverySettings,
    /// The bounds on transfers of packages over HTTP.
    pub transfers: TransferLimits,
    /// The rate limits for robots.
    pub robots: RobotLimits,
    /// The rate limits for people.
    pub people: PersonRates,
    /// Whether every new robot waits to be approved.
    pub enrollment_approval: bool,
    /// The default number of robots that one enrollment token admits.
    pub enrollment_uses: u64,
    /// Maximum enrollments in a minute; one token may use half of them.
    pub enrollment_per_minute: u64,
    /// Disk space that people's packages and uploads must leave free; absent: a fortieth of the
    /// disk, 1 GB at most.
    pub disk_reserve: Option<u64>,
}

/// `[delivery]`: how packages travel to robots.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeliverySettings {
    /// The size of a part in direct-push. A package up to this size travels as one message.
    pub part_bytes: u32,
    /// The MQTT quality of service of parts: 0, 1 or 2.
    pub qos: u8,
    /// Maximum bytes of a package that are embedded in an announcement.
    pub inline_bytes: u32,
    /// The label whose value names a robot's site.
    pub site_label: LabelKey,
    /// The operator's own rules, in order of precedence.
    pub own_rules: Vec<Rule>,
}

impl DeliverySettings {
    /// All rules in their order.
    pub fn rules(&self) -> Rules {
        Rules::new(self.own_rules.clone(), self.inline_bytes.into())
    }
}

impl Default for DeliverySettings {
    fn default() -> Self {
        Self {
            part_bytes: DEFAULT_PART_BYTES,
            qos: 1,
            inline_bytes: 32 * 1024,
            site_label: "site".parse().expect("a label's key"),
            own_rules: Vec::new(),
        }
    }
}

/// How the blob handler reads a file's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlobRead {
    /// Through the page cache, mapped into memory: fastest.
    Mmap,
    /// By positioned reads: a disk error is returned as an error and does not raise a signal.
    Pread,
}

/// The source of a setting.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// A command line flag.
    Flag(String),
    Variable(String),
    /// A key in a file.
    File {
        key: String,
        path: PathBuf,
    },
}

impl std::fmt::Display for Origin {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Flag(flag) => f.write_str(flag),
            Self::Variable(name) => f.write_str(name),
            Self::File { key, path } => write!(f, "{key} in {}", path.display()),
        }
    }
}

/// A reason for rejecting the settings.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// A value does not parse.
    #[error("{origin}: {reason}")]
    Value {
        /// The source of the value.
        origin: Origin,
        /// The error in the value.
        reason: String,
    },
    /// A setting that does not exist.
    #[error("{origin}: there is no such setting{hint}")]
    Unknown {
        /// The source of the setting.
        origin: Origin,
        /// The setting that was probably meant, if one is close.
        hint: String,
    },
    /// The file can't be read.
    #[error("can't read the configuration file {}", path.display())]
    Unreadable {
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The file is not TOML.
    #[error("{} is not valid TOML: {}{reason}", path.display(), line.map(|line| format!("line {line}: ")).unwrap_or_default())]
    Syntax { path: PathBuf, line: Option<usize>, reason: String },
    /// No data directory is given and there is no home directory for the default.
    #[error("--data: no directory is given, and neither XDG_DATA_HOME nor HOME is set")]
    NoDataDirectory,
    /// A password is in a place that every user of the machine can read.
    #[error(
        "--{name}: every user of this machine can read a command line; put a URL with a password into the \
         configuration file ({name} = \"…\") or into TASKD_{upper}", upper = name.to_uppercase()
    )]
    PasswordOnCommandLine { name: &'static str },
    /// One public address is set, but robots use several brokers.
    #[error(
        "public_mqtt_host and public_mqtt_port set one address, but broker lists several; robots use the hosts and \
         ports in broker"
    )]
    PublicAddressWithSeveralBrokers,
    /// The broker's password would cross the network unencrypted.
    #[error(
        "broker = {address}: unencrypted connections to other machines are refused; use mqtts://, a broker on this machine, \
         or --allow-plaintext"
    )]
    PlaintextBroker { address: String },
    /// The bytes of packages would cross the network unencrypted.
    #[error(
        "blobs.store: unencrypted connections to other machines ({host}) are refused; use an https:// endpoint, one on \
         this machine, or --allow-plaintext"
    )]
    PlaintextBlobStore { host: String },
    /// A certificate without its key, or the other way round.
    #[error("{given}: {missing} is missing")]
    IncompleteCertificate {
        /// The setting that is present.
        given: &'static str,
        /// The setting that is missing.
        missing: &'static str,
    },
    /// Only a Postgres can be handed over from one server to another.
    #[error("standby = true: a standby requires a Postgres; set `database` to its URL")]
    StandbyWithoutPostgres,
    /// Client certificates need a TLS handshake, and the listeners do not encrypt.
    #[error("tls.client_certificates: client certificates require TLS; set tls.private_ca")]
    ClientCertificatesWithoutTls,
    /// The provider can't be used without this setting.
    #[error("{missing} is missing; sign-in by a provider requires it")]
    OidcIncomplete {
        /// The setting that is missing.
        missing: &'static str,
    },
    /// An unencrypted listener would be reachable from other machines.
    #[error(
        "{key} = {address}: unencrypted connections from other machines are refused; remove --tls-private-ca=false, \
         bind a loopback address, or set --allow-plaintext"
    )]
    Plaintext { key: &'static str, address: SocketAddr },
}

/// Variables that other commands and tasks use; `serve` ignores them.
const FOREIGN_VARIABLES: [&str; 11] = [
    "TASKD_SERVER",
    "TASKD_TOKEN",
    "TASKD_PIN",
    "TASKD_LOG",
    "TASKD_ASSIGNMENT",
    "TASKD_RUN_DIR",
    "TASKD_ROBOT",
    "TASKD_ROBOT_ID",
    "TASKD_TASK",
    "TASKD_VERSION",
    "TASKD_DEPLOYMENT",
];
/// The prefixes of a task's labels and of the test suite's own variables.
const FOREIGN_PREFIXES: [&str; 2] = ["TASKD_LABEL_", "TASKD_TEST_"];
/// Maximum size of a configuration file.
const MAX_FILE_BYTES: u64 = 1024 * 1024;

impl Config {
    /// The defaults, with all state in `data`.
    pub fn with_data(data: PathBuf) -> Self {
        const DAY: Duration = Duration::from_secs(24 * 60 * 60);
        Self {
            data,
            log_format: LogFormat::Auto,
            http: SocketAddr::from(([127, 0, 0, 1], 8080)),
            mqtt: SocketAddr::from(([127, 0, 0, 1], 1883)),
            broker: None,
            broker_pin: None,
            database: None,
            standby: false,
            database_check_interval: DAY,
            topic_prefix: TopicPrefix::default(),
            allow_plaintext: false,
            tls: TlsSettings::default(),
            assignment_expiry: 7 * DAY,
            desired_lifetime: 30 * DAY,
            public_mqtt_host: None,
            public_mqtt_port: None,
            presence_timeout: Duration::from_secs(90),
            blob_read: BlobRead::Mmap,
            blob_store: None,
            blob_cache_bytes: None,
            blob_grace: DAY,
            max_http_connections: 20_000,
            max_mqtt_connections: 20_000,
            max_silent_per_address: 2048,
            trusted_proxies: Vec::new(),
            proxies: Vec::new(),
            drain: Duration::ZERO,
            cluster: None,
            cluster_draft: None,
            oidc: OidcSettings::default(),
            max_blob_bytes: 16 << 30,
            max_upload_bytes: 4 << 30,
            max_robot_bytes: None,
            delivery: DeliverySettings::default(),
            transfers: TransferLimits::default(),
            robots: RobotLimits::default(),
            people: PersonRates::default(),
            enrollment_approval: false,
            enrollment_uses: 100,
            enrollment_per_minute: 3_000,
            disk_reserve: None,
        }
    }

    /// Merges the sources. `environment` is the process's environment, passed in so that tests need
    /// not change it.
    pub fn load(
        flags: &ServeFlags,
        environment: impl IntoIterator<Item = (OsString, OsString)>,
    ) -> Result<Self, ConfigError> {
        let environment: Vec<(OsString, OsString)> = environment.into_iter().collect();
        let variable = |name: &str| {
            environment.iter().find(|(key, _)| key == name).map(|(_, value)| value.clone())
        };
        let mut config = Self::with_data(PathBuf::new());
        let file = flags.config.clone().or_else(|| variable("TASKD_CONFIG").map(PathBuf::from));
        if let Some(path) = &file {
            let (_, table) = read_file(path)?;
            config.apply_file(path, table).into_iter().next().map_or(Ok(()), Err)?;
        }
        config.apply_environment(&environment)?;
        for (name, text) in &flags.settings {
            // A broker's URL always has a password.
            if *name == "broker" && text != "embedded"
                || *name == "database" && database_url::has_password(text)
            {
                return Err(ConfigError::PasswordOnCommandLine { name });
            }
            config.apply(&name.replace('-', "_"), text, Origin::Flag(format!("--{name}")))?;
        }
        if config.data.as_os_str().is_empty() {
            config.data = default_data_directory(variable).ok_or(ConfigError::NoDataDirectory)?;
        }
        config.check()?;
        config.cluster = config.finish_cluster(file.as_deref())?;
        Ok(config)
    }

    /// Refuses settings that contradict each other.
    fn check(&self) -> Result<(), ConfigError> {
        self.oidc.check()?;
        let is_exposed =
            |broker: &&BrokerUrl| !broker.tls && !broker.is_loopback() && !self.allow_plaintext;
        let brokers = self.broker.as_ref().map(BrokerUrls::all).unwrap_or_default();
        if let Some(broker) = brokers.iter().find(is_exposed) {
            return Err(ConfigError::PlaintextBroker { address: broker.address() });
        }
        if brokers.len() > 1 && (self.public_mqtt_host.is_some() || self.public_mqtt_port.is_some())
        {
            return Err(ConfigError::PublicAddressWithSeveralBrokers);
        }
        if let Some(BlobStoreUrl::S3(s3)) = &self.blob_store
            && !self.allow_plaintext
            && let Some(host) = s3.plaintext_host()
        {
            return Err(ConfigError::PlaintextBlobStore { host: host.to_owned() });
        }
        match (&self.tls.certificate, &self.tls.key) {
            (Some(_), None) => Err(ConfigError::IncompleteCertificate {
                given: "tls.certificate",
                missing: "tls.key",
            }),
            (None, Some(_)) => Err(ConfigError::IncompleteCertificate {
                given: "tls.key",
                missing: "tls.certificate",
            }),
            _ => Ok(()),
        }?;
        if self.standby && self.postgres().is_none() {
            return Err(ConfigError::StandbyWithoutPostgres);
        }
        if self.tls.client_certificates && !self.encrypts() {
            return Err(ConfigError::ClientCertificatesWithoutTls);
        }
        match self.exposed_listener() {
            Some((key, address)) if !self.encrypts() && !self.allow_plaintext => {
                Err(ConfigError::Plaintext { key, address })
            }
            _ => Ok(()),
        }
    }

    /// Whether both listeners speak TLS.
    pub fn encrypts(&self) -> bool {
        self.tls.encrypts(self.exposed_listener().is_some(), self.allow_plaintext)
    }

    /// The settings of the cluster, to be read into.
    fn cluster_mut(&mut self) -> &mut ClusterDraft {
        self.cluster_draft.get_or_insert_default()
    }

    /// The setting `database`, if it names Postgres servers.
    pub fn postgres(&self) -> Option<&str> {
        self.database.as_deref().filter(|database| database_url::is_postgres(database))
    }

    /// The first listener that other machines can reach.
    fn exposed_listener(&self) -> Option<(&'static str, SocketAddr)> {
        // With an external broker there is no MQTT listener.
        let mqtt = self.broker.is_none().then_some(("mqtt", self.mqtt));
        [("http", self.http)]
            .into_iter()
            .chain(mqtt)
            .find(|(_, address)| !address.ip().is_loopback())
    }

    fn apply(&mut self, key: &str, text: &str, origin: Origin) -> Result<(), ConfigError> {
        let Some(setting) = Setting::by_key(key) else {
            return Err(ConfigError::Unknown { hint: suggestion(key), origin });
        };
        (setting.set)(self, text).map_err(|reason| ConfigError::Value { origin, reason })
    }

    /// Applies the keys of a file. Returns the errors of all keys.
    fn apply_file(&mut self, path: &Path, table: toml::Table) -> Vec<ConfigError> {
        let mut errors = Vec::new();
        for (key, value) in table {
            match value {
                toml::Value::Table(table) if tables::is_known(&key) => {
                    self.apply_table(path, &key, table, &mut errors)
                }
                value => {
                    let origin = Origin::File { key: key.clone(), path: path.to_owned() };
                    errors.extend(self.apply_value(&key, value, origin).err());
                }
            }
        }
        errors
    }

    /// Applies a setting from a file. `key` is the full name, `origin` the place in the file.
    fn apply_value(
        &mut self,
        key: &str,
        value: toml::Value,
        origin: Origin,
    ) -> Result<(), ConfigError> {
        let text = match value {
            toml::Value::String(text) => text,
            toml::Value::Integer(number) => number.to_string(),
            toml::Value::Boolean(yes) => yes.to_string(),
            other => {
                if Setting::by_key(key).is_none() {
                    return Err(ConfigError::Unknown { hint: suggestion(key), origin });
                }
                let reason = match other {
                    toml::Value::Array(_) => {
                        "expected a string, an integer or a boolean, not an array"
                    }
                    toml::Value::Table(_) => {
                        "expected a string, an integer or a boolean, not a table"
                    }
                    _ => "expected a string, an integer or a boolean",
                };
                return Err(ConfigError::Value { origin, reason: reason.to_owned() });
            }
        };
        self.apply(key, &text, origin)
    }

    fn apply_environment(
        &mut self,
        environment: &[(OsString, OsString)],
    ) -> Result<(), ConfigError> {
        for (name, value) in environment {
            let Some(name) = name.to_str().filter(|name| name.starts_with("TASKD_")) else {
                continue;
            };
            if name == "TASKD_CONFIG"
                || FOREIGN_VARIABLES.contains(&name)
                || FOREIGN_PREFIXES.iter().any(|prefix| name.starts_with(prefix))
            {
                continue;
            }
            let origin = Origin::Variable(name.to_owned());
            let Some(text) = value.to_str() else {
                return Err(ConfigError::Value {
                    origin,
                    reason: "the value is not UTF-8".to_owned(),
                });
            };
            self.apply(&name["TASKD_".len()..].to_ascii_lowercase(), text, origin)?;
        }
        Ok(())
    }
}

/// The flags of `taskd serve`: `--config FILE` and one per setting.
#[derive(Debug, Clone, Default)]
pub struct ServeFlags {
    pub config: Option<PathBuf>,
    /// Settings by flag name.
    pub settings: Vec<(&'static str, String)>,
}

impl clap::Args for ServeFlags {
    fn augment_args(command: clap::Command) -> clap::Command {
        let config = Arg::new("config")
            .long("config")
            .value_name("FILE")
            .value_parser(clap::value_parser!(PathBuf));
        let mut command =
            command.arg(config.help("TOML file with the settings below, '_' in place of '-'"));
        for setting in SETTINGS {
            let arg = Arg::new(setting.name).long(setting.name).help(setting.help);
            let arg = arg.value_name(setting.value_name).action(ArgAction::Set);
            let is_switch = setting.value_name == "BOOL";
            let arg = if is_switch {
                arg.num_args(0..=1).require_equals(true).default_missing_value("true")
            } else {
                arg
            };
            command = command.arg(arg);
        }
        command
    }

    fn augment_args_for_update(command: clap::Command) -> clap::Command {
        Self::augment_args(command)
    }
}

impl clap::FromArgMatches for ServeFlags {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let text =
            |name: &'static str| matches.get_one::<String>(name).map(|text| (name, text.clone()));
        Ok(Self {
            config: matches.get_one::<PathBuf>("config").cloned(),
            settings: SETTINGS.iter().filter_map(|setting| text(setting.name)).collect(),
        })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// The content of a configuration file, and its keys.
fn read_file(path: &Path) -> Result<(String, toml::Table), ConfigError> {
    let unreadable = |source| ConfigError::Unreadable { path: path.to_owned(), source };
    let syntax = |line, reason| ConfigError::Syntax { path: path.to_owned(), line, reason };
    if std::fs::metadata(path).map_err(unreadable)?.len() > MAX_FILE_BYTES {
        return Err(syntax(None, format!("it has more than {MAX_FILE_BYTES} bytes")));
    }
    let text = std::fs::read_to_string(path).map_err(unreadable)?;
    let table = text.parse().map_err(|error: toml::de::Error| {
        // The line itself is left out, because it may contain a password.
        let line = error.span().map(|span| line_of(&text, span.start));
        syntax(line, error.message().to_owned())
    })?;
    Ok((text, table))
}

/// A suggestion for a mistyped key: the closest setting, else the one that shares its first
/// letters.
fn suggestion(key: &str) -> String {
    let keys: Vec<String> = SETTINGS.iter().map(Setting::key).collect();
    if let Some(best) = closest_key(key, keys.iter().map(String::as_str)) {
        return format!("; did you mean {best}?");
    }
    let shared = |other: &str| key.bytes().zip(other.bytes()).take_while(|(a, b)| a == b).count();
    let best = SETTINGS.iter().map(Setting::key).max_by_key(|other| shared(other));
    match best {
        Some(best) if shared(&best) >= 3 => format!("; did you mean {best}?"),
        _ => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn load(
        flags: &[(&'static str, &str)],
        env: &[(&str, &str)],
        file: Option<&str>,
    ) -> Result<Config, String> {
        let directory = tempfile::tempdir().expect("temp dir");
        let path = directory.path().join("taskd.toml");
        if let Some(text) = file {
            std::fs::write(&path, text).expect("written");
        }
        let flags = ServeFlags {
            config: file.map(|_| path.clone()),
            settings: flags.iter().map(|(key, text)| (*key, (*text).to_owned())).collect(),
        };
        let env = env.iter().map(|(name, value)| (OsString::from(name), OsString::from(value)));
        let env = env.chain([(OsString::from("HOME"), OsString::from("/home/ada"))]);
        Config::load(&flags, env)
            .map_err(|error| error.to_string().replace(&path.display().to_string(), "taskd.toml"))
    }

    #[test]
    fn flags_win_over_variables_over_the_file_over_defaults() {
        let file = Some(
            "http = \"127.0.0.1:1\"\nmqtt = \"127.0.0.1:1\"\ndata = \"/file\"\nassignment_expiry = \"2d\"",
        );
        let env = [("TASKD_HTTP", "127.0.0.1:2"), ("TASKD_MQTT", "127.0.0.1:2"), ("PATH", "/bin")];
        let config = load(&[("http", "127.0.0.1:3")], &env, file).expect("loads");
        assert_eq!((config.http.port(), config.mqtt.port()), (3, 2));
        assert_eq!(config.data, PathBuf::from("/file"));
        assert_eq!(config.assignment_expiry, Duration::from_secs(172_800));
        assert_eq!(config.desired_lifetime, Duration::from_secs(30 * 86_400));
        assert_eq!(
            load(&[], &[], None).expect("loads").data,
            PathBuf::from("/home/ada/.local/share/taskd")
        );
    }

    #[test]
    fn invalid_settings_are_refused_by_name() {
        for (name, value, expected) in [
            ("TASKD_HTPT", "x", "TASKD_HTPT: there is no such setting"),
            ("TASKD_MQTTS", "x", "TASKD_MQTTS: there is no such setting; did you mean mqtt?"),
            ("TASKD_HTTP", "x", "TASKD_HTTP: \"x\" is not an address"),
        ] {
            let message = load(&[], &[(name, value)], None).expect_err(expected);
            assert!(message.starts_with(expected), "{message}");
        }
        for (file, expected) in [
            ("htpt = 1", "htpt in taskd.toml: there is no such setting"),
            ("[limits]\nx = 1", "limits in taskd.toml: there is no such setting"),
            (
                "http = [1]",
                "http in taskd.toml: expected a string, an integer or a boolean, not an array",
            ),
            (
                "[delivery]\nqos = 3",
                "delivery.qos in taskd.toml: \"3\" is not a quality of service: 0, 1 or 2",
            ),
            (
                "[delivery]\npart_byts = 3",
                "delivery.part_byts in taskd.toml: there is no such setting; did you mean delivery_part_",
            ),
            ("[delivery]\nqos = [3]", "delivery.qos in taskd.toml: expected a string, an integer"),
            (
                "[transfers]\nmax = 0",
                "transfers.max in taskd.toml: \"0\" is not a whole number from 1",
            ),
            ("blob_read = \"sendfile\"", "blob_read in taskd.toml: \"sendfile\" is neither"),
            ("assignment_expiry = \"0s\"", "assignment_expiry in taskd.toml: \"0s\" is not a time"),
            ("http =", "taskd.toml is not valid TOML"),
        ] {
            let message = load(&[], &[], Some(file)).expect_err(expected);
            assert!(message.starts_with(expected), "{message}");
        }
        // A server may be a task of another one.
        let foreign = [
            "TASKD_SERVER",
            "TASKD_TEST_POSTGRES",
            "TASKD_ROBOT",
            "TASKD_RUN_DIR",
            "TASKD_LABEL_SITE",
        ];
        load(&[], &foreign.map(|name| (name, "x")), None).expect("loads");
    }

    #[test]
    fn standby_without_postgres_is_refused() {
        let standby = ("TASKD_STANDBY", "true");
        for database in [None, Some(("TASKD_DATABASE", "sqlite:/x"))] {
            let env: Vec<_> = database.into_iter().chain([standby]).collect();
            let message = load(&[], &env, None).expect_err("refused");
            assert!(message.starts_with("standby = true: a standby requires a Postgres"));
        }
        let postgres = ("TASKD_DATABASE", "postgres://u@h/d");
        assert!(load(&[], &[postgres, standby], None).expect("loads").standby);
        assert!(!load(&[], &[postgres], None).expect("loads").standby);
    }

    #[test]
    fn plain_text_beyond_loopback_must_be_allowed() {
        let elsewhere = ("mqtt", "0.0.0.0:1883");
        let message =
            load(&[elsewhere, ("tls-private-ca", "false")], &[], None).expect_err("refused");
        assert!(message.starts_with("mqtt = 0.0.0.0:1883: unencrypted"), "{message}");
        let encrypts = |flags: &[_], file| load(flags, &[], file).expect("allowed").encrypts();
        let own = Some("[tls]\ncertificate = \"/etc/c.pem\"\nkey = \"/etc/k.pem\"");
        assert!(!encrypts(&[], None));
        assert!(encrypts(&[elsewhere], None));
        assert!(!encrypts(&[elsewhere, ("allow-plaintext", "true")], None));
        assert!(!encrypts(&[elsewhere, ("broker", "embedded"), ("allow-plaintext", "true")], None));
        assert!(encrypts(&[("tls-private-ca", "true")], None));
        assert!(encrypts(&[("allow-plaintext", "true")], own));
        assert!(encrypts(&[("tls-private-ca", "false")], own));
    }

    #[test]
    fn pin_is_announced_unless_there_is_an_own_certificate() {
        let announces_pin =
            |file: &str| load(&[], &[], Some(file)).expect("loads").tls.announces_pin();
        let own = "[tls]\ncertificate = \"/etc/c.pem\"\nkey = \"/etc/k.pem\"\n";
        assert!(announces_pin("http = \"0.0.0.0:8080\""));
        assert!(!announces_pin(own));
        assert!(announces_pin(&format!("{own}private_ca = true")));
        for (file, expected) in [
            ("[tls]\ncertificate = \"c.pem\"", "tls.certificate: tls.key is missing"),
            ("[tls]\nkey = \"k.pem\"", "tls.key: tls.certificate is missing"),
            (
                "[tls]\nnames = \"a b\"",
                "tls.names in taskd.toml: \"a b\" is neither a host name nor an address",
            ),
            (
                "[tls]\nclient_certificates = true",
                "tls.client_certificates: client certificates require TLS",
            ),
            ("[tls]\ncert = \"c.pem\"", "tls.cert in taskd.toml: there is no such setting"),
        ] {
            let message = load(&[], &[], Some(file)).expect_err(expected);
            assert!(message.starts_with(expected), "{message}");
        }
        let names =
            load(&[("tls-names", "fleet.lab, 10.0.0.7")], &[], None).expect("loads").tls.names;
        assert_eq!(names, ["fleet.lab", "10.0.0.7"]);
    }

    #[test]
    fn broker_password_is_never_shown() {
        let url = "mqtt://taskd:swordfish@localhost:1884";
        let config = load(&[], &[("TASKD_BROKER", url), ("TASKD_MQTT", "0.0.0.0:1883")], None)
            .expect("loads");
        assert!(!format!("{config:?}").contains("swordfish"));
        assert_eq!(config.broker.expect("external").first().address(), "localhost:1884");
        let back = load(&[("broker", "embedded")], &[("TASKD_BROKER", url)], None).expect("loads");
        assert_eq!(back.broker, None);
        let elsewhere = Some("broker = \"mqtt://taskd:swordfish@broker.lab\"");
        for message in [
            load(&[("broker", url)], &[], None).expect_err("readable by everybody"),
            load(&[], &[("TASKD_BROKER", "tcp://taskd:swordfish@localhost")], None)
                .expect_err("no such scheme"),
            load(&[], &[], elsewhere).expect_err("readable on the way"),
        ] {
            assert!(message.contains("broker") || message.contains("BROKER"), "{message}");
            assert!(!message.contains("swordfish"), "{message}");
        }
        assert!(load(&[("allow-plaintext", "true")], &[], elsewhere).is_ok());
    }

    #[test]
    fn list_of_brokers_is_checked_as_a_whole() {
        let both = "mqtt://taskd:swordfish@localhost:1884,mqtts://taskd:swordfish@broker.lab";
        let config = load(&[], &[("TASKD_BROKER", both)], None).expect("loads");
        assert_eq!(config.broker.expect("external").all().len(), 2);
        let one_place = load(&[("public-mqtt-host", "wifi.lab")], &[("TASKD_BROKER", both)], None);
        assert!(one_place.expect_err("one host for two").contains("public_mqtt_host"));
        let plain = both.replace("mqtts", "mqtt");
        let refused =
            load(&[], &[("TASKD_BROKER", &plain)], None).expect_err("readable on the way");
        assert!(refused.contains("broker.lab:1883"), "{refused}");
    }

    #[test]
    fn database_password_is_never_shown() {
        for (url, is_secret) in [
            ("postgres://ada:secret@host/db", true),
            ("postgresql://host/db?user=ada&password=secret", true),
            ("postgres://ada@host/db?sslmode=require", false),
            ("sqlite:///var/lib/a:b@c/taskd.sqlite", false),
        ] {
            assert_eq!(load(&[("database", url)], &[], None).is_err(), is_secret, "{url}");
        }
        let several = "postgres://ada@one/db,postgres://ada:secret@two/db";
        assert!(load(&[("database", several)], &[], None).is_err());
        let config = load(&[], &[("TASKD_DATABASE", several)], None).expect("loads");
        assert_eq!(config.postgres(), Some(several));
        for url in ["mysql://ada:secret@host/db", "postgres://ada:secret@one,two/db"] {
            let message = load(&[], &[("TASKD_DATABASE", url)], None).expect_err("refused");
            assert!(message.starts_with("TASKD_DATABASE: "), "{message}");
            assert!(!message.contains("secret"), "{message}");
        }
    }
}
