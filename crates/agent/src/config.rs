//! The robot's settings: `agent.toml`, the `TASK_AGENT_*` variables above it, and the trusted
//! publishers. They are read once, at start, and hold no secret.
//!
//! The environment overrides the file, and the file overrides the defaults. Unknown keys are
//! refused by name.

mod check;
mod reference;
pub mod settings;
pub mod trust;

pub use self::check::check_file;
pub use self::reference::reference;

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use task_proto::RobotName;
use task_proto::desired::settings::{MAX_ROS_DOMAIN_ID, RobotLimits};
use task_proto::expected::in_file_terms;
use task_proto::ids::Labels;
use task_proto::packages::publisher::{InvalidRole, Role};
use task_proto::telemetry::log::LogLevel;
use task_proto::trust::envelope::PublicKey;
use toml::{Table, Value};

use crate::config::trust::TrustSettings;
use crate::logs::forwarder::ForwardSettings;
use crate::process::call_filter::Seccomp;
use crate::system::durable;

pub const FILE_NAME: &str = "agent.toml";
/// The longest time the gate may be given to answer, in seconds.
pub const MAX_GATE_TIMEOUT_S: u64 = 300;
/// Default user ids of tasks and builds. Neither Debian nor systemd assigns ids from this range,
/// and the range is below the ids that are assigned for containers.
const DEFAULT_TASK_UIDS: &str = "70000-79999";
/// Lowest user id for tasks; the ids below are the system's own accounts.
const MIN_TASK_UID: u32 = 1000;
/// Prefix of every variable.
const VARIABLE_PREFIX: &str = "TASK_AGENT_";
/// The variable by which ROS 2 itself knows its domain; `ros_domain_id` overrides it.
const ROS_DOMAIN_ID: &str = "ROS_DOMAIN_ID";
/// Variables that are no settings: the data directory, filter and form of the log, the enrollment
/// token.
const OTHER_VARIABLES: [&str; 4] =
    ["TASK_AGENT_DATA", "TASK_AGENT_LOG", "TASK_AGENT_LOG_FORMAT", "TASK_AGENT_ENROLL_TOKEN"];

/// The property file. An absent key has its default.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub server: Option<String>,
    /// Whether MQTT is used. With `false` the robot only polls.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mqtt: Option<bool>,
    /// How the MQTT connection reaches the server.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mqtt_transport: Option<MqttTransport>,
    /// The name that the robot gives itself; the server's name overrides it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<RobotName>,
    /// Setup files that are sourced before a task is built or run. Absent: the setup files in
    /// `/opt/ros`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub underlays: Option<Vec<PathBuf>>,
    /// The robot's own ROS workspace. The setup file in its `install` or `devel` is sourced after
    /// them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub workspace: Option<PathBuf>,
    /// Whether the server may name setup files even if `trusted_publishers` is set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub server_underlays: Option<bool>,
    /// `ROS_DOMAIN_ID` of every task. Absent: the agent's own domain id, if it has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ros_domain_id: Option<u32>,
    /// Seconds between two polls while MQTT works.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poll_interval_s: Option<u64>,
    /// Seconds between two polls without MQTT.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poll_interval_without_mqtt_s: Option<u64>,
    /// Seconds after which the robot asks for a new token.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub token_lifetime_s: Option<u64>,
    /// Interval between the robot's vitals reports, in seconds; 0: the robot sends none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vitals_interval_s: Option<u64>,
    /// The account that gives the tasks their groups if the agent is root, by name or number;
    /// absent: `taskd-task`. `root` must be set explicitly, and then tasks run as root.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_user: Option<String>,
    /// Whether builds and tasks are denied the system calls that only an administrator needs;
    /// absent: where they run under an account of their own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seccomp: Option<Seccomp>,
    /// The user ids that tasks and builds run under, `FIRST-LAST`; `none`: all of them under
    /// `task_user`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_uids: Option<String>,
    /// The labels that the robot gives itself; the server's labels override them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub labels: Option<Labels>,
    /// Resource limits of tasks.
    #[serde(default, deserialize_with = "known_limits", skip_serializing_if = "Option::is_none")]
    pub limits: Option<RobotLimits>,
    /// The gate: the program that approves each start, stop or switch of a task.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gate: Option<GateSettings>,
    /// Selection of the log lines that the robot sends to the server without a request.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub logs: Option<LogSettings>,
    /// Publishers of the packages that are run; absent: every package that the server orders is
    /// run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trusted_publishers: Option<PublisherSettings>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublisherSettings {
    /// The publisher keys: a package needs their signatures, until a list of publishers replaces
    /// them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keys: Option<Vec<PublicKey>>,
    /// Number of those keys that must have signed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threshold: Option<u32>,
    /// The keeper keys: the first list of publishers needs their signatures; absent: the publisher
    /// keys, with the same threshold.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keeper_keys: Option<Vec<PublicKey>>,
    /// Number of those keys that must have signed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keeper_threshold: Option<u32>,
    /// Whether nothing is run before the robot has a list.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub require_list: Option<bool>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GateSettings {
    /// The program, by its absolute path, and its arguments.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub command: Option<Vec<String>>,
    /// Maximum answer time of the gate, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timeout_s: Option<u64>,
    /// The decision that applies when the gate hangs, crashes or can't be run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub default: Option<GateDefault>,
}

/// How the MQTT connection reaches the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MqttTransport {
    /// Over the MQTT port; where that can't be reached, as a WebSocket over the HTTP port.
    #[default]
    Auto,
    /// Only over the MQTT port.
    Tcp,
    /// Only as a WebSocket over the HTTP port.
    Websocket,
}

/// The decision that applies when the gate gives no answer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GateDefault {
    /// Treat no answer as a yes.
    Allow,
    /// Treat no answer as "not now".
    #[default]
    Deny,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogSettings {
    /// The least serious level of the lines that go to the server while no client follows the log.
    /// The robot itself keeps the lines of all levels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forward_level: Option<LogLevel>,
    /// Maximum number of forwarded lines a second, for each task.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forward_lines_per_s: Option<u32>,
}

/// The `[limits]` table. A robot ignores limits that only a newer server knows; in the robot's own
/// file an unknown key is a mistake and is refused.
fn known_limits<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<RobotLimits>, D::Error> {
    let table = Table::deserialize(deserializer)?;
    let known = RobotLimits::default().bounds().map(|(key, ..)| key.trim_start_matches("limits."));
    if let Some(key) = table.keys().find(|key| !known.contains(&key.as_str())) {
        return Err(D::Error::custom(format_args!(
            "unknown field `{key}`, expected one of {}",
            known.join(", ")
        )));
    }
    table.try_into().map(Some).map_err(D::Error::custom)
}

/// A setting that counts something, as `usize`; capped at `usize::MAX`.
pub(crate) fn count(number: u64) -> usize {
    usize::try_from(number).unwrap_or(usize::MAX)
}

/// The effective settings of the gate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GateConfig {
    /// The program and its arguments.
    pub command: Vec<String>,
    /// Maximum answer time of the gate.
    pub timeout: Duration,
    /// The decision that applies when there is no answer.
    pub default: GateDefault,
}

/// The effective settings, defaults filled in.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// The server's URL, if one is given.
    pub server: Option<reqwest::Url>,
    /// Whether MQTT is used.
    pub mqtt: bool,
    /// How the MQTT connection reaches the server.
    pub mqtt_transport: MqttTransport,
    /// The name that the robot gives itself.
    pub name: Option<RobotName>,
    /// The labels that the robot gives itself, if any.
    pub labels: Option<Labels>,
    /// Setup files to source; empty: the setup files that are found.
    pub underlays: Vec<PathBuf>,
    /// The robot's own ROS workspace on top of them.
    pub workspace: Option<PathBuf>,
    /// Whether the server may name setup files although publishers are trusted.
    pub server_underlays: bool,
    /// `ROS_DOMAIN_ID` of every task, if the settings or the agent's environment set one.
    pub ros_domain_id: Option<u32>,
    /// Interval between two polls while MQTT works.
    pub poll_interval: Duration,
    /// Interval between two polls without MQTT.
    pub poll_interval_without_mqtt: Duration,
    /// The age at which the robot asks for a new token.
    pub token_lifetime: Duration,
    /// Interval between two vitals reports; zero: the robot sends none.
    pub vitals_interval: Duration,
    /// The account that gives tasks their groups, if the settings name one.
    pub task_user: Option<String>,
    /// Whether tasks are denied system calls, if the settings contain the key.
    pub seccomp: Option<Seccomp>,
    /// The user ids of tasks and builds; `None`: all use the id of `task_user`.
    pub task_uids: Option<RangeInclusive<u32>>,
    /// Resource limits of tasks.
    pub limits: RobotLimits,
    /// Selection of the log lines that the robot sends to the server without a request.
    pub forward: ForwardSettings,
    /// The log level of that selection, if the settings contain one.
    pub own_forward_level: Option<LogLevel>,
    /// Maximum processes and threads of a build, and of a task without a limit in its package.
    pub task_pids: u64,
    /// Maximum number of versions that are prepared at the same time.
    pub parallel_tasks: usize,
    /// The gate, which approves each start, stop or switch of a task; `None`: no approval is
    /// needed.
    pub gate: Option<GateConfig>,
    /// Publishers of the packages that are run; `None`: every package that the server orders is
    /// run.
    pub trust: Option<TrustSettings>,
}

/// A setting that can't be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file can't be read or written.
    #[error("cannot use {path}")]
    Io { path: PathBuf, source: std::io::Error },
    /// The file or the variables do not parse; the parser's text names the key.
    #[error("{origin}: {reason}")]
    Invalid {
        origin: String,
        /// Description of the error.
        reason: String,
    },
}

impl Settings {
    /// The property file of the data directory; empty settings if there is none.
    pub fn read(data_dir: &Path) -> Result<Self, ConfigError> {
        let path = data_dir.join(FILE_NAME);
        deserialize(read_table(&path)?, &path.display().to_string())
    }

    /// Writes the property file.
    pub fn write(&self, data_dir: &Path) -> Result<(), ConfigError> {
        let path = data_dir.join(FILE_NAME);
        let mut text =
            "# The robot's settings. Edit with task-agent configure; TASK_AGENT_* variables override them.\n".to_owned();
        let body =
            toml::to_string(self).map_err(|error| invalid(&path.display().to_string(), &error))?;
        // Writing to a String can't fail.
        let _ = write!(text, "{body}");
        durable::write(&path, text.as_bytes(), 0o644)
            .map_err(|source| ConfigError::Io { path, source })
    }
}

impl Config {
    /// The settings of `data_dir` under `variables`, normally the process's environment.
    pub fn load(
        data_dir: &Path,
        variables: impl Iterator<Item = (OsString, OsString)>,
    ) -> Result<Self, ConfigError> {
        Self::load_file(&data_dir.join(FILE_NAME), variables)
    }

    /// The settings of the file at `path` under `variables`.
    fn load_file(
        path: &Path,
        variables: impl Iterator<Item = (OsString, OsString)>,
    ) -> Result<Self, ConfigError> {
        let mut table = read_table(path)?;
        // The file is checked first, alone, so that an error names its path.
        let _: Settings = deserialize(table.clone(), &path.display().to_string())?;
        let mut ros_domain_id = None;
        let mut given = BTreeSet::new();
        for (name, value) in variables {
            // Other variables may hold any bytes. In a setting's value a wrong character becomes
            // one that the setting's type refuses.
            let name = name.to_string_lossy();
            let value = value.to_string_lossy();
            if name == ROS_DOMAIN_ID && !value.is_empty() {
                ros_domain_id = Some(parse_ros_domain_id(&value)?);
            }
            if !name.starts_with(VARIABLE_PREFIX) || OTHER_VARIABLES.contains(&&*name) {
                continue;
            }
            override_by(&mut table, &name, &value)?;
            let _: Settings = deserialize(table.clone(), &name)?;
            given.insert(name.into_owned());
        }
        let mut settings: Settings = deserialize(table, "the settings")?;
        settings.ros_domain_id = settings.ros_domain_id.or(ros_domain_id);
        Self::from_settings(settings).map_err(|error| match error {
            ConfigError::Invalid { origin: key, reason } => {
                let variable =
                    format!("{VARIABLE_PREFIX}{}", key.replace('.', "_").to_ascii_uppercase());
                let in_file = || format!("{key} in {}", path.display());
                ConfigError::Invalid {
                    origin: given.take(&variable).unwrap_or_else(in_file),
                    reason,
                }
            }
            other => other,
        })
    }

    fn from_settings(settings: Settings) -> Result<Self, ConfigError> {
        let limits = settings.limits.unwrap_or_default();
        let logs = settings.logs.unwrap_or_default();
        let forward = ForwardSettings {
            level: logs.forward_level.unwrap_or(LogLevel::Warn),
            lines_per_s: logs.forward_lines_per_s.unwrap_or(10),
        };
        let config = Self {
            server: settings.server.as_deref().map(parse_server).transpose()?,
            mqtt: settings.mqtt.unwrap_or(true),
            mqtt_transport: settings.mqtt_transport.unwrap_or_default(),
            name: settings.name,
            labels: settings.labels,
            underlays: settings.underlays.unwrap_or_default(),
            workspace: settings.workspace,
            server_underlays: settings.server_underlays.unwrap_or(false),
            ros_domain_id: settings.ros_domain_id,
            poll_interval: Duration::from_secs(settings.poll_interval_s.unwrap_or(300)),
            poll_interval_without_mqtt: Duration::from_secs(
                settings.poll_interval_without_mqtt_s.unwrap_or(10),
            ),
            token_lifetime: Duration::from_secs(settings.token_lifetime_s.unwrap_or(30 * 86_400)),
            vitals_interval: Duration::from_secs(settings.vitals_interval_s.unwrap_or(60)),
            parallel_tasks: limits.parallel_tasks.map_or(2, count),
            task_user: settings.task_user,
            seccomp: settings.seccomp,
            task_uids: task_uids(settings.task_uids.as_deref().unwrap_or(DEFAULT_TASK_UIDS))?,
            task_pids: limits.task_pids.unwrap_or(4096),
            limits,
            gate: settings.gate.map(gate).transpose()?,
            trust: settings.trusted_publishers.map(trust).transpose()?,
            forward,
            own_forward_level: logs.forward_level,
        };
        let bounds = [
            (
                "ros_domain_id",
                u64::from(config.ros_domain_id.unwrap_or(0)),
                0,
                u64::from(MAX_ROS_DOMAIN_ID),
            ),
            ("poll_interval_s", config.poll_interval.as_secs(), 1, 86_400),
            (
                "poll_interval_without_mqtt_s",
                config.poll_interval_without_mqtt.as_secs(),
                1,
                86_400,
            ),
            ("token_lifetime_s", config.token_lifetime.as_secs(), 3600, 3650 * 86_400),
            ("vitals_interval_s", config.vitals_interval.as_secs(), 0, 86_400),
            (
                "gate.timeout_s",
                config.gate.as_ref().map_or(1, |gate| gate.timeout.as_secs()),
                1,
                MAX_GATE_TIMEOUT_S,
            ),
            ("logs.forward_lines_per_s", u64::from(config.forward.lines_per_s), 0, 1000),
        ];
        if config.workspace.as_deref().is_some_and(|workspace| !workspace.is_absolute()) {
            let reason = "needs an absolute path".to_owned();
            return Err(ConfigError::Invalid { origin: "workspace".to_owned(), reason });
        }
        let limits = config.limits.bounds().into_iter();
        let limits =
            limits.filter_map(|(key, value, least, most)| Some((key, value?, least, most)));
        for (key, value, least, most) in bounds.into_iter().chain(limits) {
            if value < least || value > most {
                let reason = format!("{value} is not between {least} and {most}");
                return Err(ConfigError::Invalid { origin: key.to_owned(), reason });
            }
        }
        Ok(config)
    }
}

fn parse_ros_domain_id(value: &str) -> Result<u32, ConfigError> {
    let id = value.trim().parse().ok().filter(|id| *id <= MAX_ROS_DOMAIN_ID);
    id.ok_or_else(|| ConfigError::Invalid {
        origin: ROS_DOMAIN_ID.to_owned(),
        reason: format!("{value:?} is not a number from 0 to {MAX_ROS_DOMAIN_ID}"),
    })
}

/// Parses a range of user ids, `FIRST-LAST`, or `none`.
fn task_uids(text: &str) -> Result<Option<RangeInclusive<u32>>, ConfigError> {
    if text.trim() == "none" {
        return Ok(None);
    }
    let ends =
        text.split_once('-').map(|(first, last)| (first.trim().parse(), last.trim().parse()));
    let range = ends.and_then(|(first, last)| Some(first.ok()?..=last.ok()?));
    let is_usable = |range: &RangeInclusive<u32>| {
        let (first, last) = (*range.start(), *range.end());
        // 65534 is the user `nobody`, and the highest ids of 16 and of 32 bits are invalid.
        let reserved = [65_534, 65_535, u32::MAX - 1, u32::MAX];
        first >= MIN_TASK_UID && last > first && reserved.iter().all(|id| !range.contains(id))
    };
    range.filter(is_usable).map(Some).ok_or_else(|| ConfigError::Invalid {
        origin: "task_uids".to_owned(),
        reason: format!(
            "{text:?} is neither \"none\" nor a range of user ids like {DEFAULT_TASK_UIDS:?}, two at least, from \
             {MIN_TASK_UID} on, without 65534 and 65535"
        ),
    })
}

fn gate(settings: GateSettings) -> Result<GateConfig, ConfigError> {
    let command = settings.command.unwrap_or_default();
    if command.first().is_none_or(|program| !program.starts_with('/')) {
        let reason = "needs a program by its absolute path".to_owned();
        return Err(ConfigError::Invalid { origin: "gate.command".to_owned(), reason });
    }
    let timeout = Duration::from_secs(settings.timeout_s.unwrap_or(10));
    Ok(GateConfig { command, timeout, default: settings.default.unwrap_or_default() })
}

fn trust(settings: PublisherSettings) -> Result<TrustSettings, ConfigError> {
    let role = |key: &str, keys: Vec<PublicKey>, threshold: u32| {
        let invalid = |error: InvalidRole| {
            let key = if matches!(error, InvalidRole::Threshold { .. }) {
                format!("{key}threshold")
            } else {
                format!("{key}keys")
            };
            ConfigError::Invalid {
                origin: format!("trusted_publishers.{key}"),
                reason: error.to_string(),
            }
        };
        Role::new(keys, threshold).map_err(invalid)
    };
    let publishers = role("", settings.keys.unwrap_or_default(), settings.threshold.unwrap_or(1))?;
    let keepers = match (settings.keeper_keys, settings.keeper_threshold) {
        (None, None) => publishers.clone(),
        (keys, threshold) => role("keeper_", keys.unwrap_or_default(), threshold.unwrap_or(1))?,
    };
    Ok(TrustSettings { publishers, keepers, requires_list: settings.require_list.unwrap_or(false) })
}

/// Parses a server's URL as users write one.
pub fn parse_server(text: &str) -> Result<reqwest::Url, ConfigError> {
    let fault = |reason: String| ConfigError::Invalid { origin: "server".to_owned(), reason };
    let is_servers =
        |url: &reqwest::Url| matches!(url.scheme(), "http" | "https") && url.host_str().is_some();
    let url = text.parse().ok().filter(is_servers);
    url.ok_or_else(|| fault(format!("{text:?} is not a server URL such as https://server:8080")))
}

/// Stores one variable's value under its key: `TASK_AGENT_LIMITS_LOG_BYTES` is `limits.log_bytes`.
fn override_by(table: &mut Table, name: &str, text: &str) -> Result<(), ConfigError> {
    let key = name[VARIABLE_PREFIX.len()..].to_ascii_lowercase();
    let value = match key.as_str() {
        "server" | "name" | "task_user" | "task_uids" | "seccomp" | "mqtt_transport"
        | "workspace" => Value::String(text.to_owned()),
        "gate_command" => Value::Array(vec![Value::String(text.to_owned())]),
        "trusted_publishers_keys" | "trusted_publishers_keeper_keys" => {
            let keys = text.split(',').map(str::trim).filter(|key| !key.is_empty());
            Value::Array(keys.map(|key| Value::String(key.to_owned())).collect())
        }
        "underlays" => {
            let paths = text.split(':').filter(|path| !path.is_empty());
            Value::Array(paths.map(|path| Value::String(path.to_owned())).collect())
        }
        "labels" => {
            let pairs =
                text.split(',').filter(|pair| !pair.is_empty()).map(|pair| pair.split_once('='));
            let labels: Option<Table> = pairs
                .map(|pair| {
                    pair.map(|(key, value)| (key.to_owned(), Value::String(value.to_owned())))
                })
                .collect();
            let reason = "expected key=value,key=value".to_owned();
            Value::Table(
                labels.ok_or_else(|| ConfigError::Invalid { origin: name.to_owned(), reason })?,
            )
        }
        _ => scalar(text),
    };
    let nested = ["limits", "logs", "gate", "trusted_publishers"]
        .iter()
        .find_map(|outer| Some((*outer, key.strip_prefix(outer)?.strip_prefix('_')?)));
    match nested {
        Some((outer, inner)) => {
            if let Value::Table(table) =
                table.entry(outer).or_insert_with(|| Value::Table(Table::new()))
            {
                table.insert(inner.to_owned(), value);
            }
        }
        None => {
            table.insert(key, value);
        }
    }
    Ok(())
}

/// A number or a truth value where the text is one, else the text, which the key's type then
/// refuses by name.
fn scalar(text: &str) -> Value {
    let number = text.parse().map(Value::Integer).ok();
    number
        .or_else(|| text.parse().map(Value::Boolean).ok())
        .unwrap_or_else(|| Value::String(text.to_owned()))
}

fn read_table(path: &Path) -> Result<Table, ConfigError> {
    match std::fs::read_to_string(path) {
        Ok(text) => {
            text.parse::<Table>().map_err(|error| invalid(&path.display().to_string(), &error))
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Table::new()),
        Err(source) => Err(ConfigError::Io { path: path.to_owned(), source }),
    }
}

fn deserialize(table: Table, origin: &str) -> Result<Settings, ConfigError> {
    table.try_into().map_err(|error: toml::de::Error| invalid(origin, &error))
}

fn invalid(origin: &str, error: &dyn std::fmt::Display) -> ConfigError {
    let lines: Vec<String> = error.to_string().trim_end().lines().map(in_file_terms).collect();
    ConfigError::Invalid { origin: origin.to_owned(), reason: lines.join("\n") }
}

#[cfg(test)]
mod tests {
    use std::os::unix::ffi::OsStringExt as _;

    use task_proto::trust::envelope::SigningKey;

    use super::*;

    fn load(file: &str, variables: &[(&str, &str)]) -> Result<Config, ConfigError> {
        let dir = tempfile::tempdir().expect("a directory");
        std::fs::write(dir.path().join(FILE_NAME), file).expect("written");
        let strange = (OsString::from("STRANGE"), OsString::from_vec(vec![0xff]));
        let variables = variables.iter().map(|(name, value)| (name.into(), value.into()));
        Config::load(dir.path(), variables.chain([strange]))
    }

    #[test]
    fn environment_beats_file_beats_defaults() {
        let file =
            "mqtt = true\nros_domain_id = 3\n[limits]\nlog_bytes = 5000\nbuild_timeout_s = 9\n";
        let variables = [
            ("TASK_AGENT_MQTT", "false"),
            ("TASK_AGENT_UNDERLAYS", "/opt/ros/jazzy/setup.bash:/ws/install/setup.bash"),
            ("TASK_AGENT_LABELS", "site=lab,base=turtlebot"),
            ("TASK_AGENT_LIMITS_LOG_BYTES", "7000"),
            ("TASK_AGENT_LOGS_FORWARD_LEVEL", "error"),
            ("TASK_AGENT_DATA", "/elsewhere"),
            ("PATH", "/bin"),
        ];
        let config = load(file, &variables).expect("valid");
        assert_eq!((config.mqtt, config.ros_domain_id), (false, Some(3)));
        assert_eq!((config.limits.log_bytes, config.limits.build_timeout_s), (Some(7000), Some(9)));
        assert_eq!(config.forward, ForwardSettings { level: LogLevel::Error, lines_per_s: 10 });
        assert_eq!(config.underlays.len(), 2);
        assert_eq!(config.labels.expect("given").len(), 2);
        assert_eq!(config.poll_interval, Duration::from_secs(300));
    }

    #[test]
    fn ros_domain_id_setting_overrides_the_environment() {
        let domain = |file: &str, variables: &[(&str, &str)]| {
            load(file, variables).expect("valid").ros_domain_id
        };
        assert_eq!(domain("", &[("ROS_DOMAIN_ID", "7")]), Some(7));
        assert_eq!(domain("ros_domain_id = 3\n", &[("ROS_DOMAIN_ID", "7")]), Some(3));
        assert_eq!(
            domain("", &[("TASK_AGENT_ROS_DOMAIN_ID", "0"), ("ROS_DOMAIN_ID", "7")]),
            Some(0)
        );
        assert_eq!(domain("", &[("ROS_DOMAIN_ID", "")]), None);
    }

    #[test]
    fn invalid_settings_are_named() {
        let text = |file: &str, variables: &[(&str, &str)]| {
            load(file, variables).expect_err("refused").to_string()
        };
        assert!(text("mqt = true\n", &[]).contains("mqt"));
        assert!(text("[limits]\nlogs = 1\n", &[]).contains("logs"));
        assert!(text("", &[("TASK_AGENT_MQT", "true")]).contains("TASK_AGENT_MQT"));
        assert!(text("", &[("TASK_AGENT_MQTT", "perhaps")]).contains("TASK_AGENT_MQTT"));
        assert!(text("server = \"ftp://x\"\n", &[]).contains("server"));
        assert!(text("ros_domain_id = 400\n", &[]).contains("ros_domain_id"));
        assert!(text("", &[("ROS_DOMAIN_ID", "233")]).contains("ROS_DOMAIN_ID: \"233\""));
        assert!(text("poll_interval_s = 0\n", &[]).contains("poll_interval_s"));
        let low = text("[limits]\nlog_bytes = 1\n", &[]);
        assert!(
            low.starts_with("limits.log_bytes in /")
                && low.contains("agent.toml: 1 is not between 4096 and "),
            "{low}"
        );
        let variable = "TASK_AGENT_LIMITS_PARALLEL_TASKS";
        assert!(
            text("", &[(variable, "65")])
                .starts_with("TASK_AGENT_LIMITS_PARALLEL_TASKS: 65 is not between")
        );
        let typed = text("poll_interval_s = \"soon\"\n", &[]);
        assert!(typed.contains("expected a whole number\nin `poll_interval_s`"), "{typed}");
        assert!(
            text("server = \"foo\"\n", &[])
                .contains("agent.toml: \"foo\" is not a server URL such as https://")
        );
        assert!(text("[logs]\nforward_level = \"loud\"\n", &[]).contains("forward_level"));
        let variable = "TASK_AGENT_LOGS_FORWARD_LINES_PER_S";
        assert!(
            text("", &[(variable, "100000")])
                .starts_with("TASK_AGENT_LOGS_FORWARD_LINES_PER_S: 100000 is not")
        );
    }

    #[test]
    fn task_uids_are_a_range_or_none() {
        let uids = |file: &str| load(file, &[]).map(|config| config.task_uids);
        assert_eq!(uids("").expect("valid"), Some(70_000..=79_999));
        assert_eq!(uids("task_uids = \"2000 - 2001\"\n").expect("valid"), Some(2000..=2001));
        assert_eq!(uids("task_uids = \"none\"\n").expect("valid"), None);
        let variable = load("", &[("TASK_AGENT_TASK_UIDS", "80000-80003")]).expect("valid");
        assert_eq!(variable.task_uids, Some(80_000..=80_003));
        for bad in [
            "",
            "70000",
            "70001-70000",
            "70000-70000",
            "500-600",
            "65000-66000",
            "70000-99999999999",
            "a-b",
        ] {
            let refused = uids(&format!("task_uids = {bad:?}\n")).expect_err(bad).to_string();
            assert!(
                refused.starts_with("task_uids in /") && refused.contains("70000-79999"),
                "{refused}"
            );
        }
    }

    #[test]
    fn every_setting_is_documented() {
        let table = include_str!("../../../docs/agent.md");
        let missing = load("unknown = 1\n", &[]).expect_err("refused").to_string();
        let (_, keys) = missing.split_once("expected one of ").expect("all are named");
        let keys = keys
            .lines()
            .next()
            .unwrap_or_default()
            .split(", ")
            .map(|key| key.trim_matches('`').to_owned());
        let limits = RobotLimits::default()
            .bounds()
            .map(|(key, ..)| key.trim_start_matches("limits.").to_owned());
        let mut count = 0;
        for key in keys.chain(limits) {
            assert!(
                table.contains(&format!("`{key}`")) || table.contains(&format!("`[{key}]`")),
                "{key}"
            );
            count += 1;
        }
        assert!(count > 20, "{missing}");
    }

    #[test]
    fn gate_is_a_program_by_its_absolute_path() {
        assert_eq!(load("", &[]).expect("valid").gate, None);
        let file = "[gate]\ncommand = [\"/opt/gate\", \"--battery\"]\ndefault = \"allow\"\n";
        let gate =
            load(file, &[("TASK_AGENT_GATE_TIMEOUT_S", "3")]).expect("valid").gate.expect("one");
        assert_eq!(
            (gate.command.len(), gate.timeout.as_secs(), gate.default),
            (2, 3, GateDefault::Allow)
        );
        let gate = load("", &[("TASK_AGENT_GATE_COMMAND", "/opt/gate")])
            .expect("valid")
            .gate
            .expect("one");
        assert_eq!((gate.timeout.as_secs(), gate.default), (10, GateDefault::Deny));
        let text = |file: &str| load(file, &[]).expect_err("refused").to_string();
        assert!(text("[gate]\ncommand = [\"gate\"]\n").contains("gate.command"));
        assert!(text("[gate]\ntimeout_s = 5\n").contains("gate.command"));
        assert!(text("[gate]\ncommand = [\"/g\"]\ntimeout_s = 301\n").contains("gate.timeout_s"));
        assert!(text("[gate]\ncommand = [\"/g\"]\ndefault = \"maybe\"\n").contains("maybe"));
    }

    #[test]
    fn trusted_publishers_have_keys_and_thresholds() {
        assert_eq!(load("", &[]).expect("valid").trust, None);
        let keys: Vec<String> = [1, 2, 3]
            .map(|seed| SigningKey::from_bytes([seed; 32]).public_key().to_string())
            .into();
        let table = |rest: &str| format!("[trusted_publishers]\nkeys = {:?}\n{rest}", &keys[..2]);
        let trust = load(&table("threshold = 2\n"), &[]).expect("valid").trust.expect("given");
        assert_eq!((trust.publishers.keys().len(), trust.publishers.threshold()), (2, 2));
        assert_eq!((trust.keepers, trust.requires_list), (trust.publishers, false));
        let joined = keys[..2].join(",");
        let one = keys[2].as_str();
        let variables = [
            ("TASK_AGENT_TRUSTED_PUBLISHERS_KEYS", joined.as_str()),
            ("TASK_AGENT_TRUSTED_PUBLISHERS_KEEPER_KEYS", one),
            ("TASK_AGENT_TRUSTED_PUBLISHERS_REQUIRE_LIST", "true"),
        ];
        let trust = load("", &variables).expect("valid").trust.expect("given");
        assert_eq!(
            (trust.publishers.threshold(), trust.keepers.keys().len(), trust.requires_list),
            (1, 1, true)
        );
        let text = |file: &str| load(file, &[]).expect_err("refused").to_string();
        for (file, key, reason) in [
            ("[trusted_publishers]\n", "keys", "0 keys"),
            (&table("threshold = 3\n"), "threshold", "a threshold of 3"),
            (&table("keeper_threshold = 1\n"), "keeper_keys", "0 keys"),
        ] {
            let text = text(file);
            assert!(
                text.starts_with(&format!("trusted_publishers.{key} in ")) && text.contains(reason),
                "{text}"
            );
        }
        assert!(
            text("[trusted_publishers]\nkeys = [\"ssh-ed25519 AAAA\"]\n")
                .contains("not an ed25519 public key")
        );
        assert!(text(&table("treshold = 1\n")).contains("treshold"));
    }

    #[test]
    fn written_file_reads_back() {
        let dir = tempfile::tempdir().expect("a directory");
        let publishers = PublisherSettings {
            keys: Some(vec![SigningKey::from_bytes([1; 32]).public_key()]),
            ..Default::default()
        };
        let settings = Settings {
            trusted_publishers: Some(publishers),
            server: Some("http://server:8080".to_owned()),
            name: Some("atlas".parse().expect("valid")),
            labels: Some([("site".parse().expect("valid"), "lab".parse().expect("valid"))].into()),
            ..Settings::default()
        };
        settings.write(dir.path()).expect("written");
        assert_eq!(Settings::read(dir.path()).expect("read"), settings);
    }
}
