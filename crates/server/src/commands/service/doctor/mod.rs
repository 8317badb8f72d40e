//! `taskd doctor`: checks for common problems between this machine and the server, and on this
//! machine if the server runs here, and says how to fix them. The command changes nothing.

mod local;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use http::StatusCode;
use serde::de::DeserializeOwned;
use serde_json::Value;
use task_proto::api::{
    BrokerCheck, BrokerChecks, DatabaseStatus, Me, RobotList, ServerInfo, ServerStatus, TokenList,
};
use task_proto::checkup::{Checkup, Verdict};
use task_proto::person::Permission;
use task_proto::time::span;
use task_transport::{Probed, Route, Trust, certificate_end_ms, greet_mqtt};
use tokio::time::{Instant, timeout};

use crate::commands::api::client::{Client, ClientError, data_directory};
use crate::commands::display::output::{Format, Output, time};
use crate::commands::{CommandError, Connection, Outcome};
use crate::system::clock::Clock;

/// How to repair a corrupt database.
const INTEGRITY_MEND: &str = "stop the server and put back a copy of its data directory, or save what can be read: docs/server.md says how";
/// Time limit of each answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// A larger clock skew confuses readers of timestamps.
const SKEW_NOTICE_MS: u64 = 5_000;
/// By more than this, certificates and tokens end at wrong times.
const SKEW_BAD_MS: u64 = 60 * 60 * 1000;
/// Certificates and tokens that end sooner should be renewed.
const SOON_MS: u64 = 14 * DAY_MS;
const DAY_MS: u64 = 24 * 60 * 60 * 1000;

/// Runs all checks. A failed check is an outcome, not an error.
pub(in crate::commands) async fn run(connection: &Connection) -> Result<Outcome, CommandError> {
    let mut checkup = Checkup::default();
    let is_up = match Client::anonymous(connection) {
        Ok(client) => server(&mut checkup, &client, connection).await,
        // The check of the directory, below, explains the cause.
        Err(CommandError::Client(
            ClientError::NotServing { .. } | ClientError::DataDirectory { .. },
        )) => false,
        Err(error) => return Err(error),
    };
    match data_directory(connection) {
        Some(data) if data.exists() => local::check(&mut checkup, &data, is_up).await,
        Some(data) if connection.data.is_some() => {
            checkup.bad(
                "data",
                format!("{} does not exist", data.display()),
                "look at --data and TASKD_DATA",
            );
        }
        _ => {}
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
        Format::Json => output.json(checkup),
        Format::Name => output.lines(
            checkup
                .checks
                .iter()
                .filter(|check| check.verdict != Verdict::Good)
                .map(|check| &check.check),
        ),
        Format::Table | Format::Wide => output.text(&checkup.text(paint)),
    }
}

/// Checks from outside, beginning with whether the server answers at all.
async fn server(checkup: &mut Checkup, client: &Client, connection: &Connection) -> bool {
    let is_up = reach(checkup, client).await;
    if is_up {
        readiness(checkup, client).await;
        certificate(checkup, client).await;
        known_to(checkup, connection).await;
    }
    is_up
}

/// Name, connection and the first answer.
async fn reach(checkup: &mut Checkup, client: &Client) -> bool {
    let base = client.base();
    let begun = Instant::now();
    let (host, port) = client.place();
    let bare = host.trim_matches(['[', ']']).to_owned();
    match timeout(PATIENCE, tokio::net::lookup_host((bare.as_str(), port))).await {
        Ok(Ok(_)) => {}
        Ok(Err(error)) => {
            checkup.bad(
                "name",
                format!("{bare}: {error}"),
                "look at --server, and at this machine's DNS (getent hosts)",
            );
            return false;
        }
        Err(_) => {
            checkup.bad(
                "name",
                format!("{bare} is not resolved within 5 s"),
                "look at this machine's DNS (resolvectl)",
            );
            return false;
        }
    }
    let answer = client.request(reqwest::Method::GET, "/healthz").timeout(PATIENCE).send().await;
    match answer {
        Ok(response) if response.status().is_success() => {
            let ms = begun.elapsed().as_millis();
            checkup.good("http", format!("{base} answers within {ms} ms"));
            true
        }
        Ok(response) => {
            let found = format!(
                "what answers at {base} is not taskd (status {})",
                response.status().as_u16()
            );
            checkup.bad(
                "http",
                found,
                "look at --server, and at the proxy in between if there is one",
            );
            false
        }
        Err(error) => {
            let mut found = format!("can't reach {base}");
            let mut source = std::error::Error::source(&error);
            while let Some(cause) = source {
                found.push_str(&format!(": {cause}"));
                source = cause.source();
            }
            let mend = match (
                base.starts_with("https"),
                found.contains("certificate") || found.contains("pinned"),
            ) {
                (true, true) => {
                    "give the pin that taskd serve printed, as --pin; or put the authority's certificate among the system's"
                }
                _ => {
                    "is taskd serve running there, does it listen on that address (--http), and does a firewall let it through?"
                }
            };
            checkup.bad("http", found, mend);
            false
        }
    }
}

/// Database, broker and disk, as the server sees them.
async fn readiness(checkup: &mut Checkup, client: &Client) {
    let answer = client.request(reqwest::Method::GET, "/readyz").timeout(2 * PATIENCE).send().await;
    let body: Option<Value> = match answer {
        Ok(response) => {
            response.bytes().await.ok().and_then(|bytes| serde_json::from_slice(&bytes).ok())
        }
        Err(_) => None,
    };
    let Some(body) = body else {
        checkup.bad(
            "ready",
            "/readyz does not answer as taskd does",
            "look at the server's log (journalctl -u taskd)",
        );
        return;
    };
    let mends = [
        (
            "database",
            "look at the database's own log and disk; for SQLite at the data directory's file system",
        ),
        (
            "broker",
            "the server mends its own broker by itself; an external one must run, and know the server (taskd broker acl)",
        ),
        (
            "disk",
            "make room, or remount the file system writable; then the server goes on by itself",
        ),
    ];
    for (part, mend) in mends {
        match body.get(part).and_then(Value::as_str) {
            Some("ok") => checkup.good(part, "answers"),
            Some(problem) => checkup.bad(part, problem, mend),
            None => checkup.notice(part, "the server does not say", "is it of another version?"),
        }
    }
}

async fn certificate(checkup: &mut Checkup, client: &Client) {
    if !client.base().starts_with("https") {
        let is_local = matches!(client.place().0.as_str(), "localhost" | "127.0.0.1" | "[::1]");
        match is_local {
            true => checkup.good("tls", "off, and only this machine is in between"),
            false => checkup.notice(
                "tls",
                "off: tokens travel in plain text",
                "let the server encrypt: serve without --allow-plaintext, or behind a proxy that does",
            ),
        }
        return;
    }
    let (host, port) = client.place();
    let now_ms = Clock::system().now_ms();
    match timeout(PATIENCE, certificate_end_ms(&host, port, client.trust())).await.ok().flatten() {
        Some(end_ms) if end_ms < now_ms + SOON_MS => {
            let mend = "renew it: a file that changes is read again (--tls-certificate); the private authority does so by itself, \
                        so look whether the server's clock is right";
            checkup.notice("tls", format!("the certificate ends {}", time(end_ms)), mend);
        }
        Some(end_ms) => {
            let by = if matches!(client.trust(), Trust::Pinned(_)) {
                "the pinned authority"
            } else {
                "the system's roots"
            };
            checkup
                .good("tls", format!("vouched for by {by}, the certificate ends {}", time(end_ms)));
        }
        None => checkup.good("tls", "vouched for; when the certificate ends can't be seen"),
    }
}

/// Checks that need a token.
async fn known_to(checkup: &mut Checkup, connection: &Connection) {
    let client = match Client::connect(connection) {
        Ok(client) => client,
        Err(error) => {
            checkup.bad("token", error.to_string(), "sign in with taskd login NAME");
            return;
        }
    };
    let begun = Clock::system().now_ms();
    let info: ServerInfo = match timeout(PATIENCE, client.get("/server", &[])).await {
        Ok(Ok(info)) => info,
        Ok(Err(error)) => {
            let mend = match &error {
                ClientError::Refused { .. } => {
                    "sign in with taskd login NAME, or ask an administrator for a token"
                }
                _ => "look at the server's log",
            };
            checkup.bad("token", error.to_string(), mend);
            return;
        }
        Err(_) => {
            checkup.bad(
                "token",
                "the server does not answer within 5 s",
                "look at the server's log and load",
            );
            return;
        }
    };
    clocks(checkup, &info, begun, Clock::system().now_ms());
    token(checkup, &client).await;
    integrity(checkup, &client).await;
    mqtt(checkup, &client, &info).await;
    versions(checkup, &client, &info).await;
}

/// The server's answer if it arrives in time, or why there is none.
async fn asked<T: DeserializeOwned>(client: &Client, path: &str) -> Result<T, String> {
    match timeout(PATIENCE, client.get(path, &[])).await {
        Ok(answer) => answer.map_err(|error| error.to_string()),
        Err(_) => Err(format!("the server does not answer {path} within 5 s")),
    }
}

/// Compares the server's clock with ours at the middle of the request.
fn clocks(checkup: &mut Checkup, info: &ServerInfo, asked_ms: u64, answered_ms: u64) {
    let here_ms = asked_ms + answered_ms.saturating_sub(asked_ms) / 2;
    let skew = Duration::from_millis(info.now_ms.abs_diff(here_ms));
    let way = if info.now_ms > here_ms { "behind" } else { "ahead of" };
    let found = format!("this machine's clock is {} {way} the server's", span(skew));
    let mend = "let both follow NTP (timedatectl set-ntp true)";
    match info.now_ms.abs_diff(here_ms) {
        ..SKEW_NOTICE_MS => checkup.good("clock", "this machine and the server agree"),
        SKEW_NOTICE_MS..SKEW_BAD_MS => checkup.notice("clock", found, mend),
        _ => checkup.bad("clock", found, mend),
    }
}

async fn token(checkup: &mut Checkup, client: &Client) {
    let me: Me = match asked(client, "/me").await {
        Ok(me) => me,
        Err(problem) => {
            return checkup.bad("token", problem, "sign in again with taskd login NAME");
        }
    };
    let may: Vec<&str> = me.permissions.iter().map(|permission| permission.as_str()).collect();
    let scope: Vec<String> = me.scope.iter().map(ToString::to_string).collect();
    let whom =
        if scope.is_empty() { String::new() } else { format!(", on {}", scope.join(" and ")) };
    let found = format!("{} may {}{whom}", me.name, may.join(", "));
    let list: TokenList = asked(client, "/tokens").await.unwrap_or_default();
    let end_ms =
        list.tokens.iter().find(|token| token.id == me.token).and_then(|token| token.expires_at_ms);
    let now_ms = Clock::system().now_ms();
    match end_ms {
        Some(end_ms) if end_ms < now_ms + SOON_MS => {
            checkup.notice(
                "token",
                format!("{found}; it ends {}", time(end_ms)),
                "sign in again, or make another (taskd token create)",
            );
        }
        _ if !me.permissions.contains(&Permission::Operate) => {
            checkup.notice(
                "token",
                found,
                "to order anything takes the role operator: an administrator gives it (taskd user edit)",
            );
        }
        _ => checkup.good("token", found),
    }
}

/// Whether the pages of the database are sound, and since when that is known.
async fn integrity(checkup: &mut Checkup, client: &Client) {
    let DatabaseStatus { problem, fully_checked_at_ms, guard, .. } =
        match asked(client, "/server/status").await {
            Ok(ServerStatus { database, .. }) => database,
            Err(problem) => {
                return checkup.notice("integrity", problem, "look at the server's log");
            }
        };
    match (problem, fully_checked_at_ms, guard) {
        (Some(problem), ..) => checkup.bad("integrity", problem, INTEGRITY_MEND),
        (None, Some(at_ms), _) => checkup.good(
            "integrity",
            format!("the last full check, {}, found nothing wrong", time(at_ms)),
        ),
        (None, None, Some(guard)) => checkup.good("integrity", guard),
        (None, None, None) => checkup.notice(
            "integrity",
            "the database was not checked in full since the server started",
            "it is checked beside the service: look again later",
        ),
    }
}

/// Probes the broker's own port, as robots reach the broker, from this machine. The server reports
/// the health of an external broker.
async fn mqtt(checkup: &mut Checkup, client: &Client, info: &ServerInfo) {
    let ServerStatus { broker, .. } = match asked(client, "/server/status").await {
        Ok(status) => status,
        Err(problem) => return checkup.notice("mqtt", problem, "look at the server's log"),
    };
    if broker.kind == "external" {
        match broker.healthy {
            true => checkup.good("mqtt", format!("the external broker at {} serves", info.mqtt)),
            false => checkup.bad(
                "mqtt",
                broker.detail,
                "the broker must run, and know the server (taskd broker acl)",
            ),
        }
        return external_brokers(checkup, client).await;
    }
    let Some((bound, port)) =
        info.mqtt.rsplit_once(':').and_then(|(host, port)| Some((host, port.parse().ok()?)))
    else {
        return checkup.notice(
            "mqtt",
            format!("{} is no address", info.mqtt),
            "look at --mqtt of the server",
        );
    };
    // A server that listens on all addresses is reached at the address of its URL.
    let is_everywhere = matches!(bound, "0.0.0.0" | "[::]");
    let host = if is_everywhere { client.place().0 } else { bound.to_owned() };
    let tls = info
        .ca_pin
        .map(|pin| Arc::new(Trust::Pinned(pin).client_config(Clock::for_certificates())));
    let route = Route { host: host.clone(), port, tls, websocket: None };
    let mend = "robots fall back to MQTT over the HTTP port; for its own port look at --mqtt of the server and at firewalls";
    match timeout(PATIENCE, greet_mqtt(&route)).await {
        Ok(Ok(Probed::Mqtt)) => checkup.good("mqtt", format!("{host}:{port} answers")),
        Ok(Ok(Probed::SomethingElse)) => {
            checkup.notice("mqtt", format!("what answers at {host}:{port} speaks no MQTT"), mend)
        }
        Ok(Err(error)) => checkup.notice("mqtt", error.to_string(), mend),
        Err(_) => checkup.notice("mqtt", format!("{host}:{port} does not answer within 5 s"), mend),
    }
    let (host, port) = client.place();
    let tls = client
        .base()
        .starts_with("https")
        .then(|| Arc::new(client.trust().client_config(Clock::for_certificates())));
    let route = Route { host, port, tls, websocket: Some(client.path("/mqtt")) };
    let mend = "a proxy in between must let WebSockets pass (see docs/tls.md)";
    match timeout(PATIENCE, greet_mqtt(&route)).await {
        Ok(Ok(Probed::Mqtt)) => checkup.good("websocket", "MQTT answers over the HTTP port"),
        Ok(Ok(Probed::SomethingElse)) => {
            checkup.notice("websocket", "what answers over the HTTP port speaks no MQTT", mend)
        }
        Ok(Err(error)) => checkup.notice("websocket", error.to_string(), mend),
        Err(_) => {
            checkup.notice("websocket", "MQTT over the HTTP port does not answer within 5 s", mend)
        }
    }
}

/// Whether one account at an external broker can end the session of another. The server runs this
/// test: it has the accounts.
async fn external_brokers(checkup: &mut Checkup, client: &Client) {
    let answer = timeout(3 * PATIENCE, client.get::<BrokerChecks>("/broker/check", &[])).await;
    let checks = match answer {
        Ok(Ok(checks)) => checks,
        // The test needs an administrator, and a server that supports the test.
        Ok(Err(ClientError::Refused {
            status: StatusCode::FORBIDDEN | StatusCode::NOT_FOUND,
            ..
        })) => return,
        Ok(Err(error)) => {
            return checkup.notice("client-ids", error.to_string(), "look at the server's log");
        }
        Err(_) => {
            return checkup.notice(
                "client-ids",
                "the server's test of the broker takes long",
                "look at the broker",
            );
        }
    };
    for BrokerCheck { address, displaces, problem } in checks.brokers {
        match displaces {
            Some(false) => {
                checkup.good("client-ids", format!("at {address} no user can end another's session by its client id"));
            }
            Some(true) => checkup.notice(
                "client-ids",
                format!("at {address} a user who knows another's client id can end its session, and keep it off"),
                "mosquitto: use_username_as_clientid true (taskd broker conf), then restart it; NATS has no such setting: \
                 there agents of this version are safe, since nobody else knows their client ids (docs/broker.md)",
            ),
            None => checkup.notice(
                "client-ids",
                format!("the broker at {address} could not be tested: {}", problem.unwrap_or_default()),
                "give it the newest files (taskd broker passwd, or nats): they have the two accounts for this test",
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
            "install the same on both: what one knows the other may not",
        ),
    }
    let list: RobotList = match asked(client, "/robots").await {
        Ok(list) => list,
        Err(problem) => return checkup.notice("robots", problem, "look at the server's log"),
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
            let mend = format!("bring their agents to the server's version, {}", info.version);
            checkup.notice("robots", format!("{found}; {}", others.join(", ")), mend);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judged(server_ms: u64) -> (Verdict, String) {
        let info: ServerInfo = serde_json::from_value(serde_json::json!({
            "version": "1", "key": task_proto::envelope::SigningKey::random().public_key(), "mqtt": "a:1", "now_ms": server_ms,
        }))
        .expect("a server");
        let mut checkup = Checkup::default();
        clocks(&mut checkup, &info, 10_000_000, 10_002_000);
        let check = checkup.checks.remove(0);
        (check.verdict, check.found)
    }

    #[test]
    fn clocks_are_held_against_each_other_at_the_middle_of_the_question() {
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
