//! `task-agent doctor`: checks for common problems on a robot and between the robot and its server,
//! and suggests fixes. The command changes nothing, and does not disturb a running agent.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use nix::sys::resource::{Resource, getrlimit};
use nix::unistd::{AccessFlags, access};
use reqwest::Url;
use rustls::ClientConfig;
use task_proto::api::{MqttEndpoint, MqttPlace};
use task_proto::checkup::{Checkup, Verdict};
use task_proto::time::{parse_timestamp, span};
use task_transport::{Probed, Route, Trust, certificate_end_ms, greet_mqtt};
use tokio::time::timeout;

use super::status::agent_runs;
use super::{DataDir, Output, refuse_plain_text, say, tls};
use crate::config::settings::settle;
use crate::config::{Config, ConfigError, MqttTransport, parse_server};
use crate::install::fetch::FetchSettings;
use crate::process::call_filter::{self, CallFilter};
use crate::process::cgroup::{self, Outlook};
use crate::reconcile::admission;
use crate::setup::installation::{Installation, all_distros};
use crate::setup::underlay::{self, UnderlayError};
use crate::system::clock;
use crate::system::disk;
use crate::system::error_chain::chain;
use crate::system::identity::Identity;
use crate::system::layout::DataDir as Layout;
use crate::system::task_user::{TaskUser, TaskUserError};
use crate::task::ledger::Ledger;
use crate::transfer::credential::Credential;
use crate::transfer::server::{self, Server, ServerError};

/// Maximum time for each answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// A clock error above this limit confuses readers of logs.
const SKEW_NOTICE_S: u64 = 10;
/// With a clock error above this limit, signed orders and certificates expire at wrong times.
const SKEW_BAD_S: u64 = 60 * 60;
/// A certificate that expires within this time is reported.
const SOON_MS: u64 = 14 * 24 * 60 * 60 * 1000;
/// Number of open files that a robot with many tasks needs.
const WANTED_FILES: u64 = 1024;

/// Arguments of `doctor`.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// How to print the result
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
                let mend = "mend server in agent.toml, or enrol again (task-agent enroll)";
                checkup.bad("server", error.to_string(), mend);
            }
        }
        config = config.map(|own| settled(&own, &layout, &identity));
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
                ConfigError::Io { .. } => "run it as the agent's user",
                ConfigError::Invalid { .. } => {
                    "mend the key that it names, in agent.toml or the environment"
                }
            };
            checkup.bad("settings", chain(&error), mend);
            None
        }
    }
}

/// The effective settings: the robot's `own`, and the last ones from its server.
fn settled(own: &Config, layout: &Layout, identity: &Identity) -> Config {
    let accepted = Ledger::peek(&layout.ledger()).ok().flatten().and_then(|ledger| ledger.accepted);
    let state = accepted.and_then(|accepted| {
        // A state that this server did not sign is ignored, as in the agent.
        admission::open(&accepted.envelope, &identity.server_key, &identity.robot_id).ok()
    });
    state.map_or_else(|| own.clone(), |state| settle(own, &state.settings).config)
}

/// Checks the data directory, the robot's identity, and whether the agent runs.
fn directory(checkup: &mut Checkup, data: &Path) -> Option<(Layout, Identity)> {
    let flags = AccessFlags::R_OK | AccessFlags::W_OK | AccessFlags::X_OK;
    match access(data, flags) {
        Ok(()) => checkup.good("data", format!("{} can be written", data.display())),
        Err(error) => {
            let mend =
                "run it as the agent's user (root, mostly), or say where the directory is (--data)";
            checkup.bad("data", format!("{}: {}", data.display(), error.desc()), mend);
            return None;
        }
    }
    let layout = match Layout::new(data) {
        Ok(layout) => layout,
        Err(error) => {
            checkup.bad("data", error.to_string(), "say where the directory is (--data)");
            return None;
        }
    };
    let identity = match Identity::read(&layout.identity()) {
        Ok(identity) => identity,
        Err(error) => {
            let mend = "enrol: task-agent enroll --server URL --token TOKEN (taskd enroll-token create makes one)";
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
    match timeout(PATIENCE, tokio::net::lookup_host((bare, port))).await {
        Ok(Ok(_)) => checkup.good("dns", format!("{bare} is known")),
        Ok(Err(error)) => {
            checkup.bad(
                "dns",
                format!("{bare}: {error}"),
                "look at /etc/resolv.conf and /etc/hosts, and at the network",
            );
            return Ok(());
        }
        Err(_) => {
            checkup.bad(
                "dns",
                format!("{bare} is not resolved within 5 s"),
                "look at the network and at /etc/resolv.conf",
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
        Some(config) if !config.mqtt => checkup.good("mqtt", "is turned off: the robot polls"),
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
    let by_port = |place: &MqttPlace| Route {
        host: place.host.clone().unwrap_or_else(|| base.host_str().unwrap_or_default().to_owned()),
        port: place.port,
        tls: mqtt_tls(place.tls),
        websocket: None,
    };
    let first = MqttPlace { host: mqtt.host.clone(), port: mqtt.port, tls: mqtt.tls };
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
    let response = match client.get(url).timeout(PATIENCE).send().await {
        Ok(response) if response.status().is_success() => response,
        Ok(response) => {
            let found = format!(
                "what answers at {base} is not taskd (status {})",
                response.status().as_u16()
            );
            let mend = "look whether a captive portal or a proxy is in between, and at server in agent.toml";
            checkup.bad("http", found, mend);
            return false;
        }
        Err(error) => {
            let mend = "look at the network, at server in agent.toml, and whether taskd serve runs and may be reached there";
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
    let mend = "let it follow NTP (timedatectl set-ntp true); without a battery-backed clock install fake-hwclock";
    match server_s.abs_diff(here_s) {
        ..SKEW_NOTICE_S => checkup.good("clock", "this robot and the server agree"),
        SKEW_NOTICE_S..SKEW_BAD_S => checkup.notice("clock", found(), mend),
        _ => checkup.bad("clock", found(), mend),
    }
    true
}

async fn certificate(checkup: &mut Checkup, host: &str, port: u16, identity: &Identity) {
    let trust = Trust::by(identity.ca_pin);
    let end_ms = timeout(PATIENCE, certificate_end_ms(host, port, trust)).await.ok().flatten();
    let by =
        if identity.ca_pin.is_some() { "by the pinned authority" } else { "by the system's roots" };
    match end_ms {
        Some(end_ms) if end_ms < clock::wall_ms() + SOON_MS => checkup.notice(
            "tls",
            format!("the server's certificate ends {}", task_proto::time::timestamp(end_ms)),
            "the server's administrator renews it",
        ),
        Some(end_ms) => {
            checkup.good(
                "tls",
                format!("vouched for {by}, until {}", task_proto::time::timestamp(end_ms)),
            );
        }
        None => checkup.good("tls", format!("vouched for {by}")),
    }
}

/// Checks whether the server accepts the token, and returns the address of MQTT from the server.
async fn token(checkup: &mut Checkup, server: &Server) -> Option<MqttEndpoint> {
    match timeout(PATIENCE, server.mqtt_endpoint()).await {
        Ok(Ok(endpoint)) => {
            checkup.good("token", "the server accepts it");
            return Some(endpoint);
        }
        Ok(Err(error)) => {
            let mend = match &error {
                ServerError::TokenRefused(_) => {
                    "enrol again with a token made for this robot (taskd enroll-token create --robot NAME)"
                }
                ServerError::Refused { code, .. } if code == task_proto::api::AWAITS_APPROVAL => {
                    "an administrator lets the robot in (taskd robot approve)"
                }
                _ => "look at the server (taskd doctor there)",
            };
            checkup.bad("token", chain(&error), mend);
        }
        Err(_) => checkup.bad(
            "token",
            "the server does not answer within 5 s",
            "look at the server (taskd doctor there)",
        ),
    }
    None
}

/// Checks whether MQTT is spoken at the route's address. One of two routes is enough.
async fn greet(checkup: &mut Checkup, name: &str, route: &Route, has_other: bool) -> bool {
    let at = format!("{}:{}", route.host, route.port);
    let found = match timeout(PATIENCE, greet_mqtt(route)).await {
        Ok(Ok(Probed::Mqtt)) => {
            checkup.good(name, format!("{at} answers"));
            return true;
        }
        Ok(Ok(Probed::SomethingElse)) => format!("what answers at {at} speaks no MQTT"),
        Ok(Err(error)) => chain(&error),
        Err(_) => format!("{at} does not answer within 5 s"),
    };
    let mend = "look at firewalls and proxies in between; without MQTT the robot polls (mqtt_transport in agent.toml)";
    match has_other {
        true => checkup.notice(name, found, mend),
        false => checkup.bad(name, found, mend),
    }
    false
}

fn machine(checkup: &mut Checkup, data: &Path, config: Option<&Config>) {
    let reserve = config
        .and_then(|config| config.limits.disk_reserve_bytes)
        .unwrap_or(FetchSettings::default().reserve_bytes);
    match disk::room(data) {
        Ok(room) if room.free < reserve => {
            let found = format!("{} MiB of {} MiB free", room.free >> 20, room.total >> 20);
            let mend = "make room: logs, recordings, packages of other tasks (limits.disk_reserve_bytes is kept free)";
            if room.is_used_up() {
                checkup.bad("disk", found, mend)
            } else {
                checkup.notice("disk", found, mend)
            }
        }
        Ok(room) => checkup
            .good("disk", format!("{} MiB of {} MiB free", room.free >> 20, room.total >> 20)),
        Err(error) => {
            checkup.bad("disk", format!("{}: {error}", data.display()), "look at the file system")
        }
    }
    match getrlimit(Resource::RLIMIT_NOFILE) {
        Ok((files, _)) if files < WANTED_FILES => checkup.notice(
            "files",
            format!("an agent started from here may have {files} files open"),
            "raise the limit (LimitNOFILE= in its unit, ulimit -n here)",
        ),
        Ok((files, _)) => {
            checkup.good("files", format!("an agent started from here may have {files} files open"))
        }
        Err(error) => checkup.notice("files", error.desc(), "look at ulimit -n"),
    }
}

fn ros(checkup: &mut Checkup, config: &Config) {
    let found = underlay::by_settings(&config.underlays, config.workspace.as_deref());
    let missing = found.iter().flat_map(|found| &found.setups).find(|setup| !setup.is_file());
    let setups: Vec<String> =
        found.iter().flat_map(|f| &f.setups).map(|setup| setup.display().to_string()).collect();
    match (missing, all_distros(&found)) {
        (Some(missing), _) => {
            let mend = "mend underlays and workspace, in agent.toml or at the server";
            checkup.bad("ros", UnderlayError::Missing(missing.clone()).to_string(), mend);
        }
        (None, distros) if distros.is_empty() && setups.is_empty() => checkup.notice(
            "ros",
            "none found in /opt/ros",
            "install ROS, or name its setup file as underlays in agent.toml; tasks without ROS run as well",
        ),
        (None, distros) if setups.is_empty() => {
            checkup.good("ros", format!("{}, without a setup file", distros.join(", ")))
        }
        (None, distros) => checkup.good("ros", format!("{}: {}", distros.join(", "), setups.join(", "))),
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
            "neither colcon nor catkin_make is found",
            "install colcon (python3-colcon-common-extensions); packages that are built elsewhere run without",
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
    let mend = "tasks run all the same, without limits that hold; use a kernel with cgroup v2 and let systemd delegate \
                (Delegate=yes in the agent's unit)";
    match cgroup::outlook() {
        Outlook::Isolates => checkup.good("cgroups", "v2, with memory and pids"),
        Outlook::Counts => {
            checkup.notice("cgroups", "v2, without the controllers memory and pids", mend)
        }
        Outlook::Nothing => checkup.notice("cgroups", "no cgroup v2", mend),
    }
    let found = TaskUser::find(config.task_user.as_deref());
    let user = found.and_then(|user| user.map(|user| user.admitted_to(data)).transpose());
    match &user {
        Ok(Some(user)) => checkup.good(
            "task user",
            match &config.task_uids {
                Some(range) => {
                    let (first, last) = (range.start(), range.end());
                    format!(
                        "each task has an account of its own, from {first} to {last}, with the groups of {}",
                        user.name
                    )
                }
                None => format!("all tasks run as {}", user.name),
            },
        ),
        Ok(None) => checkup.good(
            "task user",
            "tasks run as whoever the agent is: nothing keeps them from each other's files and processes",
        ),
        Err(error @ TaskUserError::ShutOut { dir, .. }) => {
            let mend = format!("chmod o+x {}, or move the data directory", dir.display());
            checkup.bad("task user", error.to_string(), mend);
        }
        Err(error) => checkup.bad("task user", error.to_string(), "make the user, or set task_user in agent.toml"),
    }
    let has_account = !matches!(&user, Ok(None));
    match (call_filter::is_wanted(config.seccomp, has_account), CallFilter::of_tasks()) {
        (true, Some(_)) => checkup.good("seccomp", "tasks are denied system calls that only an administrator needs"),
        (true, None) => {
            let mend = "use a kernel with CONFIG_SECCOMP_FILTER on x86_64, aarch64 or armv7, or set seccomp = \"off\"";
            checkup.notice("seccomp", "this kernel or architecture has no filter of system calls", mend);
        }
        (false, _) => checkup.notice(
            "seccomp",
            "tasks may make all system calls",
            "set seccomp = \"default\" in agent.toml, or run the agent as root and tasks under an account of their own",
        ),
    }
}

/// Parses an HTTP date, like `Sun, 06 Nov 1994 08:49:37 GMT`, to seconds since the Unix epoch.
fn parse_date(text: &str) -> Option<u64> {
    const MONTHS: [&str; 12] =
        ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];
    let mut words = text.split_once(", ")?.1.split(' ');
    let (day, name, year, clock) = (words.next()?, words.next()?, words.next()?, words.next()?);
    let month = MONTHS.iter().position(|month| *month == name)? + 1;
    Some(parse_timestamp(&format!("{year}-{month:02}-{day}T{clock}.000Z"))? / 1000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_of_http_are_read() {
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
