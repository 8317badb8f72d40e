//! `task-agent doctor`: checks for common problems on a robot and between the robot and its server,
//! and suggests fixes. The command changes nothing, and does not disturb a running agent.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use jiff::fmt::rfc2822::DateTimeParser;
use nix::sys::resource::{Resource, getrlimit};
use nix::unistd::{AccessFlags, access};
use reqwest::Url;
use rustls::ClientConfig;
use task_proto::api::{BrokerAddress, MqttEndpoint};
use task_proto::checkup::{Checkup, Verdict};
use task_proto::error_chain::chain;
use task_proto::size::format_bytes;
use task_proto::time::span;
use task_transport::{ProbeResult, Route, Trust, certificate_end_ms, probe_mqtt};
use tokio::time::timeout;

use super::status::agent_runs;
use super::{DataDir, Output, refuse_plain_text, say, tls};
use crate::config::settings::merge_settings;
use crate::config::{Config, ConfigError, MqttTransport, parse_server};
use crate::install::fetch::FetchSettings;
use crate::process::call_filter::{self, CallFilter};
use crate::process::cgroup::{self, Capability};
use crate::reconcile::admission;
use crate::setup::installation::{Installation, all_distros};
use crate::setup::underlay::{self, UnderlayError};
use crate::system::clock;
use crate::system::disk::{self, DiskSpace};
use crate::system::identity::Identity;
use crate::system::layout::DataDir as Layout;
use crate::system::task_user::{TaskUser, TaskUserError};
use crate::task::ledger::Ledger;
use crate::transfer::credential::Credential;
use crate::transfer::server::{self, Server, ServerError};

/// Maximum time for each answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// A clock error above this limit confuses readers of logs.
const SKEW_NOTICE_S: u64 = 10;
/// With a clock error above this limit, signed orders and certificates expire at wrong times.
const SKEW_BAD_S: u64 = 60 * 60;
/// A certificate that expires within this time is reported.
const SOON_MS: u64 = 14 * 24 * 60 * 60 * 1000;
/// Number of open files that a robot with many tasks needs.
const WANTED_FILES: u64 = 1024;

#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Output format
    #[arg(short, long, value_enum, default_value_t = Output::Table, value_name = "FORMAT")]
    output: Output,
    #[command(flatten)]
    data: DataDir,
}

/// Runs all checks; fails when one of them has a bad result.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let checkup = runtime.block_on(check(&arguments.data.data))?;
    // A name that is being resolved on another thread is not waited for.
    runtime.shutdown_background();
    match arguments.output {
        Output::Json => say(format_args!("{}", serde_json::to_string_pretty(&checkup)?)),
        Output::Table => say(format_args!(
            "{}",
            checkup.text(|verdict: Verdict| verdict.sign().to_string()).trim_end()
        )),
    }
    Ok(if checkup.is_healthy() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

async fn check(data: &Path) -> anyhow::Result<Checkup> {
    let mut checkup = Checkup::default();
    let mut config = settings(&mut checkup, data);
    if let Some((layout, identity)) = directory(&mut checkup, data) {
        let base = match config.as_ref().and_then(|config| config.server.clone()) {
            Some(server) => Ok(server),
            None => parse_server(&identity.server),
        };
        let base = base.map_err(anyhow::Error::new).and_then(|base| {
            refuse_plain_text(identity.ca_pin, &base, "server")?;
            Ok(base)
        });
        match base {
            Ok(base) => server(&mut checkup, &identity, &base, config.as_ref()).await?,
            Err(error) => {
                let mend = "fix server in agent.toml, or enroll again (task-agent enroll)";
                checkup.bad("server", error.to_string(), mend);
            }
        }
        config = config.map(|own| effective_config(&own, &layout, &identity));
    }
    machine(&mut checkup, data, config.as_ref());
    if let Some(config) = &config {
        ros(&mut checkup, config);
        tasks(&mut checkup, data, config);
    }
    Ok(checkup)
}

fn settings(checkup: &mut Checkup, data: &Path) -> Option<Config> {
    match Config::load(data, std::env::vars_os()) {
        Ok(config) => {
            checkup.good("settings", "can be used");
            Some(config)
        }
        Err(error) => {
            let mend = match &error {
                ConfigError::Io { .. } => "run as the agent's user",
                ConfigError::Invalid { .. } => "fix this key in agent.toml or the environment",
            };
            checkup.bad("settings", chain(&error), mend);
            None
        }
    }
}

/// The effective settings: the robot's `own`, and the last ones from its server.
fn effective_config(own: &Config, layout: &Layout, identity: &Identity) -> Config {
    let accepted = Ledger::peek(&layout.ledger()).ok().flatten().and_then(|ledger| ledger.accepted);
    let state = accepted.and_then(|accepted| {
        // A state that this server did not sign is ignored, as in the agent.
        admission::open(&accepted.envelope, &identity.server_key, &identity.robot_id).ok()
    });
    state.map_or_else(|| own.clone(), |state| merge_settings(own, &state.settings).config)
}

/// Checks the data directory, the robot's identity, and whether the agent runs.
fn directory(checkup: &mut Checkup, data: &Path) -> Option<(Layout, Identity)> {
    let flags = AccessFlags::R_OK | AccessFlags::W_OK | AccessFlags::X_OK;
    match access(data, flags) {
        Ok(()) => checkup.good("data", format!("{} can be written", data.display())),
        Err(error) => {
            let mend = "run as the agent's user (usually root), or set the directory (--data)";
            checkup.bad("data", format!("{}: {}", data.display(), error.desc()), mend);
            return None;
        }
    }
    let layout = match Layout::new(data) {
        Ok(layout) => layout,
        Err(error) => {
            checkup.bad("data", error.to_string(), "set the directory (--data)");
            return None;
        }
    };
    let identity = match Identity::read(&layout.identity()) {
        Ok(identity) => identity,
        Err(error) => {
            let mend = "enroll: task-agent enroll --server URL --token TOKEN \
                        (create a token with taskd enroll-token create)";
            checkup.bad("identity", chain(&error), mend);
            return None;
        }
    };
    checkup.good("identity", format!("{} ({})", identity.robot_id, identity.mac));
    match agent_runs(&layout) {
        true => checkup.good("agent", "runs"),
        false => checkup.bad(
            "agent",
            "does not run",
            "start it: systemctl start task-agent, or task-agent run",
        ),
    }
    Some((layout, identity))
}

async fn server(
    checkup: &mut Checkup,
    identity: &Identity,
    base: &Url,
    config: Option<&Config>,
) -> anyhow::Result<()> {
    let (host, port) =
        (base.host_str().unwrap_or_default(), base.port_or_known_default().unwrap_or_default());
    let bare = host.trim_matches(['[', ']']);
    match timeout(ANSWER_TIMEOUT, tokio::net::lookup_host((bare, port))).await {
        Ok(Ok(_)) => checkup.good("dns", format!("{bare} resolves")),
        Ok(Err(error)) => {
            checkup.bad(
                "dns",
                format!("{bare}: {error}"),
                "check the network, /etc/resolv.conf and /etc/hosts",
            );
            return Ok(());
        }
        Err(_) => {
            checkup.bad(
                "dns",
                format!("{bare} did not resolve within 5 s"),
                "check the network and /etc/resolv.conf",
            );
            return Ok(());
        }
    }
    let tls = tls(identity.ca_pin, identity.client_key.as_ref())?;
    let client = server::client(tls.clone())?;
    if !reach(checkup, &client, base).await {
        return Ok(());
    }
    if base.scheme() == "https" {
        certificate(checkup, bare, port, identity).await;
    }
    let credential = Credential::from(identity.token.clone());
    let endpoint =
        token(checkup, &Server::new(client, base.clone(), identity.robot_id.clone(), credential))
            .await;
    match config {
        Some(config) if !config.mqtt => checkup.good("mqtt", "disabled: the robot polls"),
        config => {
            let transport = config.map(|config| config.mqtt_transport).unwrap_or_default();
            // As in the agent: the address from the enrollment, until the server names another one.
            mqtt(
                checkup,
                base,
                Arc::new(tls),
                endpoint.as_ref().unwrap_or(&identity.mqtt),
                transport,
            )
            .await;
        }
    }
    Ok(())
}

/// Checks the routes that a session may take.
async fn mqtt(
    checkup: &mut Checkup,
    base: &Url,
    tls: Arc<ClientConfig>,
    mqtt: &MqttEndpoint,
    transport: MqttTransport,
) {
    let host = base.host_str().unwrap_or_default().to_owned();
    let has_websocket = mqtt.external.is_none() && transport != MqttTransport::Tcp;
    // An external broker has nothing but its port.
    let has_port = mqtt.external.is_some() || transport != MqttTransport::Websocket;
    let mqtt_tls = |is_encrypted| match (&mqtt.external, is_encrypted) {
        (_, false) => None,
        (None, true) => Some(tls.clone()),
        (Some(broker), true) => {
            Some(Arc::new(Trust::by(broker.ca_pin).client_config(clock::for_certificates())))
        }
    };
    let by_port = |place: &BrokerAddress| Route {
        host: place.host.clone().unwrap_or_else(|| base.host_str().unwrap_or_default().to_owned()),
        port: place.port,
        tls: mqtt_tls(place.tls),
        websocket: None,
    };
    let first = BrokerAddress { host: mqtt.host.clone(), port: mqtt.port, tls: mqtt.tls };
    let by_http = Route {
        host,
        port: base.port_or_known_default().unwrap_or_default(),
        tls: (base.scheme() == "https").then(|| tls.clone()),
        websocket: Some(format!("{}/mqtt", base.path().trim_end_matches('/'))),
    };
    let mut is_reached = has_port && greet(checkup, "mqtt", &by_port(&first), has_websocket).await;
    for place in &mqtt.alternatives {
        is_reached |= greet(checkup, "mqtt", &by_port(place), is_reached).await;
    }
    if has_websocket {
        greet(checkup, "websocket", &by_http, is_reached).await;
    }
}

/// Checks the server's first answer, and the clock by the answer's date.
async fn reach(checkup: &mut Checkup, client: &reqwest::Client, base: &Url) -> bool {
    let url = format!("{}/healthz", base.as_str().trim_end_matches('/'));
    let response = match client.get(url).timeout(ANSWER_TIMEOUT).send().await {
        Ok(response) if response.status().is_success() => response,
        Ok(response) => {
            let found = format!("{base} is not taskd (status {})", response.status().as_u16());
            let mend = "check for a captive portal or proxy, and check server in agent.toml";
            checkup.bad("http", found, mend);
            return false;
        }
        Err(error) => {
            let mend = "check the network, server in agent.toml, \
                        and that taskd serve is running and reachable";
            checkup.bad("http", chain(&error.without_url()), mend);
            return false;
        }
    };
    checkup.good("http", format!("{base} answers"));
    let date = response
        .headers()
        .get(reqwest::header::DATE)
        .and_then(|date| date.to_str().ok())
        .and_then(parse_date);
    let Some(server_s) = date else { return true };
    let here_s = clock::wall_ms() / 1000;
    let found = || {
        let way = if server_s > here_s { "behind" } else { "ahead of" };
        format!(
            "this robot's clock is {} {way} the server's",
            span(Duration::from_secs(server_s.abs_diff(here_s)))
        )
    };
    let mend = "enable NTP (timedatectl set-ntp true); \
                without a battery-backed clock, install fake-hwclock";
    match server_s.abs_diff(here_s) {
        ..SKEW_NOTICE_S => checkup.good("clock", "matches the server's"),
        SKEW_NOTICE_S..SKEW_BAD_S => checkup.notice("clock", found(), mend),
        _ => checkup.bad("clock", found(), mend),
    }
    true
}

async fn certificate(checkup: &mut Checkup, host: &str, port: u16, identity: &Identity) {
    let trust = Trust::by(identity.ca_pin);
    let end_ms =
        timeout(ANSWER_TIMEOUT, certificate_end_ms(host, port, trust)).await.ok().flatten();
    let by = if identity.ca_pin.is_some() { "by the pinned CA" } else { "by the system's CAs" };
    match end_ms {
        Some(end_ms) if end_ms < clock::wall_ms() + SOON_MS => checkup.notice(
            "tls",
            format!("the server's certificate expires {}", task_proto::time::timestamp(end_ms)),
            "ask the server's administrator to renew it",
        ),
        Some(end_ms) => {
            checkup.good(
                "tls",
                format!("trusted {by}, until {}", task_proto::time::timestamp(end_ms)),
            );
        }
        None => checkup.good("tls", format!("trusted {by}")),
    }
}

/// Checks whether the server accepts the token, and returns the address of MQTT from the server.
async fn token(checkup: &mut Checkup, server: &Server) -> Option<MqttEndpoint> {
    match timeout(ANSWER_TIMEOUT, server.mqtt_endpoint()).await {
        Ok(Ok(endpoint)) => {
            checkup.good("token", "accepted by the server");
            return Some(endpoint);
        }
        Ok(Err(error)) => {
            let mend = match &error {
                ServerError::TokenRefused(_) => {
                    "enroll again with a token for this robot \
                     (taskd enroll-token create --robot NAME)"
                }
                ServerError::Refused { code, .. } if code == task_proto::api::AWAITS_APPROVAL => {
                    "ask an administrator to approve the robot (taskd robot approve)"
                }
                _ => "check the server (run taskd doctor there)",
            };
            checkup.bad("token", chain(&error), mend);
        }
        Err(_) => checkup.bad(
            "token",
            "the server did not answer within 5 s",
            "check the server (run taskd doctor there)",
        ),
    }
    None
}

/// Checks whether MQTT is spoken at the route's address. One of two routes is enough.
async fn greet(checkup: &mut Checkup, name: &str, route: &Route, has_other: bool) -> bool {
    let at = format!("{}:{}", route.host, route.port);
    let found = match timeout(ANSWER_TIMEOUT, probe_mqtt(route)).await {
        Ok(Ok(ProbeResult::Mqtt)) => {
            checkup.good(name, format!("{at} answers"));
            return true;
        }
        Ok(Ok(ProbeResult::Other)) => format!("{at} does not speak MQTT"),
        Ok(Err(error)) => chain(&error),
        Err(_) => format!("{at} did not answer within 5 s"),
    };
    let mend =
        "check firewalls and proxies; without MQTT the robot polls (mqtt_transport in agent.toml)";
    match has_other {
        true => checkup.notice(name, found, mend),
        false => checkup.bad(name, found, mend),
    }
    false
}

fn free_space(room: &DiskSpace) -> String {
    format!("{} of {} free", format_bytes(room.free), format_bytes(room.total))
}

fn machine(checkup: &mut Checkup, data: &Path, config: Option<&Config>) {
    let reserve = config
        .and_then(|config| config.limits.disk_reserve_bytes)
        .unwrap_or(FetchSettings::default().reserve_bytes);
    match disk::space(data) {
        Ok(room) if room.free < reserve => {
            let found = free_space(&room);
            let mend = "free disk space: logs, recordings, unused packages \
                        (limits.disk_reserve_bytes stays free)";
            if room.is_full() {
                checkup.bad("disk", found, mend)
            } else {
                checkup.notice("disk", found, mend)
            }
        }
        Ok(room) => checkup.good("disk", free_space(&room)),
        Err(error) => {
            checkup.bad("disk", format!("{}: {error}", data.display()), "check the file system")
        }
    }
    match getrlimit(Resource::RLIMIT_NOFILE) {
        Ok((files, _)) if files < WANTED_FILES => checkup.notice(
            "files",
            format!("an agent started from here may open {files} files"),
            "raise the limit (LimitNOFILE= in the agent's unit, or ulimit -n)",
        ),
        Ok((files, _)) => {
            checkup.good("files", format!("an agent started from here may open {files} files"))
        }
        Err(error) => checkup.notice("files", error.desc(), "check ulimit -n"),
    }
}

fn ros(checkup: &mut Checkup, config: &Config) {
    let found = underlay::by_settings(&config.underlays, config.workspace.as_deref());
    let missing = found.iter().flat_map(|found| &found.setups).find(|setup| !setup.is_file());
    let setups: Vec<String> =
        found.iter().flat_map(|f| &f.setups).map(|setup| setup.display().to_string()).collect();
    match (missing, all_distros(&found)) {
        (Some(missing), _) => {
            let mend = "fix underlays and workspace in agent.toml or on the server";
            checkup.bad("ros", UnderlayError::Missing(missing.clone()).to_string(), mend);
        }
        (None, distros) if distros.is_empty() && setups.is_empty() => checkup.notice(
            "ros",
            "none found in /opt/ros",
            "install ROS, or set underlays in agent.toml to its setup file; \
             tasks without ROS do not need it",
        ),
        (None, distros) if setups.is_empty() => {
            checkup.good("ros", format!("{}, without a setup file", distros.join(", ")))
        }
        (None, distros) => {
            checkup.good("ros", format!("{}: {}", distros.join(", "), setups.join(", ")))
        }
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut places: Vec<PathBuf> = std::env::split_paths(&path).collect();
    places.extend(found.iter().flat_map(own_programs));
    let tools: Vec<&str> = ["colcon", "catkin_make"]
        .into_iter()
        .filter(|tool| places.iter().any(|place| place.join(tool).is_file()))
        .collect();
    match tools.is_empty() {
        true => checkup.notice(
            "build",
            "neither colcon nor catkin_make was found",
            "install colcon (python3-colcon-common-extensions); \
             packages built elsewhere do not need it",
        ),
        false => checkup.good("build", tools.join(", ")),
    }
}

/// Directories of an installation's programs: beside its setup file, as in a virtual environment,
/// or in `bin`.
fn own_programs(installation: &Installation) -> Vec<PathBuf> {
    let dirs = installation.setups.iter().filter_map(|setup| setup.parent());
    dirs.flat_map(|dir| [dir.to_owned(), dir.join("bin")]).collect()
}

/// Checks the environment and the account of tasks.
fn tasks(checkup: &mut Checkup, data: &Path, config: &Config) {
    let mend = "tasks run, but limits are not enforced; use a kernel with cgroup v2 \
                and let systemd delegate (Delegate=yes in the agent's unit)";
    match cgroup::capability() {
        Capability::Isolates => checkup.good("cgroups", "v2, with memory and pids"),
        Capability::Counts => {
            checkup.notice("cgroups", "v2, without the controllers memory and pids", mend)
        }
        Capability::Nothing => checkup.notice("cgroups", "no cgroup v2", mend),
    }
    let found = TaskUser::find(config.task_user.as_deref());
    let user = found.and_then(|user| user.map(|user| user.check_access(data)).transpose());
    match &user {
        Ok(Some(user)) => checkup.good(
            "task user",
            match &config.task_uids {
                Some(range) => {
                    let (first, last) = (range.start(), range.end());
                    format!(
                        "each task has its own account, {first} to {last}, with the groups of {}",
                        user.name
                    )
                }
                None => format!("all tasks run as {}", user.name),
            },
        ),
        Ok(None) => checkup.good(
            "task user",
            "tasks run as the agent's user \
             and are not isolated from each other's files and processes",
        ),
        Err(error @ TaskUserError::NoAccess { dir, .. }) => {
            let mend = format!("chmod o+x {}, or move the data directory", dir.display());
            checkup.bad("task user", error.to_string(), mend);
        }
        Err(error) => {
            let mend = "create the user, or set task_user in agent.toml";
            checkup.bad("task user", error.to_string(), mend);
        }
    }
    let has_account = !matches!(&user, Ok(None));
    match (call_filter::is_wanted(config.seccomp, has_account), CallFilter::of_tasks()) {
        (true, Some(_)) => checkup
            .good("seccomp", "tasks are denied system calls that only an administrator needs"),
        (true, None) => {
            let found = "this kernel or architecture does not support system call filters";
            let mend = "use a kernel with CONFIG_SECCOMP_FILTER on x86_64, aarch64 or armv7, \
                        or set seccomp = \"off\"";
            checkup.notice("seccomp", found, mend);
        }
        (false, _) => checkup.notice(
            "seccomp",
            "tasks may make all system calls",
            "set seccomp = \"default\" in agent.toml, \
             or run the agent as root and tasks under their own accounts",
        ),
    }
}

/// Parses an HTTP date, like `Sun, 06 Nov 1994 08:49:37 GMT`, to seconds since the Unix epoch.
fn parse_date(text: &str) -> Option<u64> {
    let date = DateTimeParser::new().parse_timestamp(text).ok()?;
    u64::try_from(date.as_second()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn http_dates_are_parsed() {
        assert_eq!(parse_date("Thu, 01 Jan 1970 00:00:00 GMT"), Some(0));
        assert_eq!(parse_date("Sun, 06 Nov 1994 08:49:37 GMT"), Some(784_111_777));
        assert_eq!(parse_date("Tue, 29 Feb 2000 00:00:00 GMT"), Some(951_782_400));
        for bad in [
            "",
            "Sunday, 06-Nov-94 08:49:37 GMT",
            "Sun, 06 Nov 1994",
            "Sun, 99 Nov 1994 08:49:37 GMT",
        ] {
            assert_eq!(parse_date(bad), None, "{bad}");
        }
    }
}
