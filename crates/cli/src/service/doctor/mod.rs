//! `taskd doctor`: checks for common problems between this machine and the server, and on this
//! machine if the server runs here, and says how to fix them. The command changes nothing.

mod local;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use http::StatusCode;
use serde::de::DeserializeOwned;
use serde_json::Value;
use task_proto::api::{
    BrokerCheck, BrokerChecks, DatabaseStatus, Me, RobotList, ServerInfo, ServerStatus, TokenList,
};
use task_proto::checkup::{Checkup, Verdict};
use task_proto::error_chain::chain;
use task_proto::people::roles::Permission;
use task_proto::time::span;
use task_transport::{ProbeResult, Route, Trust, certificate_end_ms, probe_mqtt};
use tokio::time::{Instant, timeout};

use crate::api::client::{Client, ClientError, data_directory};
use crate::display::output::{Format, Output, time};
use crate::{CommandError, Connection, Outcome, clock};

/// How to repair a corrupt database.
pub const INTEGRITY_REMEDY: &str = "stop the server and restore a copy of its data directory, or recover what can be read (see docs/server.md)";
/// Time limit of each answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// A larger clock skew confuses readers of timestamps.
const SKEW_NOTICE_MS: u64 = 5_000;
/// By more than this, certificates and tokens end at wrong times.
const SKEW_BAD_MS: u64 = 60 * 60 * 1000;
/// Certificates and tokens that end sooner should be renewed.
const EXPIRY_NOTICE_MS: u64 = 14 * DAY_MS;
const DAY_MS: u64 = 24 * 60 * 60 * 1000;

/// Runs all checks, `check_server` among them if the machine has a server's directory. A failed
/// check is an outcome, not an error.
pub(crate) async fn run(
    connection: &Connection,
    check_server: impl AsyncFnOnce(&mut Checkup, &Path, bool),
) -> Result<Outcome, CommandError> {
    let mut checkup = Checkup::default();
    let is_up = match Client::anonymous(connection) {
        Ok(client) => server(&mut checkup, &client, connection).await,
        // The check of the directory, below, explains the cause.
        Err(CommandError::Client(
            ClientError::ServerNotRunning { .. } | ClientError::DataDirectory { .. },
        )) => false,
        Err(error) => return Err(error),
    };
    if let Some(data) = data_directory(connection) {
        if data.exists() {
            let is_usable = local::check(&mut checkup, &data);
            if is_usable {
                check_server(&mut checkup, &data, is_up).await;
            }
        } else if connection.data.is_some() {
            checkup.bad(
                "data",
                format!("{} does not exist", data.display()),
                "check --data and TASKD_DATA",
            );
        }
    }
    print(&Output::new(connection.output), &checkup)?;
    Ok(if checkup.is_healthy() { Outcome::Succeeded } else { Outcome::Failed })
}

fn print(output: &Output, checkup: &Checkup) -> Result<(), CommandError> {
    let paint = |verdict: Verdict| match (output.has_colours(), verdict) {
        (false, _) => verdict.sign().to_string(),
        (true, Verdict::Good) => format!("\x1b[32m{}\x1b[0m", verdict.sign()),
        (true, Verdict::Notice) => format!("\x1b[33m{}\x1b[0m", verdict.sign()),
        (true, Verdict::Bad) => format!("\x1b[31m{}\x1b[0m", verdict.sign()),
    };
    match output.format() {
        Format::Json => output.print_json(checkup),
        Format::Name => output.print_names(
            checkup
                .checks
                .iter()
                .filter(|check| check.verdict != Verdict::Good)
                .map(|check| &check.check),
        ),
        Format::Table | Format::Wide => output.print_text(&checkup.text(paint)),
    }
}

/// Checks from outside, beginning with whether the server answers at all.
async fn server(checkup: &mut Checkup, client: &Client, connection: &Connection) -> bool {
    let is_up = reach(checkup, client).await;
    if is_up {
        let is_standby = readiness(checkup, client).await;
        certificate(checkup, client).await;
        if !is_standby {
            check_with_token(checkup, connection).await;
        }
    }
    is_up
}

/// Name, connection and the first answer.
async fn reach(checkup: &mut Checkup, client: &Client) -> bool {
    let base = client.base();
    let begun = Instant::now();
    let (host, port) = client.host_and_port();
    let bare = host.trim_matches(['[', ']']).to_owned();
    match timeout(ANSWER_TIMEOUT, tokio::net::lookup_host((bare.as_str(), port))).await {
        Ok(Ok(_)) => {}
        Ok(Err(error)) => {
            checkup.bad(
                "name",
                format!("{bare}: {error}"),
                "check --server, and this machine's DNS (getent hosts)",
            );
            return false;
        }
        Err(_) => {
            checkup.bad(
                "name",
                format!("{bare}: no answer from DNS within 5 s"),
                "check this machine's DNS (resolvectl)",
            );
            return false;
        }
    }
    let answer =
        client.request(reqwest::Method::GET, "/healthz").timeout(ANSWER_TIMEOUT).send().await;
    match answer {
        Ok(response) if response.status().is_success() => {
            let ms = begun.elapsed().as_millis();
            checkup.good("http", format!("{base} answers in {ms} ms"));
            true
        }
        Ok(response) => {
            let found = format!(
                "the server at {base} is not taskd (status {})",
                response.status().as_u16()
            );
            checkup.bad("http", found, "check --server, and the proxy if there is one");
            false
        }
        Err(error) => {
            let causes = std::error::Error::source(&error)
                .map_or(String::new(), |cause| format!(": {}", chain(cause)));
            let found = format!("can't reach {base}{causes}");
            let remedy = match (
                base.starts_with("https"),
                found.contains("certificate") || found.contains("pinned"),
            ) {
                (true, true) => {
                    "use --pin with the pin that taskd serve printed, or add the authority's certificate to the system's roots"
                }
                _ => {
                    "check that taskd serve is running there, that it listens on that address (--http), and that no firewall blocks it"
                }
            };
            checkup.bad("http", found, remedy);
            false
        }
    }
}

/// Database, broker and disk, as the server sees them. True if the server is a standby, which serves
/// nothing yet.
async fn readiness(checkup: &mut Checkup, client: &Client) -> bool {
    let answer =
        client.request(reqwest::Method::GET, "/readyz").timeout(2 * ANSWER_TIMEOUT).send().await;
    let body: Option<Value> = match answer {
        Ok(response) => {
            response.bytes().await.ok().and_then(|bytes| serde_json::from_slice(&bytes).ok())
        }
        Err(_) => None,
    };
    let Some(body) = body else {
        checkup.bad(
            "ready",
            "unexpected answer from /readyz",
            "check the server's log (journalctl -u taskd)",
        );
        return false;
    };
    if body["status"] == "standby" {
        let reason = body["database"].as_str().unwrap_or("another server uses the database");
        checkup.good("standby", format!("the server waits to take over: {reason}"));
        return true;
    }
    let remedies = [
        (
            "database",
            "check the database's log and disk; for SQLite, the file system of the data directory",
        ),
        (
            "broker",
            "the server recovers its own broker by itself; an external one must be running and know the server (taskd broker acl)",
        ),
        (
            "disk",
            "free disk space, or remount the file system writable; the server then continues by itself",
        ),
    ];
    for (part, remedy) in remedies {
        match body.get(part).and_then(Value::as_str) {
            Some("ok") => checkup.good(part, "answers"),
            Some(problem) => checkup.bad(part, problem, remedy),
            None => {
                checkup.notice(part, "not reported by the server", "check the server's version")
            }
        }
    }
    // Only a server with a common store of packages reports it.
    match body.get("blobs").and_then(Value::as_str) {
        Some("ok") => checkup.good("blobs", "the common store answers"),
        Some(problem) => checkup.bad(
            "blobs",
            problem,
            "start the store or mount the directory of blobs.store; until then pushes are refused, and robots get \
             packages that the server has a copy of",
        ),
        None => {}
    }
    false
}

async fn certificate(checkup: &mut Checkup, client: &Client) {
    if !client.base().starts_with("https") {
        let is_local =
            matches!(client.host_and_port().0.as_str(), "localhost" | "127.0.0.1" | "[::1]");
        match is_local {
            true => checkup.good("tls", "off; the connection stays on this machine"),
            false => checkup.notice(
                "tls",
                "off: tokens are sent unencrypted",
                "enable TLS: serve without --allow-plaintext, or behind a TLS proxy",
            ),
        }
        return;
    }
    let (host, port) = client.host_and_port();
    let now_ms = clock::now_ms();
    match timeout(ANSWER_TIMEOUT, certificate_end_ms(&host, port, client.trust()))
        .await
        .ok()
        .flatten()
    {
        Some(end_ms) if end_ms < now_ms + EXPIRY_NOTICE_MS => {
            let remedy = "renew it: a changed file is reloaded (--tls-certificate); the private authority renews by itself, so check \
                        the server's clock";
            checkup.notice("tls", format!("the certificate expires {}", time(end_ms)), remedy);
        }
        Some(end_ms) => {
            let by = if matches!(client.trust(), Trust::Pinned(_)) {
                "the pinned authority"
            } else {
                "the system's roots"
            };
            checkup
                .good("tls", format!("trusted by {by}, the certificate expires {}", time(end_ms)));
        }
        None => checkup.good("tls", "trusted; the certificate's expiry is unknown"),
    }
}

/// Checks that need a token.
async fn check_with_token(checkup: &mut Checkup, connection: &Connection) {
    let client = match Client::connect(connection) {
        Ok(client) => client,
        Err(error) => {
            checkup.bad("token", error.to_string(), "sign in with taskd login NAME");
            return;
        }
    };
    let begun = clock::now_ms();
    let info: ServerInfo = match timeout(ANSWER_TIMEOUT, client.get("/server", &[])).await {
        Ok(Ok(info)) => info,
        Ok(Err(error)) => {
            let remedy = match &error {
                ClientError::Refused { .. } => {
                    "sign in with taskd login NAME, or ask an administrator for a token"
                }
                _ => "check the server's log",
            };
            checkup.bad("token", error.to_string(), remedy);
            return;
        }
        Err(_) => {
            checkup.bad(
                "token",
                "no answer from the server within 5 s",
                "check the server's log and load",
            );
            return;
        }
    };
    compare_clocks(checkup, &info, begun, clock::now_ms());
    token(checkup, &client).await;
    integrity(checkup, &client).await;
    mqtt(checkup, &client, &info).await;
    versions(checkup, &client, &info).await;
}

/// The server's answer if it arrives in time, or why there is none.
async fn fetch<T: DeserializeOwned>(client: &Client, path: &str) -> Result<T, String> {
    match timeout(ANSWER_TIMEOUT, client.get(path, &[])).await {
        Ok(answer) => answer.map_err(|error| error.to_string()),
        Err(_) => Err(format!("no answer from the server to {path} within 5 s")),
    }
}

/// Compares the server's clock with ours at the middle of the request.
fn compare_clocks(checkup: &mut Checkup, info: &ServerInfo, asked_ms: u64, answered_ms: u64) {
    let here_ms = asked_ms + answered_ms.saturating_sub(asked_ms) / 2;
    let skew = Duration::from_millis(info.now_ms.abs_diff(here_ms));
    let way = if info.now_ms > here_ms { "behind" } else { "ahead of" };
    let found = format!("this machine's clock is {} {way} the server's", span(skew));
    let remedy = "synchronize both with NTP (timedatectl set-ntp true)";
    match info.now_ms.abs_diff(here_ms) {
        ..SKEW_NOTICE_MS => checkup.good("clock", "synchronized with the server"),
        SKEW_NOTICE_MS..SKEW_BAD_MS => checkup.notice("clock", found, remedy),
        _ => checkup.bad("clock", found, remedy),
    }
}

async fn token(checkup: &mut Checkup, client: &Client) {
    let me: Me = match fetch(client, "/me").await {
        Ok(me) => me,
        Err(problem) => {
            return checkup.bad("token", problem, "sign in again with taskd login NAME");
        }
    };
    let may: Vec<&str> = me.permissions.iter().map(|permission| permission.as_str()).collect();
    let selectors: Vec<String> = me.scope.iter().map(ToString::to_string).collect();
    let scope = if selectors.is_empty() {
        String::new()
    } else {
        format!(", on {}", selectors.join(" and "))
    };
    let found = format!("{} has permission to {}{scope}", me.name, may.join(", "));
    let list: TokenList = fetch(client, "/tokens").await.unwrap_or_default();
    let end_ms =
        list.tokens.iter().find(|token| token.id == me.token).and_then(|token| token.expires_at_ms);
    let now_ms = clock::now_ms();
    match end_ms {
        Some(end_ms) if end_ms < now_ms + EXPIRY_NOTICE_MS => {
            checkup.notice(
                "token",
                format!("{found}; the token expires {}", time(end_ms)),
                "sign in again, or create another token (taskd token create)",
            );
        }
        _ if !me.permissions.contains(&Permission::Operate) => {
            checkup.notice(
                "token",
                found,
                "orders require the role operator; an administrator can grant it (taskd user edit)",
            );
        }
        _ => checkup.good("token", found),
    }
}

/// Whether the pages of the database are sound, and since when that is known.
async fn integrity(checkup: &mut Checkup, client: &Client) {
    let DatabaseStatus { problem, fully_checked_at_ms, guard, .. } =
        match fetch(client, "/server/status").await {
            Ok(ServerStatus { database, .. }) => database,
            Err(problem) => {
                return checkup.notice("integrity", problem, "check the server's log");
            }
        };
    match (problem, fully_checked_at_ms, guard) {
        (Some(problem), ..) => checkup.bad("integrity", problem, INTEGRITY_REMEDY),
        (None, Some(at_ms), _) => checkup
            .good("integrity", format!("the last full check, {}, found no problem", time(at_ms))),
        (None, None, Some(guard)) => checkup.good("integrity", guard),
        (None, None, None) => checkup.notice(
            "integrity",
            "the database has not been fully checked since the server started",
            "the check runs in the background: try again later",
        ),
    }
}

/// Probes the broker's own port, as robots reach the broker, from this machine. The server reports
/// the health of an external broker.
async fn mqtt(checkup: &mut Checkup, client: &Client, info: &ServerInfo) {
    let ServerStatus { broker, .. } = match fetch(client, "/server/status").await {
        Ok(status) => status,
        Err(problem) => return checkup.notice("mqtt", problem, "check the server's log"),
    };
    if broker.kind == "external" {
        match broker.healthy {
            true => checkup.good("mqtt", format!("the external broker at {} is ready", info.mqtt)),
            false => checkup.bad(
                "mqtt",
                broker.detail,
                "the broker must be running and know the server (taskd broker acl)",
            ),
        }
        return external_brokers(checkup, client).await;
    }
    let Some((bound, port)) =
        info.mqtt.rsplit_once(':').and_then(|(host, port)| Some((host, port.parse().ok()?)))
    else {
        return checkup.notice(
            "mqtt",
            format!("{} is not an address", info.mqtt),
            "check --mqtt of the server",
        );
    };
    // A server that listens on all addresses is reached at the address of its URL.
    let is_everywhere = matches!(bound, "0.0.0.0" | "[::]");
    let host = if is_everywhere { client.host_and_port().0 } else { bound.to_owned() };
    let tls = info
        .ca_pin
        .map(|pin| Arc::new(Trust::Pinned(pin).client_config(clock::for_certificates())));
    let route = Route { host: host.clone(), port, tls, websocket: None };
    let remedy = "robots fall back to MQTT over the HTTP port; for the MQTT port, check --mqtt of the server and firewalls";
    match timeout(ANSWER_TIMEOUT, probe_mqtt(&route)).await {
        Ok(Ok(ProbeResult::Mqtt)) => checkup.good("mqtt", format!("{host}:{port} answers")),
        Ok(Ok(ProbeResult::Other)) => checkup.notice(
            "mqtt",
            format!("the server at {host}:{port} does not speak MQTT"),
            remedy,
        ),
        Ok(Err(error)) => checkup.notice("mqtt", error.to_string(), remedy),
        Err(_) => {
            checkup.notice("mqtt", format!("no answer from {host}:{port} within 5 s"), remedy)
        }
    }
    let (host, port) = client.host_and_port();
    let tls = client
        .base()
        .starts_with("https")
        .then(|| Arc::new(client.trust().client_config(clock::for_certificates())));
    let route = Route { host, port, tls, websocket: Some(client.path("/mqtt")) };
    let remedy = "a proxy must allow WebSockets (see docs/tls.md)";
    match timeout(ANSWER_TIMEOUT, probe_mqtt(&route)).await {
        Ok(Ok(ProbeResult::Mqtt)) => checkup.good("websocket", "MQTT answers over the HTTP port"),
        Ok(Ok(ProbeResult::Other)) => {
            checkup.notice("websocket", "the HTTP port does not speak MQTT over WebSocket", remedy)
        }
        Ok(Err(error)) => checkup.notice("websocket", error.to_string(), remedy),
        Err(_) => {
            checkup.notice("websocket", "no answer from MQTT over the HTTP port within 5 s", remedy)
        }
    }
}

/// Whether one account at an external broker can end the session of another. The server runs this
/// test: it has the accounts.
async fn external_brokers(checkup: &mut Checkup, client: &Client) {
    let answer =
        timeout(3 * ANSWER_TIMEOUT, client.get::<BrokerChecks>("/broker/check", &[])).await;
    let checks = match answer {
        Ok(Ok(checks)) => checks,
        // The test needs an administrator, and a server that supports the test.
        Ok(Err(ClientError::Refused {
            status: StatusCode::FORBIDDEN | StatusCode::NOT_FOUND,
            ..
        })) => return,
        Ok(Err(error)) => {
            return checkup.notice("client-ids", error.to_string(), "check the server's log");
        }
        Err(_) => {
            return checkup.notice(
                "client-ids",
                "the server's test of the broker timed out",
                "check the broker",
            );
        }
    };
    for BrokerCheck { address, displaces, problem } in checks.brokers {
        match displaces {
            Some(false) => {
                checkup.good("client-ids", format!("at {address}, no user can end another's session by its client id"));
            }
            Some(true) => checkup.notice(
                "client-ids",
                format!("at {address}, a user who knows another's client id can end its session and keep it offline"),
                "mosquitto: use_username_as_clientid true (taskd broker conf), then restart it; NATS has no such setting: \
                 agents of this version are safe there, because their client ids are secret (see docs/broker.md)",
            ),
            None => checkup.notice(
                "client-ids",
                format!("the broker at {address} could not be tested: {}", problem.unwrap_or_default()),
                "install the latest files (taskd broker passwd, or nats): they contain the two accounts for this test",
            ),
        }
    }
}

/// Versions of this program, the server and the agents.
async fn versions(checkup: &mut Checkup, client: &Client, info: &ServerInfo) {
    let own = env!("CARGO_PKG_VERSION");
    match info.version == own {
        true => checkup.good("version", format!("{own}, here and on the server")),
        false => checkup.notice(
            "version",
            format!("{own} here, {} on the server", info.version),
            "install the same version on both",
        ),
    }
    let list: RobotList = match fetch(client, "/robots").await {
        Ok(list) => list,
        Err(problem) => return checkup.notice("robots", problem, "check the server's log"),
    };
    let online = list.robots.iter().filter(|robot| robot.online).count();
    let mut others: BTreeMap<&str, u64> = BTreeMap::new();
    for version in list
        .robots
        .iter()
        .filter_map(|robot| robot.host.as_ref())
        .map(|host| host.agent_version.as_str())
    {
        if version != info.version {
            *others.entry(version).or_default() += 1;
        }
    }
    let found = format!("{online} of {} online", list.robots.len());
    match others.is_empty() {
        true => checkup.good("robots", found),
        false => {
            let others: Vec<String> = others
                .iter()
                .take(5)
                .map(|(version, count)| format!("{count} with agent {version}"))
                .collect();
            let remedy = format!("update their agents to the server's version, {}", info.version);
            checkup.notice("robots", format!("{found}; {}", others.join(", ")), remedy);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judged(server_ms: u64) -> (Verdict, String) {
        let info: ServerInfo = serde_json::from_value(serde_json::json!({
            "version": "1",
            "key": task_proto::trust::envelope::SigningKey::random().public_key(),
            "mqtt": "a:1",
            "now_ms": server_ms,
        }))
        .expect("a server");
        let mut checkup = Checkup::default();
        compare_clocks(&mut checkup, &info, 10_000_000, 10_002_000);
        let check = checkup.checks.remove(0);
        (check.verdict, check.found)
    }

    #[test]
    fn clocks_are_compared_at_the_middle_of_the_request() {
        assert_eq!(judged(10_001_000).0, Verdict::Good);
        assert_eq!(judged(10_004_000).0, Verdict::Good);
        assert_eq!(
            judged(10_062_000),
            (Verdict::Notice, "this machine's clock is 1 min 1 s behind the server's".to_owned())
        );
        assert_eq!(
            judged(1_000),
            (Verdict::Bad, "this machine's clock is 2 h 46 min ahead of the server's".to_owned())
        );
    }
}
